"""report: scores of held-out frames, cost of all stages, and a page that shows them."""

import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any, TypeVar

import numpy as np
import torch
from jaxtyping import Float, Int, UInt8
from pydantic import Field
from torch import Tensor

from pipeline.avatar.clay import ClayViews, render_clay, render_clay_head
from pipeline.avatar.exported_surface import ExportedSurface
from pipeline.avatar.finished_run import FinishedRun, load_finished_run
from pipeline.avatar.motion.pose_fit import fit_poses
from pipeline.body.body import canonical_to_world
from pipeline.capture.capture import CONTACT_SHEET, Capture
from pipeline.capture.frame_selection import HELDOUT, TRAIN, evenly_spaced
from pipeline.core.cli import main
from pipeline.core.command import format_command
from pipeline.core.config import Config as BaseConfig
from pipeline.core.errors import UserError
from pipeline.core.manifest import Manifest, read_manifest
from pipeline.core.measure import describe_environment, peak_rss_mib
from pipeline.core.progress import track, warn
from pipeline.core.stage import Stage
from pipeline.geometry.mesh import Mesh
from pipeline.geometry.texture_rendering import blur_coverage
from pipeline.io.glb import GlbFile
from pipeline.io.image import read_gray, read_rgb, to_uint8, write_rgb
from pipeline.kernels.common.thread_pool import ThreadPool
from pipeline.mesh.pose_alignment import MAX_PERSON_PX
from pipeline.mesh.views import crop_posed_view
from pipeline.metrics.health import mesh_quality_metrics
from pipeline.metrics.images import (
    PIXEL_BOX_SIGMA_PX,
    additional_blur_sigma_px,
    composite_on_white,
    composite_premultiplied_on_white,
    edge_blur_sigma_px,
    foreground_bounding_box,
    foreground_mask,
    frame_scores,
    reason_not_scorable,
)
from pipeline.report.embed import read_level
from pipeline.report.lpips_weights import find_lpips_weights
from pipeline.report.page import FrameImages, PageContent, error_map, render_page
from pipeline.report.report_json import SplitNote, build_report, replace_nonfinite, report_to_json
from pipeline.report.settings import REPORT_SETTINGS, ReportSettings
from pipeline.report.sheets import composite_on_white_uint8, image_grid
from pipeline.texture.files import COVERAGE
from pipeline.texture.light import VideoLight, directional_light

NEEDS = ("frames", "body", "field", "mesh", "texture", "export")
REPORT_IMAGES = (
    ("body", "overlay.png", "Fitted body over the video"),
    ("frames", "contact.jpg", "Selected frames and their masks"),
    ("texture", "diffuse.png", "Diffuse map"),
    ("mesh", "preview.png", "Mesh"),
)


PREVIEW_LIGHTS = {
    "light from the left": directional_light((-0.85, 0.35, 0.4), 0.3),
    "light from above": directional_light((0.1, 0.95, 0.3), 0.35),
}
"""Lights, other than that of the video, under which the report shows the avatar."""


Turntable = tuple[str, list[UInt8[np.ndarray, "_ _ 4"]]]
"""Title of a row, and its views from all sides."""

Result = TypeVar("Result")


class Config(BaseConfig):
    """Options of the report."""

    fit_held_out_poses: bool = Field(
        False,
        description="add scores with poses fitted to the held-out images (InstantAvatar's protocol)",
    )
    score_unrefined_mesh: bool = Field(
        True, description="score the mesh also with the poses of the body stage, without the field's corrections"
    )
    samples_per_pixel_side: int = Field(
        3, ge=1, le=8, description="texture samples along each side of a pixel when the mesh is rendered"
    )
    frames: int = Field(12, ge=0, description="held-out frames that are scored, evenly spaced; 0: all of them")
    max_page_frames: int = Field(8, ge=1, le=64, description="scored frames on the page")
    turntable_views: int = Field(8, ge=2, le=36, description="views of the turntable")


