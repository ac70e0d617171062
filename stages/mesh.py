"""Stage two: a watertight, manifold mesh of the canonical field, refined against the video."""

from collections.abc import Mapping
from pathlib import Path

import numpy as np
import torch
from pydantic import Field

from pipeline.avatar.body import Body, canonical_to_world
from pipeline.avatar.extract import (
    ExtractConfig,
    choose_level,
    extract_mesh,
    sample_canonical,
    simplify,
    transfer_skin_weights,
)
from pipeline.avatar.mesh_views import Shade, View, crop_view, pixel_footprint_m, silhouette_iou, skin_of
from pipeline.avatar.refine import RefineConfig, Refined, refine
from pipeline.avatar.turntable import turntable_sheet
from pipeline.core.atomic import atomic_path
from pipeline.core.cli import main
from pipeline.core.errors import UserError
from pipeline.core.progress import track, warn
from pipeline.core.stage import Stage
from pipeline.geometry.mesh import Mesh
from pipeline.geometry.skinning import top_k_weights
from pipeline.io.capture import load_capture
from pipeline.io.checkpoint import load_field, load_occupancy
from pipeline.io.image import write_rgb
from pipeline.io.npz import load_body, load_camera, load_motion, load_npz, save_npz
from pipeline.metrics.health import mesh_health

TRAIN, VALIDATION = 0, 1
CHECKPOINT = "checkpoint_round.npz"


class Config(ExtractConfig, RefineConfig):
    """Options of the mesh stage."""

    seed: int = Field(0, ge=0, description="seed of the order of frames and of the backgrounds behind them")
    levels_per_m: tuple[float, ...] = Field(
        (8.0, 16.0, 32.0, 64.0, 128.0), min_length=1, description="densities tried as the surface's level, 1/m"
    )
    level_frames: int = Field(8, ge=1, description="validation frames on which the level is chosen")
    edge_px: float = Field(3.0, gt=0.5, le=20.0, description="target edge length, in pixels of the images used")
    min_edge_m: float = Field(0.008, gt=0.001, description="shortest target edge length, m")
    max_edge_m: float = Field(0.014, gt=0.001, description="longest target edge length, m")
    max_frames: int = Field(80, ge=1, description="training frames used, evenly spread over the recording")


def run(inputs: Mapping[str, Path], out: Path, config: Config) -> Mapping[str, float]:
    """Extracts, refines and writes `mesh.npz` and `preview.png`."""
    body = load_body(inputs["body"] / "body.npz")
    field = load_field(inputs["field"] / "field.safetensors").requires_grad_(False)
    occupancy = load_occupancy(inputs["field"] / "occupancy.npz")
    train, validation = (load_views(inputs, body, split, config) for split in (TRAIN, VALIDATION))
    if not train:
        raise UserError(f"{inputs['frames']} has no training frames; run `python -m stages.frames` again")
    if not validation:
        warn("there are no validation frames: the level and every round are kept without being judged")

    def shade(points_m: torch.Tensor) -> torch.Tensor:
        return field(points_m)[0]

    footprint_m = float(np.median([pixel_footprint_m(view, body.vertices, body.skin_weights) for view in train]))
    edge_m = float(np.clip(config.edge_px * footprint_m, config.min_edge_m, config.max_edge_m))
    start, level_per_m = _resume(out / CHECKPOINT), float("nan")
    if start is None:
        samples = sample_canonical(lambda points: field.density(points) * occupancy.contains(points), body, config)
        judged = (validation or train)[:: max(1, len(validation or train) // config.level_frames)]
        level_per_m, _ = choose_level(
            samples, config, config.levels_per_m, lambda mesh: silhouette_iou(mesh, skin_of(mesh, body), judged)
        )
        start = simplify(extract_mesh(samples, level_per_m, config), edge_m)
    refined = refine(
        start,
        body,
        (train, validation),
        shade,
        edge_m,
        config,
        config.seed,
        lambda state: _save(out / CHECKPOINT, state),
    )
    _write(out, refined.mesh, body, shade)
    health = {key: float(value) for key, value in mesh_health(refined.mesh).items()}
    psnr_db = {"psnr_db_extracted": refined.validation_psnr_db[0], "psnr_db_refined": refined.validation_psnr_db[-1]}
    iou = silhouette_iou(refined.mesh, skin_of(refined.mesh, body), validation)
    return {
        **health,
        **psnr_db,
        "silhouette_iou": iou,
        "edge_m": edge_m,
        "rounds_kept": len(refined.validation_psnr_db) - 1.0,
    }


def load_views(inputs: Mapping[str, Path], body: Body, split: int, config: Config) -> list[View]:
    """Crops of the frames of one split, evenly thinned to `max_frames`."""
    capture, camera = load_capture(inputs["frames"]), load_camera(inputs["body"] / "camera.npz")
    transforms = canonical_to_world(body, load_motion(inputs["field"] / "motion.npz"))
    positions = capture.positions(split)
    if len(positions) > config.max_frames:
        positions = positions[np.linspace(0, len(positions) - 1, config.max_frames).round().astype(int)]
    return [
        crop_view(capture.image(k), capture.mask(k), camera, transforms[k], config.person_height_px)
        for k in track(positions.tolist(), "reading frames")
    ]


def _save(path: Path, state: Refined) -> None:
    with atomic_path(path) as unfinished:
        save_npz(
            unfinished,
            {
                "vertices": state.mesh.vertices,
                "faces": state.mesh.faces,
                "rounds_done": np.int64(state.rounds_done),
                "validation_psnr_db": np.array(state.validation_psnr_db),
                "finished": np.bool_(state.finished),
            },
        )


def _resume(path: Path) -> Refined | None:
    if not path.exists():
        return None
    arrays = load_npz(path)
    psnr_db = tuple(float(value) for value in arrays["validation_psnr_db"])
    mesh = Mesh(arrays["vertices"], arrays["faces"])
    return Refined(mesh, int(arrays["rounds_done"]), psnr_db, bool(arrays["finished"]))


def _write(out: Path, mesh: Mesh, body: Body, shade: Shade) -> None:
    joint_indices, joint_weights = top_k_weights(transfer_skin_weights(mesh, body))
    with torch.no_grad():
        vertex_colors = shade(torch.from_numpy(mesh.vertices)).numpy()
    arrays = {"vertices": mesh.vertices.astype(np.float32), "faces": mesh.faces.astype(np.int32)}
    arrays |= {"joint_indices": joint_indices, "joint_weights": joint_weights, "vertex_colors": vertex_colors}
    save_npz(out / "mesh.npz", arrays)
    write_rgb(out / "preview.png", turntable_sheet(mesh, shade))


STAGE = Stage(
    "mesh",
    version=1,
    needs=("frames", "body", "field"),
    makes=("mesh.npz", "preview.png"),
    config=Config,
    run=run,
)

if __name__ == "__main__":
    raise SystemExit(main(STAGE))
