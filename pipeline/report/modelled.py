"""What was modelled and why, in plain words: sizes and optional parts, from the manifests of the stages.

A manifest without a metric (an older version, or a stage that did not measure it) leaves the lines that need it out.
"""

from collections.abc import Callable, Mapping
from dataclasses import dataclass

from pipeline.core.manifest import Manifest

Manifests = Mapping[str, Manifest]
BYTES_PER_PARAMETER = 4
STRENGTH_MAP_BYTES_PER_TEXEL = 0.1
"""Size of a map of one channel as PNG: 0.08 and 0.10 bytes a texel on a generated and a filmed person."""
AT_LIMIT = 0.99
"""A size of at least this fraction of its limit is said to be limited."""

# What the capacity sweep found (docs/ablations.md), in the words of the page.
HALF_THE_PARAMETERS = (
    "half the parameters, as many as the surface needs, cost three people 0.15 dB and saved 3 % of the time"
)
FEWER_FRAMES = (
    "fewer gained 0.2 to 0.4 dB on two rendered turns, but lost 0.3 dB on a filmed turn and 0.2 to 0.4 dB on a dance"
)


@dataclass(frozen=True)
class ModelledPart:
    """A size or an optional part: what was chosen, by which rule or figure, and what it costs or would cost."""

    part: str
    choice: str
    reason: str
    cost: str = ""


def modelled_parts(manifests: Manifests) -> list[ModelledPart]:
    """Return all parts that the manifests tell about, in the order of the stages."""
    lines = (_line(describe, manifests) for describe in _DESCRIPTIONS)
    return [line for line in lines if line is not None]


def _line(describe: Callable[[Manifests], ModelledPart | None], manifests: Manifests) -> ModelledPart | None:
    """Return the line; None if a stage or one of its metrics is missing."""
    try:
        return describe(manifests)
    except KeyError:
        return None


def _metric(manifest: Manifest, name: str) -> float:
    """Return a metric that is a number.

    Raises:
        KeyError: it is missing, or was not finite.
    """
    value = manifest.metrics[name]
    if value is None:
        raise KeyError(name)
    return value


def _frames(manifests: Manifests) -> ModelledPart:
    frames = manifests["frames"]
    train, validation, held_out = (
        int(_metric(frames, f"frames_{name}")) for name in ("train", "validation", "heldout")
    )
    video, repeated = int(_metric(frames, "video_frames")), int(_metric(frames, "dropped_duplicates"))
    reason = f"frames that repeat the one before teach nothing: {repeated} were left out"
    if train + validation + held_out >= AT_LIMIT * frames.config.get("max_frames", float("inf")):
        reason += "; limited by frames.max_frames"
    choice = f"{train} to learn from, {validation} to decide, {held_out} to judge, of {video} in the video"
    return ModelledPart("Frames", choice, reason, _seconds(frames))


def _field_size(manifests: Manifests) -> ModelledPart:
    field = manifests["field"]
    parameters, steps = _metric(field, "parameters"), int(_metric(field, "steps"))
    settings = field.config.get("settings", {})
    choice = f"{settings['levels']} levels of cells" if "levels" in settings else "cells"
    cell_mm = field.metrics.get("finest_cell_mm")
    choice += f" down to {cell_mm:.1f} mm" if cell_mm is not None else ""
    choice += f", {parameters / 1e6:.2f} million parameters, {steps:,} steps"
    reasons = [HALF_THE_PARAMETERS]
    if "finest_cell_px" in settings:
        cell_px = settings["finest_cell_px"]
        reasons.insert(0, f"the finest cell is {cell_px:g} pixels on the person: what is smaller is noise")
    cost = f"{_seconds(field)}, {_megabytes(BYTES_PER_PARAMETER * parameters)}"
    return ModelledPart("Radiance field", choice, "; ".join(reasons), cost)


def _field_frames(manifests: Manifests) -> ModelledPart:
    field = manifests["field"]
    used, train = int(_metric(field, "train_frames")), int(_metric(manifests["frames"], "frames_train"))
    reason = FEWER_FRAMES
    if used >= AT_LIMIT * field.config.get("max_frames", float("inf")):
        reason += "; limited by field.max_frames"
    return ModelledPart("Frames of the field", f"{used} of {train} training frames", reason, "part of the field's time")


def _pose_corrections(manifests: Manifests) -> ModelledPart:
    metrics = manifests["field"]
    fitted, refined = (_metric(metrics, f"validation_psnr_{name}_db") for name in ("fitted", "refined"))
    kept = bool(_metric(metrics, "poses_kept"))
    reason = f"validation frames: {fitted:.2f} dB with the poses of the body stage, {refined:.2f} dB with corrections"
    return ModelledPart("Pose corrections", "kept" if kept else "dropped", reason, "part of the field's time")


def _voxel_attention(manifests: Manifests) -> ModelledPart:
    settings = manifests["field"].config["settings"]
    if settings["occupancy"] == "attention":
        return ModelledPart("Voxel attention", "on", "asked for by field.settings.occupancy")
    reason = "four people with known shape: -0.13 ± 0.04 dB on validation frames, though a sixth less haze"
    return ModelledPart("Voxel attention", "off", reason, "would take a seventh longer")


def _mesh_rounds(manifests: Manifests) -> ModelledPart:
    mesh = manifests["mesh"]
    kept = int(_metric(mesh, "accepted_rounds"))
    before, after = _metric(mesh, "initial_validation_psnr_db"), _metric(mesh, "refined_validation_psnr_db")
    tried = mesh.config.get("rounds", kept)
    reason = f"a round is kept if validation frames gain: {before:.2f} dB as extracted, {after:.2f} dB at the end"
    return ModelledPart("Refinement of the surface", f"{kept} of {tried} rounds kept", reason, _seconds(mesh))


