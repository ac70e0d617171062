"""The document of report.json: cost of all stages and quality of the result."""

import json
import math
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass
from typing import Any

from pipeline.core.command import format_command
from pipeline.core.errors import UserError
from pipeline.core.manifest import Manifest
from pipeline.metrics.images import mean_scores
from pipeline.metrics.lpips import MIN_SIDE_PX
from pipeline.report.lpips_weights import WEIGHTS_MISSING_NOTE as LPIPS_ABSENT
from pipeline.report.modelled import modelled_parts
from pipeline.report.risks import capture_risks


@dataclass(frozen=True)
class SplitNote:
    """How frames were held out.

    Attributes:
        rule: `Capture.split_rule`.
        held_out: number of held-out frames that can be scored; the report may score some of them only.
    """

    rule: str
    held_out: int


PROTOCOL = (
    "{held_out} frames were held out; {count} of them, evenly spaced, are scored; split: {split_rule}. Scores of "
    "interleaved and disjoint frames do not compare. Field, mesh and texture were not trained on their pixels, and no "
    "decision used their colours. Their poses are fitted to landmarks and silhouettes, never to colours: the body "
    "stage fits every frame, and the common shape and camera, to the landmarks and masks of all frames; the mesh "
    "stage aligns the outline of the mesh, in frames that are not trained on, to that of the mask, tied to the "
    "training frames next to them, whose poses are learnt from colours. Where validation frames reject this "
    "(stages.mesh.aligned_frames), pose corrections are interpolated in time between training frames and fade to zero "
    "away from them. Whether frames far from all training frames keep their alignment is decided by the masks of these "
    "frames, held-out ones included. Frames are composited on white with the mask of the frames stage, so an error of "
    "that mask costs nothing; renders are composited with their own alpha; both are rounded to 8 bits. psnr, ssim and "
    "flip (67 pixels a degree, lower is better) are means over frames: _full counts the whole image, _body the pixels "
    "of the mask, _box its bounding box. field is the radiance field; mesh is the exported mesh with its diffuse "
    "map{light}, its outline blurred to the softness of the masks (masks.edge_blur_sigma_px, measured on frames that "
    "are not scored); mesh_sharp is the mesh with hard edges."
)
LIGHT_REMOVED_NOTE = (
    " under the light that was estimated from training frames (removed from the map: shading by it explains "
    "{explained:.0%} of the squared error of validation frames, a decrease of {standard_errors:.1f} standard errors), "
    "with the exposure interpolated between training frames"
)
LIGHT_KEPT_NOTE = ", which holds the light of the video, unlit"
TEMPLATE_NOTE = (
    "The template of the built-in body lies {median:.1f} mm from the surface (median; 95 % of it within {p95:.1f} mm) "
    "with {flipped:.0f} faces turned over, so that each point has a place on the body. Of the surface, {close:.0%} lie "
    "close to the body, {cloth:.0%} are cloth that follows it, {loose:.0%} stand off it (skirt, coat), {hair:.0%} are "
    "hair."
)
UNREFINED_NOTE = (
    " Rows named unrefined use the poses of the body stage, without the field's corrections and the fit through the "
    "mesh."
)
LPIPS_NOTE = (
    "AlexNet, version 0.1, full image on white, colours scaled to [-1, 1] as in its authors' code. InstantAvatar's "
    "evaluation passes colours in [0, 1], so LPIPS values published with it do not compare"
)
LPIPS_MISSING_NOTE = f"{LPIPS_ABSENT}; frames with a side below {MIN_SIDE_PX} px have no LPIPS"
POSE_FITTED_SUFFIX = "_pose_fitted"
POSE_FITTED_NOTE = (
    " Rows named pose_fitted are not held-out scores: the pose of each frame was fitted to the image and mask of that "
    "frame through the mesh. They show which part of the error is an error of the pose."
)


