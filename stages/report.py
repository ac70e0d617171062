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
from pipeline.avatar.pose_fit import PERSON_HEIGHT_PX, fit_poses
from pipeline.body.body import canonical_to_world
from pipeline.capture.capture import CONTACT_SHEET, Capture
from pipeline.capture.frame_selection import HELDOUT, TRAIN
from pipeline.core.cli import main
from pipeline.core.config import Config as BaseConfig
from pipeline.core.errors import UserError
from pipeline.core.manifest import Manifest, read_manifest
from pipeline.core.measure import environment, peak_rss_mib
from pipeline.core.progress import track, warn
from pipeline.core.stage import Stage
from pipeline.geometry.texture_rendering import soften_outline
from pipeline.io.image import read_rgb, to_uint8, write_rgb
from pipeline.mesh.views import crop_view
from pipeline.metrics.health import mesh_health
from pipeline.metrics.images import (
    PIXEL_SPREAD_PX,
    body_box,
    body_pixels,
    edge_spread_px,
    frame_scores,
    missing_blur_px,
    on_white,
    premultiplied_on_white,
    unscorable,
)
from pipeline.report.lpips_weights import find_lpips_weights
from pipeline.report.page import FramePictures, PageContent, error_map, render_page
from pipeline.report.report_json import build_report, finite, report_text
from pipeline.report.sheets import on_white_8bit, picture_sheet

NEEDS = ("frames", "body", "field", "mesh", "texture", "export")
PICTURES = (
    ("body", "overlay.png", "Fit of the body, laid over the video"),
    ("frames", "contact.jpg", "Chosen frames and their masks"),
    ("texture", "diffuse.png", "Diffuse map"),
    ("mesh", "preview.png", "Mesh"),
)
CROP_MARGIN_PX = 12
SPREAD_FRAMES = 16


class Config(BaseConfig):
    """Options of the report."""

    samples: int = Field(
        3, ge=1, le=8, description="texture look-ups along each side of a pixel when the mesh is drawn"
    )
    unrefined: bool = Field(
        True, description="score the mesh in the body stage's poses as well, without the field's corrections"
    )
    unrefined_field: bool = Field(False, description="score the field in those poses too; doubles the report's time")
    fit_held_out_poses: bool = Field(
        False,
        description="score field and mesh once more, apart, in poses fitted to the held-out images; costs minutes",
    )
    fit_steps: int = Field(40, ge=1, le=1000, description="optimiser steps of that fit, all held-out frames in each")
    shown_frames: int = Field(8, ge=1, le=64, description="held-out frames that the page shows; all are scored")
    views: int = Field(8, ge=2, le=36, description="sides from which the turntable shows the avatar")
    view_height_px: int = Field(480, ge=64, le=2048, description="height of a turntable picture, px")