def _faces(manifests: Manifests) -> ModelledPart:
    mesh = manifests["mesh"]
    faces, before = int(_metric(mesh, "faces")), int(_metric(mesh, "faces_before_reduction"))
    edge_mm = 1e3 * _metric(mesh, "target_edge_m")
    reason = f"edges of {edge_mm:.0f} mm as the pictures resolve, then removed while validation frames lose little"
    if faces >= AT_LIMIT * mesh.config.get("max_final_faces", float("inf")):
        reason += "; limited by mesh.max_final_faces"
    glb_bytes = manifests["export"].metrics.get("glb_bytes") if "export" in manifests else None
    cost = "" if glb_bytes is None else f"{_megabytes(glb_bytes)} with maps and morph targets"
    return ModelledPart("Faces", f"{faces:,} of {before:,}", reason, cost)


def _aligned_outlines(manifests: Manifests) -> ModelledPart:
    mesh = manifests["mesh"]
    interpolated, aligned = (_metric(mesh, f"{name}_motion_psnr_db") for name in ("interpolated", "aligned"))
    count = int(_metric(mesh, "aligned_frames"))
    choice = f"kept for {count} frames that were not trained on" if count else "dropped"
    reason = f"validation frames: {interpolated:.2f} dB with interpolated poses, {aligned:.2f} dB so"
    return ModelledPart("Poses by the outline", choice, reason, "part of the mesh's time")


def _texture_size(manifests: Manifests) -> ModelledPart:
    texture = manifests["texture"]
    side = int(_metric(texture, "texture_px"))
    reason = "texels as small as the pixels on the person"
    for bound, words in (("max_texture_px", "as large"), ("min_texture_px", "as small")):
        if texture.config.get(bound) == side:
            reason += f"; {words} as texture.{bound} allows"
    return ModelledPart("Texture", f"{side:,} × {side:,} px", reason, _seconds(texture))


def _light(manifests: Manifests) -> ModelledPart:
    texture = manifests["texture"]
    removed, asked = bool(_metric(texture, "light_removed")), texture.config.get("light", "auto")
    choice = "removed from the texture" if removed else "left in the texture"
    if asked != "auto":
        return ModelledPart("Light of the video", choice, f"asked for by texture.light={asked}")
    explained, errors = _metric(texture, "light_explained"), _metric(texture, "light_standard_errors")
    return ModelledPart("Light of the video", choice, _evidence("it", explained, errors))


def _specular(manifests: Manifests) -> ModelledPart:
    texture = manifests["texture"]
    explained, errors = _metric(texture, "specular_explained"), _metric(texture, "specular_standard_errors")
    regions, side = int(_metric(texture, "specular_regions")), _metric(texture, "texture_px")
    size = f"about {_megabytes(STRENGTH_MAP_BYTES_PER_TEXEL * side**2)}"
    reason = _evidence("highlights", explained, errors)
    if regions:
        return ModelledPart("Highlights", f"on in {regions} regions", reason, f"{size} for their map")
    if texture.config.get("light") == "kept":
        reason = "not tried: asked for by texture.light=kept"
    elif not _metric(texture, "light_removed"):
        reason = "not tried: no lamp was found whose highlights they could be"
    else:
        reason += ": too little, no region of the surface shines"
    return ModelledPart("Highlights", "off", reason, f"their map would cost {size}")


def _normal_map(manifests: Manifests) -> ModelledPart:
    if manifests["texture"].config["normal_map"]:
        return ModelledPart("Normal map", "on", "asked for by texture.normal_map")
    reason = "normals came no closer to two people with known shape: 8.53° and 14.44° without, 8.54° and 14.77° with it"
    return ModelledPart("Normal map", "off", reason, "would add about 12 % to avatar.glb")


def _face(manifests: Manifests) -> ModelledPart:
    export = manifests["export"]
    targets = int(_metric(export, "morph_targets"))
    if not targets:
        asked = not export.config.get("face", True)
        reason = "asked for by export.face" if asked else "no face was found, or it could not be cut out of the mesh"
        return ModelledPart("Face that moves", "off", reason)
    added = int(_metric(export, "glb_faces") - _metric(export, "faces"))
    return ModelledPart(
        "Face that moves", "on", "on by default (export.face)", f"{added:,} faces, {targets} morph targets"
    )


_DESCRIPTIONS: tuple[Callable[[Manifests], ModelledPart | None], ...] = (
    _frames,
    _field_size,
    _field_frames,
    _pose_corrections,
    _voxel_attention,
    _mesh_rounds,
    _faces,
    _aligned_outlines,
    _texture_size,
    _light,
    _specular,
    _normal_map,
    _face,
)


def _evidence(what: str, explained: float, errors: float) -> str:
    """Say how much of the error of validation frames something explains; negative: it adds to the error."""
    share = f"{100 * explained:.{1 if abs(explained) < 0.1 else 0}f} %"
    verb = "explains" if what == "it" else "explain"
    return f"{what} {verb} {share} of the squared error of validation frames, {errors:.1f} standard errors"


def _seconds(manifest: Manifest) -> str:
    return f"{manifest.seconds:.0f} s"


def _megabytes(count: float) -> str:
    return f"{count / 1e6:.1f} MB"
