"""Stage two: a watertight, manifold mesh of the canonical field, refined against the video."""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np
import torch
from jaxtyping import Float, Int
from pydantic import Field
from torch import Tensor

from pipeline.avatar.turntable import turntable_sheet
from pipeline.body.body import Body, canonical_to_world
from pipeline.body.files import load_body, load_camera, load_motion
from pipeline.capture.capture import Capture, load_capture
from pipeline.capture.frame_selection import VALIDATION
from pipeline.capture.usable_frames import usable_training_positions
from pipeline.core.cli import main
from pipeline.core.errors import UserError
from pipeline.core.progress import track, warn
from pipeline.core.stage import Stage
from pipeline.field.files import load_field, load_occupancy
from pipeline.field.setup import evenly_spaced
from pipeline.geometry.mesh import Mesh
from pipeline.geometry.skinning import top_k_weights
from pipeline.geometry.surface import resolve_self_intersections
from pipeline.io.image import write_rgb
from pipeline.io.npz import save_npz
from pipeline.io.tensors import load_tensors, save_tensors
from pipeline.mesh.isosurface import ExtractConfig, extract_mesh, sample_canonical_grid, select_isovalue, simplify
from pipeline.mesh.refinement import RefinementState, refine
from pipeline.mesh.vertex_optimisation import RefinementConfig, RefinementInputs
from pipeline.mesh.views import (
    PosedView,
    build_skinned_topology,
    crop_posed_view,
    pixel_footprint_m,
    silhouette_iou,
    transfer_skin,
)
from pipeline.metrics.health import mesh_quality_metrics

CHECKPOINT, SHADER_STATE_PREFIX = "checkpoint_round.safetensors", "appearance."


class Config(ExtractConfig, RefinementConfig):
    """Options of the mesh stage."""

    seed: int = Field(0, ge=0, description="seed of the order of frames and of the backgrounds behind them")
    isovalues_per_m: tuple[float, ...] = Field(
        (8.0, 16.0, 32.0, 64.0, 128.0), min_length=1, description="densities tried as the surface's level, 1/m"
    )
    isovalue_frames: int = Field(8, ge=1, description="validation frames on which the level is chosen")
    edge_px: float = Field(3.0, gt=0.5, le=20.0, description="target edge length, in pixels of the images used")
    min_edge_m: float = Field(0.008, gt=0.001, description="shortest target edge length, m")
    max_edge_m: float = Field(0.014, gt=0.001, description="longest target edge length, m")
    max_frames: int = Field(80, ge=1, description="training frames used, evenly spread over the recording")


def run(inputs: Mapping[str, Path], out: Path, config: Config) -> Mapping[str, float]:
    """Extracts, refines and writes `mesh.npz` and `preview.png`."""
    body = load_body(inputs["body"] / "body.npz")
    field = load_field(inputs["field"] / "field.safetensors").requires_grad_(config.appearance_learning_rate > 0.0)
    occupancy = load_occupancy(inputs["field"] / "occupancy.npz")
    capture = load_capture(inputs["frames"])
    chosen = usable_training_positions(capture, inputs["body"]), capture.positions(VALIDATION)
    train, validation = (load_views(capture, positions, inputs, body, config) for positions in chosen)
    if not train:
        raise UserError(f"{inputs['frames']} has no training frames; run `python -m stages.frames` again")
    if not validation:
        warn("there are no validation frames: the level and every round are kept without being judged")

    footprint_m = float(np.median([pixel_footprint_m(view, body.vertices, body.skin_weights) for view in train]))
    target_edge_m = float(np.clip(config.edge_px * footprint_m, config.min_edge_m, config.max_edge_m))
    start: Mesh | RefinementState | None = load_checkpoint(out / CHECKPOINT)
    if start is None:
        views = validation or train
        isovalue_views = [views[k] for k in evenly_spaced(len(views), config.isovalue_frames)]

        def density_fn(points_m: Tensor) -> Tensor:
            return field.density(points_m) * occupancy.contains(points_m)

        start = simplify(extract_initial_mesh(density_fn, body, isovalue_views, config), target_edge_m)
    task = RefinementInputs(body, train, validation, FieldColourShader(field), target_edge_m, config, config.seed)
    refined = refine(start, task, lambda state: save_checkpoint(out / CHECKPOINT, state))
    refined = replace(refined, mesh=resolve_self_intersections(refined.mesh))
    write_results(out, refined, task.shader)
    psnr_db = {
        "initial_validation_psnr_db": refined.validation_psnr_db[0],
        "refined_validation_psnr_db": refined.validation_psnr_db[-1],
    }
    iou = silhouette_iou(refined.mesh, refined.skin, validation)
    health = {key: float(value) for key, value in mesh_quality_metrics(refined.mesh).items()}
    kept = len(refined.validation_psnr_db) - 1.0
    return {**health, **psnr_db, "silhouette_iou": iou, "target_edge_m": target_edge_m, "accepted_rounds": kept}