def run(inputs: Mapping[str, Path], out: Path, config: Config) -> Mapping[str, float]:
    """Score held-out frames, measure mesh and files, write report.json, the page and two sheets of pictures."""
    started = time.monotonic()
    manifests = {name: _manifest(inputs[name]) for name in NEEDS}
    loaded = load_finished_run(inputs)
    positions = scored_positions(loaded.capture)
    spread_px = outline_spread_px(loaded)
    rows, pictures = score(loaded, positions, spread_px, config)
    turntable = draw_turntable(loaded, int(positions[len(positions) // 2]), config)
    write_rgb(out / "turntable.jpg", picture_sheet([[on_white_8bit(view) for view in views] for _, views in turntable]))
    write_rgb(out / "heldout.jpg", picture_sheet([_strip(frame) for frame in pictures]))
    glb = (inputs["export"] / "avatar.glb").read_bytes()
    figures: dict[str, Mapping[str, float | int | bool]] = {
        "mesh": mesh_health(loaded.avatar.mesh()),
        "export": {"glb_bytes": len(glb), "texture_px": len(loaded.avatar.diffuse)},
        "masks": {"count": len(loaded.capture), "edge_spread_px": spread_px},
    }
    cost = (time.monotonic() - started, peak_rss_mib())
    report = finite(build_report(manifests, rows, figures, environment(), cost))
    page = PageContent(
        title=out.resolve().parent.name,
        report=report,
        frames=pictures,
        turntable=turntable,
        pictures=[(caption, read_rgb(inputs[stage] / name)) for stage, name, caption in PICTURES],
        glb=glb,
    )
    (out / "index.html").write_text(render_page(page), encoding="utf-8")
    (out / "report.json").write_text(report_text(report), encoding="utf-8")
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
    reasons = [unscorable(to_uint8(capture.mask(position))) for position in positions]
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


def outline_spread_px(loaded: FinishedRun) -> float:
    """How soft the capture's outlines are: the median over some of the frames that are not scored."""
    others = loaded.capture.positions(TRAIN)
    some = others[:: max(1, len(others) // SPREAD_FRAMES)]
    spreads = [edge_spread_px(to_uint8(loaded.capture.mask(position))) for position in some.tolist()]
    return float(np.median(spreads)) if spreads else PIXEL_SPREAD_PX


def score(
    loaded: FinishedRun, positions: np.ndarray, spread_px: float, config: Config
) -> tuple[list[dict[str, Any]], list[FramePictures]]:
    """Scores of every held-out frame by render, and the pictures of some of them.

    The mesh is drawn with outlines as soft as the capture's (`spread_px`), as the field has learnt them; the row
    `mesh_sharp` is the mesh as square pixels give it.
    """
    blur_px = missing_blur_px(spread_px)

    def draw_sharp(pose: Float[Tensor, "j 4 4"]) -> Float[np.ndarray, "h w 4"]:
        return loaded.avatar.render(loaded.avatar.posed(pose), loaded.camera, config.samples)

    def draw_mesh(pose: Float[Tensor, "j 4 4"]) -> Float[np.ndarray, "h w 4"]:
        return soften_outline(draw_sharp(pose), blur_px)

    draws = {"field": (loaded.draw_field, loaded.refined), "mesh_sharp": (draw_sharp, loaded.refined)}
    if config.unrefined:
        draws["mesh_unrefined"] = (draw_mesh, loaded.fitted)
    if config.unrefined_field:
        draws["field_unrefined"] = (loaded.draw_field, loaded.fitted)
    if config.fit_held_out_poses:
        poses_fitted = fit_held_out(loaded, positions, config.fit_steps)
        draws |= {"field_pose_fitted": (loaded.draw_field, poses_fitted), "mesh_pose_fitted": (draw_mesh, poses_fitted)}
    weights = find_lpips_weights()
    shown = set(positions[np.linspace(0, len(positions) - 1, config.shown_frames).round().astype(int)].tolist())
    rows, pictures = [], []
    with ThreadPoolExecutor(torch.get_num_threads()) as pool:
        for position in track(positions.tolist(), "held-out frames"):
            image, mask = (to_uint8(part(position)) for part in (loaded.capture.image, loaded.capture.mask))
            renders = {name: draw(poses[position]) for name, (draw, poses) in draws.items()}
            softened = soften_outline(renders["mesh_sharp"], blur_px)
            renders = {"field": renders["field"], "mesh": softened} | renders
            index = int(loaded.capture.frame_index[position])
            scores = pool.map(partial(frame_scores, image=image, mask=mask, lpips_weights=weights), renders.values())
            rows.append({"index": index} | dict(zip(renders, scores, strict=True)))
            if position in shown:
                pictures.append(_pictures(index, image, mask, renders))
    return rows, pictures


def fit_held_out(loaded: FinishedRun, positions: np.ndarray, steps: int) -> Float[Tensor, "n j 4 4"]:
    """The refined poses of all frames, those of the held-out ones fitted to their own pictures through the mesh."""
    views = [
        crop_view(
            loaded.capture.image(position),
            loaded.capture.mask(position),
            loaded.camera,
            loaded.refined[position],
            PERSON_HEIGHT_PX,
        )
        for position in positions.tolist()
    ]
    motion = fit_poses(loaded.avatar, loaded.body, loaded.motion.select(positions), views, steps)
    return loaded.refined.index_copy(0, torch.from_numpy(positions), canonical_to_world(loaded.body, motion))


def draw_turntable(
    loaded: FinishedRun, position: int, config: Config
) -> list[tuple[str, list[UInt8[np.ndarray, "_ _ 4"]]]]:
    """The avatar from all sides, in its A-pose and as it stood in one frame."""
    index = int(loaded.capture.frame_index[position])
    bodies = {
        "A-pose": loaded.avatar.vertices,
        f"As in frame {index}, a held-out one": loaded.avatar.posed(loaded.refined[position]),
    }
    return [
        (title, loaded.avatar.turntable(vertices, config.views, config.view_height_px, config.samples))
        for title, vertices in bodies.items()
    ]


def _pictures(
    index: int, image: UInt8[np.ndarray, "h w 3"], mask: UInt8[np.ndarray, "h w"], renders: Mapping[str, np.ndarray]
) -> FramePictures:
    rows, columns = body_box(body_pixels(mask))
    crop = tuple(slice(max(0, part.start - CROP_MARGIN_PX), part.stop + CROP_MARGIN_PX) for part in (rows, columns))
    field, mesh = (premultiplied_on_white(renders[name])[crop] for name in ("field", "mesh"))
    return FramePictures(index, on_white(image, mask)[crop], field, mesh)


def _strip(frame: FramePictures) -> list[UInt8[np.ndarray, "h w 3"]]:
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
