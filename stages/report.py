"""The last stage: held-out frames against renders of the field and of the exported mesh, figures, charts, a page."""

import time
from collections.abc import Mapping
from concurrent.futures import ThreadPoolExecutor
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import torch
from jaxtyping import Float, Int, UInt8
from pydantic import Field
from torch import Tensor

from pipeline.avatar.finished_run import FinishedRun, load_finished_run
from pipeline.avatar.pose_fit import MAX_PERSON_PX, fit_poses
from pipeline.body.body import canonical_to_world
from pipeline.capture.capture import CONTACT_SHEET, Capture
from pipeline.capture.frame_selection import HELDOUT, TRAIN
from pipeline.core.cli import main
from pipeline.core.config import Config as BaseConfig
from pipeline.core.errors import UserError
from pipeline.core.manifest import Manifest, read_manifest
from pipeline.core.measure import describe_environment, peak_rss_mib
from pipeline.core.progress import track, warn
from pipeline.core.stage import Stage
from pipeline.geometry.texture_rendering import blur_coverage
from pipeline.io.image import read_rgb, to_uint8, write_rgb
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
from pipeline.report.lpips_weights import find_lpips_weights
from pipeline.report.page import FrameImages, PageContent, error_map, render_page
from pipeline.report.report_json import build_report, replace_nonfinite, report_to_json
from pipeline.report.sheets import composite_on_white_uint8, image_grid

NEEDS = ("frames", "body", "field", "mesh", "texture", "export")
REPORT_IMAGES = (
    ("body", "overlay.png", "Fit of the body, laid over the video"),
    ("frames", "contact.jpg", "Chosen frames and their masks"),
    ("texture", "diffuse.png", "Diffuse map"),
    ("mesh", "preview.png", "Mesh"),
)
CROP_MARGIN_PX = 12
EDGE_SPREAD_FRAMES = 16


class Config(BaseConfig):
    """Options of the report."""

    samples_per_pixel_side: int = Field(
        3, ge=1, le=8, description="texture look-ups along each side of a pixel when the mesh is drawn"
    )
    score_unrefined_mesh: bool = Field(
        True, description="score the mesh in the body stage's poses as well, without the field's corrections"
    )
    score_unrefined_field: bool = Field(
        False, description="score the field in those poses too; doubles the report's time"
    )
    fit_held_out_poses: bool = Field(
        False,
        description="score field and mesh once more, apart, in poses fitted to the held-out images; costs minutes",
    )
    pose_fit_steps: int = Field(
        40, ge=1, le=1000, description="optimiser steps of that fit, all held-out frames in each"
    )
    max_page_frames: int = Field(8, ge=1, le=64, description="held-out frames that the page shows; all are scored")
    turntable_views: int = Field(8, ge=2, le=36, description="sides from which the turntable shows the avatar")
    turntable_height_px: int = Field(480, ge=64, le=2048, description="height of a turntable picture, px")