class FieldColourShader(torch.nn.Module):
    """The field's colours alone; its parameters are refined with the mesh."""

    def __init__(self, field: torch.nn.Module) -> None:
        super().__init__()
        self.field = field

    def forward(self, points_m: Float[Tensor, "n 3"]) -> Float[Tensor, "n 3"]:
        """Colours in [0, 1] at canonical points."""
        return self.field(points_m)[0]


def extract_initial_mesh(
    density_fn: Callable[[Tensor], Tensor], body: Body, isovalue_views: Sequence[PosedView], config: Config
) -> Mesh:
    """The density's surface at the level whose silhouettes fit the judged views best."""
    samples = sample_canonical_grid(density_fn, body, config)
    isovalue_per_m, _ = select_isovalue(
        samples,
        config,
        config.isovalues_per_m,
        lambda mesh: silhouette_iou(mesh, transfer_skin(mesh, body), isovalue_views),
    )
    return extract_mesh(samples, isovalue_per_m, config)


def load_views(
    capture: Capture, positions: Int[np.ndarray, "k"], inputs: Mapping[str, Path], body: Body, config: Config
) -> list[PosedView]:
    """Crops of the frames at these positions, evenly thinned to `max_frames`."""
    camera = load_camera(inputs["body"] / "camera.npz")
    transforms = canonical_to_world(body, load_motion(inputs["field"] / "motion.npz"))
    subsampled = positions[evenly_spaced(len(positions), config.max_frames)]
    return [
        crop_posed_view(capture.image(k), capture.mask(k), camera, transforms[k], config.max_person_px)
        for k in track(subsampled.tolist(), "reading frames")
    ]


def save_checkpoint(path: Path, state: RefinementState) -> None:
    """Write a round's result, whole or not at all."""
    progress = [float(state.rounds_done), float(state.finished), *state.validation_psnr_db]
    tensors = {
        "vertices": torch.from_numpy(state.mesh.vertices),
        "faces": torch.from_numpy(state.mesh.faces),
        "skin_weights": state.skin.weights,
        "progress": torch.tensor(progress, dtype=torch.float64),
    }
    save_tensors(
        path, tensors | {f"{SHADER_STATE_PREFIX}{name}": tensor for name, tensor in state.shader_state.items()}
    )


def load_checkpoint(path: Path) -> RefinementState | None:
    """What `save_checkpoint` wrote, or None when there is nothing."""
    if not path.exists():
        return None
    tensors, _ = load_tensors(path)
    rounds_done, finished, *psnr_db = tensors["progress"].tolist()
    shader_state = {
        name.removeprefix(SHADER_STATE_PREFIX): t for name, t in tensors.items() if name.startswith(SHADER_STATE_PREFIX)
    }
    mesh = Mesh(tensors["vertices"].numpy(), tensors["faces"].numpy())
    skin = build_skinned_topology(mesh, tensors["skin_weights"])
    return RefinementState(mesh, skin, shader_state, int(rounds_done), tuple(psnr_db), bool(finished))


def write_results(out: Path, refined: RefinementState, shader: torch.nn.Module) -> None:
    """The mesh with its skin and vertex colours, and the contact sheet."""
    mesh = refined.mesh
    joint_indices, joint_weights = top_k_weights(refined.skin.weights.numpy())
    with torch.no_grad():
        vertex_colors = shader(torch.from_numpy(mesh.vertices)).numpy()
    arrays = {"vertices": mesh.vertices.astype(np.float32), "faces": mesh.faces.astype(np.int32)}
    arrays |= {"joint_indices": joint_indices, "joint_weights": joint_weights, "vertex_colors": vertex_colors}
    save_npz(out / "mesh.npz", arrays)
    write_rgb(out / "preview.png", turntable_sheet(mesh, shader))


STAGE = Stage(
    "mesh",
    version=4,
    needs=("frames", "body", "field"),
    makes=("mesh.npz", "preview.png"),
    config=Config,
    run=run,
)

if __name__ == "__main__":
    raise SystemExit(main(STAGE))