def build_report(
    manifests: Mapping[str, Manifest],
    frames: Sequence[Mapping[str, Any]],
    metric_sections: Mapping[str, Mapping[str, float | int | bool]],
    environment: Mapping[str, Any],
    cost: tuple[float, float],
    split: SplitNote,
) -> dict[str, Any]:
    """Build the document.

    Args:
        manifests: manifests of the stages before the report, in order.
        frames: one row for each held-out frame: `index`, and the scores of each render by name.
        metric_sections: sections measured by the report: `mesh` (quality), `export` (glb_bytes, texture_px), `masks`.
        environment: machine and versions of this run.
        cost: seconds and peak memory (MiB) of the report stage so far.
        split: how frames were held out.

    Raises:
        UserError: the manifest of the body stage lacks a metric.
    """
    seconds = {name: manifest.seconds for name, manifest in manifests.items()} | {"report": round(cost[0], 3)}
    peaks = {name: manifest.peak_rss_mib for name, manifest in manifests.items()} | {"report": round(cost[1], 1)}
    renders = [name for name in frames[0] if name != "index"]
    protocol = PROTOCOL.format(
        count=len(frames), held_out=split.held_out, split_rule=split.rule, light=_light_note(manifests)
    )
    protocol += UNREFINED_NOTE * any(name.endswith("_unrefined") for name in renders)
    protocol += POSE_FITTED_NOTE * any(name.endswith(POSE_FITTED_SUFFIX) for name in renders)
    has_lpips = "lpips_full" in frames[0][renders[0]]
    return {
        "seconds": seconds | {"total": round(sum(seconds.values()), 3)},
        "peak_rss_mib": peaks | {"total": max(peaks.values())},
        "heldout": {name: mean_scores([row[name] for row in frames]) for name in renders}
        | {
            "split": split.rule,
            "held_out_frames": split.held_out,
            "protocol": protocol,
            "lpips": LPIPS_NOTE if has_lpips else LPIPS_MISSING_NOTE,
            "frames": list(frames),
        },
        **{name: dict(section) for name, section in metric_sections.items()},
        "body": {name: _manifest_metric(manifests["body"], name) for name in ("landmark_error_px", "silhouette_iou")},
        "template": _template_note(manifests),
        "modelled": [asdict(part) for part in modelled_parts(manifests)],
        "risks": [asdict(risk) for risk in capture_risks(manifests)],
        "stages": {name: dict(manifest.metrics) for name, manifest in manifests.items()},
        "warnings": [f"{name}: {text}" for name, manifest in manifests.items() for text in manifest.warnings],
        "environment": {name: value for name, value in environment.items() if name != "packages"},
    }


def _light_note(manifests: Mapping[str, Manifest]) -> str:
    """Say in words what the texture stage decided about the light of the video."""
    metrics = manifests["texture"].metrics if "texture" in manifests else {}
    if not metrics.get("light_removed"):
        return LIGHT_KEPT_NOTE
    explained, errors = metrics["light_explained"], metrics["light_standard_errors"]
    return LIGHT_REMOVED_NOTE.format(explained=explained, standard_errors=errors)


def _template_note(manifests: Mapping[str, Manifest]) -> str | None:
    """Say in words how well the template lies on the person; None for a body of a model file."""
    metrics = manifests["texture"].metrics if "texture" in manifests else {}
    if "template_distance_median_mm" not in metrics:
        return None
    return TEMPLATE_NOTE.format(
        median=metrics["template_distance_median_mm"],
        p95=metrics["template_distance_p95_mm"],
        flipped=metrics["template_flipped_faces"],
        **{name: metrics[f"{name}_share"] for name in ("close", "cloth", "loose", "hair")},
    )


def report_to_json(report: Mapping[str, Any]) -> str:
    """Return the document as JSON text; a value that is not finite (the PSNR of equal images) becomes null."""
    return json.dumps(replace_nonfinite(report), indent=2, allow_nan=False) + "\n"


def replace_nonfinite(value: Any) -> Any:
    """Return the document with None in place of infinities and NaN."""
    if isinstance(value, float) and not math.isfinite(value):
        return None
    if isinstance(value, Mapping):
        return {key: replace_nonfinite(inner) for key, inner in value.items()}
    return [replace_nonfinite(inner) for inner in value] if isinstance(value, list | tuple) else value


def _manifest_metric(manifest: Manifest, name: str) -> float | None:
    if name not in manifest.metrics:
        raise UserError(
            f"the manifest of stage {manifest.stage} has no metric {name}: "
            f"run {format_command(manifest.stage, 'RUN', '--force')}"
        )
    return manifest.metrics[name]