def run(
    inputs: Mapping[str, Path], out: Path, config: Config, settings: ReportSettings = REPORT_SETTINGS
) -> Mapping[str, float]:
    """Score held-out frames, measure mesh and files, and write report.json, the page and three sheets."""
    started = time.monotonic()
    manifests = {name: _manifest(inputs[name]) for name in NEEDS}
    loaded = load_finished_run(inputs)
    scorable = scored_positions(loaded.capture)
    positions = scorable[evenly_spaced(len(scorable), config.frames or len(scorable))]
    edge_blur_px = median_edge_blur_px(loaded, settings)
    rows, frame_images = score_frames(loaded, positions, edge_blur_px, config, settings)
    middle = int(positions[len(positions) // 2])
    glb_path = inputs["export"] / "avatar.glb"
    glb = glb_path.read_bytes()
    exported = ExportedSurface.of_glb(GlbFile(glb_path, glb))
    turntable = render_turntables(loaded, exported, middle, config, settings)
    write_rgb(
        out / "turntable.jpg",
        image_grid([[composite_on_white_uint8(view) for view in turntable_views] for _, turntable_views in turntable]),
    )
    clay, clay_posed = render_clay_turntables(loaded, exported, middle, config, settings)
    write_rgb(out / "clay.jpg", image_grid([[composite_on_white_uint8(view) for view in views] for _, views in clay]))
    write_rgb(out / "heldout.jpg", image_grid([_comparison_row(frame) for frame in frame_images]))
    metric_sections: dict[str, Mapping[str, float | int | bool]] = {
        "mesh": mesh_quality_metrics(loaded.avatar.mesh()),
        "export": {"glb_bytes": len(glb), "texture_px": len(loaded.avatar.diffuse)},
        "masks": {"count": len(loaded.capture), "edge_blur_sigma_px": edge_blur_px},
    }
    cost = (time.monotonic() - started, peak_rss_mib())
    report = replace_nonfinite(
        build_report(
            manifests,
            rows,
            metric_sections,
            describe_environment(),
            cost,
            SplitNote(loaded.capture.split_rule, len(scorable)),
        )
    )
    page = PageContent(
        title=out.resolve().parent.name,
        report=report,
        frames=frame_images,
        turntable=[turntable[0], *turntable[2:], *clay, turntable[1], clay_posed],
        images=[(caption, read_rgb(inputs[stage] / name)) for stage, name, caption in REPORT_IMAGES],
        glb=glb,
        levels=[read_level(path) for path in sorted(inputs["export"].glob("avatar_lod*.glb"))],
        coverage=exported.coverage_map(loaded.avatar, read_gray(inputs["texture"] / COVERAGE)),
    )
    (out / "index.html").write_text(render_page(page), encoding="utf-8")
    (out / "report.json").write_text(report_to_json(report), encoding="utf-8")
    heldout = report["heldout"]
    return {
        f"{name}_{score}": heldout[name][score]
        for name in ("field", "mesh")
        for score in ("psnr_full", "psnr_body", "ssim_full")
        if heldout[name][score] is not None
    }


def scored_positions(capture: Capture) -> Int[np.ndarray, "k"]:
    """Return the positions of the held-out frames that can be scored; warn about each of the others.

    Raises:
        UserError: no frame can be scored.
    """
    positions = capture.positions(HELDOUT)
    if len(positions) == 0:
        raise UserError(
            f"{capture.folder} has no held-out frame ({capture.split_rule}), so nothing can be scored: "
            "record a longer video, raise frames.max_frames, or supply split.json"
        )
    reasons = [reason_not_scorable(to_uint8(capture.mask(position))) for position in positions]
    for position, reason in zip(positions, reasons, strict=True):
        if reason is not None:
            warn(f"held-out frame {capture.frame_index[position]} is not scored: {reason}")
    scored = positions[[reason is None for reason in reasons]]
    if len(scored) == 0:
        raise UserError(
            f"no held-out frame of {capture.folder} can be scored (frame {capture.frame_index[positions[0]]}: "
            f"{reasons[0]}); see {capture.folder / CONTACT_SHEET}, then supply masks/ or film from nearer"
        )
    return scored


def median_edge_blur_px(loaded: FinishedRun, settings: ReportSettings = REPORT_SETTINGS) -> float:
    """Return the median blur of the silhouettes (standard deviation, px) over frames that are not scored."""
    others = loaded.capture.positions(TRAIN)
    subset = others[:: max(1, len(others) // settings.edge_blur_frames)]
    blurs_px = [edge_blur_sigma_px(to_uint8(loaded.capture.mask(position))) for position in subset.tolist()]
    return float(np.median(blurs_px)) if blurs_px else PIXEL_BOX_SIGMA_PX


def score_frames(
    loaded: FinishedRun,
    positions: np.ndarray,
    edge_blur_px: float,
    config: Config,
    settings: ReportSettings = REPORT_SETTINGS,
) -> tuple[list[dict[str, Any]], list[FrameImages]]:
    """Return the scores of held-out frames by render, and the images of some of the frames.

    The silhouette of the render `mesh` is blurred to `edge_blur_px`, the softness of the capture, which the field has
    learnt; `mesh_sharp` has hard edges.
    """
    blur_px = additional_blur_sigma_px(edge_blur_px)

    avatar = loaded.avatar

    def render_field(pose: Float[Tensor, "j 4 4"], _: int) -> Float[np.ndarray, "h w 4"]:
        return loaded.field_renderer(pose)

    def render_sharp(pose: Float[Tensor, "j 4 4"], frame: int) -> Float[np.ndarray, "h w 4"]:
        vertices = avatar.pose_vertices(pose)
        return avatar.render(vertices, loaded.camera, config.samples_per_pixel_side, avatar.light, frame)

    def render_mesh(pose: Float[Tensor, "j 4 4"], frame: int) -> Float[np.ndarray, "h w 4"]:
        return blur_coverage(render_sharp(pose, frame), blur_px)

    renderers = {
        "field": (render_field, loaded.refined_canonical_to_world),
        "mesh_sharp": (render_sharp, loaded.refined_canonical_to_world),
    }
    if config.score_unrefined_mesh:
        renderers["mesh_unrefined"] = (render_mesh, loaded.fitted_canonical_to_world)
    if settings.score_unrefined_field:
        renderers["field_unrefined"] = (render_field, loaded.fitted_canonical_to_world)
    if config.fit_held_out_poses:
        poses_fitted = fit_heldout_poses(loaded, positions)
        renderers |= {
            "field_pose_fitted": (render_field, poses_fitted),
            "mesh_pose_fitted": (render_mesh, poses_fitted),
        }
    weights = find_lpips_weights()
    shown = set(positions[evenly_spaced(len(positions), config.max_page_frames)].tolist())

    def score(position: int) -> tuple[dict[str, Any], FrameImages | None]:
        image, mask = (to_uint8(part(position)) for part in (loaded.capture.image, loaded.capture.mask))
        renders = {name: render(poses[position], position) for name, (render, poses) in renderers.items()}
        softened = blur_coverage(renders["mesh_sharp"], blur_px)
        renders = {"field": renders["field"], "mesh": softened} | renders
        index = int(loaded.capture.frame_index[position])
        scores = {name: frame_scores(rgba, image, mask, weights) for name, rgba in renders.items()}
        pictures = _frame_images(index, image, mask, renders, settings.crop_margin_px) if position in shown else None
        return {"index": index} | scores, pictures

    scored = list(track(_side_by_side(score, positions.tolist()), "held-out frames", total=len(positions)))
    return [row for row, _ in scored], [pictures for _, pictures in scored if pictures is not None]


def _side_by_side(function: Callable[[int], Result], items: Sequence[int]) -> Iterator[Result]:
    """Yield the results for all items in order; a few at a time are computed, each with one thread."""
    threads = torch.get_num_threads()
    pool = ThreadPool(threads)
    for start in range(0, len(items), 2 * threads):
        yield from pool.map(function, items[start : start + 2 * threads])


def fit_heldout_poses(loaded: FinishedRun, positions: np.ndarray) -> Float[Tensor, "n j 4 4"]:
    """Return the refined poses of all frames, those of held-out frames fitted to their own images through the mesh."""
    views = [
        crop_posed_view(
            loaded.capture.image(position),
            loaded.capture.mask(position),
            loaded.camera,
            loaded.refined_canonical_to_world[position],
            MAX_PERSON_PX,
        )
        for position in positions.tolist()
    ]
    motion = fit_poses(loaded.avatar, loaded.body, loaded.motion.select(positions), views)
    return loaded.refined_canonical_to_world.index_copy(
        0, torch.from_numpy(positions), canonical_to_world(loaded.body, motion)
    )


def render_turntables(
    loaded: FinishedRun,
    exported: ExportedSurface,
    position: int,
    config: Config,
    settings: ReportSettings = REPORT_SETTINGS,
) -> list[Turntable]:
    """Render the avatar from all sides: unlit and under several lights in the A-pose, and in the pose of one frame.

    The last row is the head of the exported avatar.

    The diffuse map of an avatar whose light was not removed is shown unlit only: it holds the light.
    """
    avatar = loaded.avatar
    is_uniform = avatar.light is None or avatar.light.is_uniform
    posed = avatar.pose_vertices(loaded.refined_canonical_to_world[position])
    rows: list[tuple[str, Float[Tensor, "v 3"], VideoLight | None]] = [
        ("A-pose" if is_uniform else "A-pose, unlit", avatar.vertices, None),
        (_pose_title(loaded, position), posed, avatar.light),
    ]
    if not is_uniform:
        rows.append(("A-pose, the video's light", avatar.vertices, avatar.light))
        rows += [(f"A-pose, {name}", avatar.vertices, light) for name, light in PREVIEW_LIGHTS.items()]

    def render(row: tuple[str, Float[Tensor, "v 3"], VideoLight | None]) -> Turntable:
        title, vertices, light = row
        size = config.turntable_views, settings.turntable_height_px, config.samples_per_pixel_side
        return title, avatar.render_turntable(vertices, *size, light)

    views, samples = config.turntable_views, config.samples_per_pixel_side
    head = exported.render_head(views, settings.head_height_px, samples)
    return [*ThreadPool(len(rows)).map(render, rows), ("Head, as exported", head)]


def render_clay_turntables(
    loaded: FinishedRun,
    exported: ExportedSurface,
    position: int,
    config: Config,
    settings: ReportSettings = REPORT_SETTINGS,
) -> tuple[list[Turntable], Turntable]:
    """Render the shape without texture: rows of the exported avatar at rest, and clay in the pose of one frame."""
    views, height_px = config.turntable_views, settings.turntable_height_px
    posed = loaded.avatar.pose_vertices(loaded.refined_canonical_to_world[position]).numpy()
    in_pose = Mesh(posed, loaded.avatar.faces.numpy()), loaded.avatar.vertex_normals(posed)
    at_rest = exported.mesh, exported.vertex_normals

    def render(surface: tuple[Mesh, Float[np.ndarray, "v 3"]]) -> ClayViews:
        return render_clay(*surface, views, height_px)

    rest_clay, posed_clay = ThreadPool(2).map(render, (at_rest, in_pose))
    rows = [
        ("Rest pose, clay", rest_clay.smooth),
        ("Rest pose, clay, flat shading: the triangles", rest_clay.flat),
        ("Rest pose, normals: red to the person's left, green up, blue to the front", rest_clay.normals),
        ("Head, clay", render_clay_head(*at_rest, views, settings.head_height_px)),
    ]
    return rows, (f"{_pose_title(loaded, position)}, clay", posed_clay.smooth)


def _pose_title(loaded: FinishedRun, position: int) -> str:
    return f"Pose of frame {int(loaded.capture.frame_index[position])}, held out"


def _frame_images(
    index: int,
    image: UInt8[np.ndarray, "h w 3"],
    mask: UInt8[np.ndarray, "h w"],
    renders: Mapping[str, np.ndarray],
    margin_px: int,
) -> FrameImages:
    rows, columns = foreground_bounding_box(foreground_mask(mask))
    crop = tuple(slice(max(0, part.start - margin_px), part.stop + margin_px) for part in (rows, columns))
    field, mesh = (composite_premultiplied_on_white(renders[name])[crop] for name in ("field", "mesh"))
    return FrameImages(index, composite_on_white(image, mask)[crop], field, mesh)


def _comparison_row(frame: FrameImages) -> list[UInt8[np.ndarray, "h w 3"]]:
    errors = [error_map(render, frame.video) for render in (frame.field, frame.mesh)]
    return [frame.video, frame.field, frame.mesh, *errors]


def _manifest(folder: Path) -> Manifest:
    manifest = read_manifest(folder)
    if manifest is None:
        raise UserError(f"{folder} has no manifest: run {format_command(folder.name, folder.parent)}")
    return manifest


STAGE = Stage(
    name="report",
    version=16,
    needs=NEEDS,
    makes=("report.json", "index.html", "turntable.jpg", "clay.jpg", "heldout.jpg"),
    config=Config,
    run=run,
    shows="index.html",
)

if __name__ == "__main__":
    raise SystemExit(main(STAGE))