def run(inputs: Mapping[str, Path], out: Path, config: Config) -> Mapping[str, float]:
    """Score held-out frames, measure mesh and files, write report.json, the page and two sheets of pictures."""
    started = time.monotonic()
    manifests = {name: _manifest(inputs[name]) for name in NEEDS}
    loaded = load_finished_run(inputs)
    positions = scored_positions(loaded.capture)
    spread_px = median_edge_spread_px(loaded)
    rows, pictures = score(loaded, positions, spread_px, config)
    turntable = draw_turntable(loaded, int(positions[len(positions) // 2]), config)
    write_rgb(
        out / "turntable.jpg",
        image_grid([[composite_on_white_uint8(view) for view in turntable_views] for _, turntable_views in turntable]),
    )
    write_rgb(out / "heldout.jpg", image_grid([_comparison_row(frame) for frame in pictures]))
    glb = (inputs["export"] / "avatar.glb").read_bytes()
    metric_sections: dict[str, Mapping[str, float | int | bool]] = {
        "mesh": mesh_quality_metrics(loaded.avatar.mesh()),
        "export": {"glb_bytes": len(glb), "texture_px": len(loaded.avatar.diffuse)},
        "masks": {"count": len(loaded.capture), "edge_blur_sigma_px": spread_px},
    }
    cost = (time.monotonic() - started, peak_rss_mib())
    report = replace_nonfinite(build_report(manifests, rows, metric_sections, describe_environment(), cost))
    page = PageContent(
        title=out.resolve().parent.name,
        report=report,
        frames=pictures,
        turntable=turntable,
        pictures=[(caption, read_rgb(inputs[stage] / name)) for stage, name, caption in REPORT_IMAGES],
        glb=glb,
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
    """Positions of the held-out frames that can be scored; a warning names each of the others and says why.

    Raises:
        UserError: there is no such frame.
    """
    positions = capture.positions(HELDOUT)
    if len(positions) == 0:
        raise UserError(
            f"{capture.folder} holds no frame whose index is divisible by eight, so nothing can be scored: "
            "film longer, or choose more frames"
        )
    reasons = [reason_not_scorable(to_uint8(capture.mask(position))) for position in positions]
    for position, reason in zip(positions, reasons, strict=True):
        if reason is not None:
            warn(f"held-out frame {capture.frame_index[position]} is not scored: {reason}")
    scored = positions[[reason is None for reason in reasons]]
    if len(scored) == 0:
        raise UserError(
            f"no held-out frame of {capture.folder} can be scored (frame {capture.frame_index[positions[0]]}: "
            f"{reasons[0]}); look at {capture.folder / CONTACT_SHEET}, supply masks/, or film closer"
        )
    return scored


def median_edge_spread_px(loaded: FinishedRun) -> float:
    """How soft the capture's outlines are: the median over some of the frames that are not scored."""
    others = loaded.capture.positions(TRAIN)
    some = others[:: max(1, len(others) // EDGE_SPREAD_FRAMES)]
    spreads = [edge_blur_sigma_px(to_uint8(loaded.capture.mask(position))) for position in some.tolist()]
    return float(np.median(spreads)) if spreads else PIXEL_BOX_SIGMA_PX


def score(
    loaded: FinishedRun, positions: np.ndarray, spread_px: float, config: Config
) -> tuple[list[dict[str, Any]], list[FrameImages]]:
    """Scores of every held-out frame by render, and the pictures of some of them.

    The mesh is drawn with outlines as soft as the capture's (`spread_px`), as the field has learnt them; the row
    `mesh_sharp` is the mesh as square pixels give it.
    """
    blur_px = additional_blur_sigma_px(spread_px)

    def draw_sharp(pose: Float[Tensor, "j 4 4"]) -> Float[np.ndarray, "h w 4"]:
        return loaded.avatar.render(loaded.avatar.pose_vertices(pose), loaded.camera, config.samples_per_pixel_side)

    def draw_mesh(pose: Float[Tensor, "j 4 4"]) -> Float[np.ndarray, "h w 4"]:
        return blur_coverage(draw_sharp(pose), blur_px)

    renderers = {
        "field": (loaded.field_renderer, loaded.refined_canonical_to_world),
        "mesh_sharp": (draw_sharp, loaded.refined_canonical_to_world),
    }
    if config.score_unrefined_mesh:
        renderers["mesh_unrefined"] = (draw_mesh, loaded.fitted_canonical_to_world)
    if config.score_unrefined_field:
        renderers["field_unrefined"] = (loaded.field_renderer, loaded.fitted_canonical_to_world)
    if config.fit_held_out_poses:
        poses_fitted = fit_heldout_poses(loaded, positions, config.pose_fit_steps)
        renderers |= {
            "field_pose_fitted": (loaded.field_renderer, poses_fitted),
            "mesh_pose_fitted": (draw_mesh, poses_fitted),
        }
    weights = find_lpips_weights()
    shown = set(positions[np.linspace(0, len(positions) - 1, config.max_page_frames).round().astype(int)].tolist())
    rows, pictures = [], []
    with ThreadPoolExecutor(torch.get_num_threads()) as pool:
        for position in track(positions.tolist(), "held-out frames"):
            image, mask = (to_uint8(part(position)) for part in (loaded.capture.image, loaded.capture.mask))
            renders = {name: draw(poses[position]) for name, (draw, poses) in renderers.items()}
            softened = blur_coverage(renders["mesh_sharp"], blur_px)
            renders = {"field": renders["field"], "mesh": softened} | renders
            index = int(loaded.capture.frame_index[position])
            scores = pool.map(partial(frame_scores, image=image, mask=mask, lpips_weights=weights), renders.values())
            rows.append({"index": index} | dict(zip(renders, scores, strict=True)))
            if position in shown:
                pictures.append(_frame_images(index, image, mask, renders))
    return rows, pictures


def fit_heldout_poses(loaded: FinishedRun, positions: np.ndarray, steps: int) -> Float[Tensor, "n j 4 4"]:
    """The refined poses of all frames, those of the held-out ones fitted to their own pictures through the mesh."""
    turntable_views = [
        crop_posed_view(
            loaded.capture.image(position),
            loaded.capture.mask(position),
            loaded.camera,
            loaded.refined_canonical_to_world[position],
            MAX_PERSON_PX,
        )
        for position in positions.tolist()
    ]
    motion = fit_poses(loaded.avatar, loaded.body, loaded.motion.select(positions), turntable_views, steps)
    return loaded.refined_canonical_to_world.index_copy(
        0, torch.from_numpy(positions), canonical_to_world(loaded.body, motion)
    )


def draw_turntable(
    loaded: FinishedRun, position: int, config: Config
) -> list[tuple[str, list[UInt8[np.ndarray, "_ _ 4"]]]]:
    """The avatar from all sides, in its A-pose and as it stood in one frame."""
    index = int(loaded.capture.frame_index[position])
    bodies = {
        "A-pose": loaded.avatar.vertices,
        f"As in frame {index}, a held-out one": loaded.avatar.pose_vertices(
            loaded.refined_canonical_to_world[position]
        ),
    }
    return [
        (
            title,
            loaded.avatar.render_turntable(
                vertices, config.turntable_views, config.turntable_height_px, config.samples_per_pixel_side
            ),
        )
        for title, vertices in bodies.items()
    ]


def _frame_images(
    index: int, image: UInt8[np.ndarray, "h w 3"], mask: UInt8[np.ndarray, "h w"], renders: Mapping[str, np.ndarray]
) -> FrameImages:
    rows, columns = foreground_bounding_box(foreground_mask(mask))
    crop = tuple(slice(max(0, part.start - CROP_MARGIN_PX), part.stop + CROP_MARGIN_PX) for part in (rows, columns))
    field, mesh = (composite_premultiplied_on_white(renders[name])[crop] for name in ("field", "mesh"))
    return FrameImages(index, composite_on_white(image, mask)[crop], field, mesh)


def _comparison_row(frame: FrameImages) -> list[UInt8[np.ndarray, "h w 3"]]:
    errors = [error_map(render, frame.video) for render in (frame.field, frame.mesh)]
    return [frame.video, frame.field, frame.mesh, *errors]


def _manifest(folder: Path) -> Manifest:
    manifest = read_manifest(folder)
    if manifest is None:
        raise UserError(f"{folder} has no manifest: run python -m stages.{folder.name} {folder.parent}")
    return manifest


STAGE = Stage(
    name="report",
    version=4,
    needs=NEEDS,
    makes=("report.json", "index.html", "turntable.jpg", "heldout.jpg"),
    config=Config,
    run=run,
)

if __name__ == "__main__":
    raise SystemExit(main(STAGE))
