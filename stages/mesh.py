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
from pipeline.capture.usable_frames import training_positions
from pipeline.core.cli import main
from pipeline.core.errors import UserError
from pipeline.core.progress import track, warn
from pipeline.core.stage import Stage
from pipeline.field.files import load_field, load_occupancy
from pipeline.field.setup import spread
from pipeline.geometry.mesh import Mesh
from pipeline.geometry.skinning import top_k_weights
from pipeline.geometry.surface import untangle
from pipeline.io.image import write_rgb
from pipeline.io.npz import save_npz
from pipeline.io.tensors import load_tensors, save_tensors
from pipeline.mesh.isosurface import ExtractConfig, choose_level, extract_mesh, sample_canonical, simplify
from pipeline.mesh.refinement import Refined, refine
from pipeline.mesh.vertex_optimisation import RefineConfig, RefineTask
from pipeline.mesh.views import View, bind, crop_view, pixel_footprint_m, silhouette_iou, skin_of
from pipeline.metrics.health import mesh_health

CHECKPOINT, APPEARANCE = "checkpoint_round.safetensors", "appearance."


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
    field = load_field(inputs["field"] / "field.safetensors").requires_grad_(config.appearance_rate > 0.0)
    occupancy = load_occupancy(inputs["field"] / "occupancy.npz")
    capture = load_capture(inputs["frames"])
    chosen = training_positions(capture, inputs["body"]), capture.positions(VALIDATION)
    train, validation = (load_views(capture, positions, inputs, body, config) for positions in chosen)
    if not train:
        raise UserError(f"{inputs['frames']} has no training frames; run `python -m stages.frames` again")
    if not validation:
        warn("there are no validation frames: the level and every round are kept without being judged")

    footprint_m = float(np.median([pixel_footprint_m(view, body.vertices, body.skin_weights) for view in train]))
    edge_m = float(np.clip(config.edge_px * footprint_m, config.min_edge_m, config.max_edge_m))
    start: Mesh | Refined | None = load_state(out / CHECKPOINT)
    if start is None:
        views = validation or train
        judged = [views[k] for k in spread(len(views), config.level_frames)]

        def density_of(points_m: Tensor) -> Tensor:
            return field.density(points_m) * occupancy.contains(points_m)

        start = simplify(first_mesh(density_of, body, judged, config), edge_m)
    task = RefineTask(body, train, validation, SurfaceColour(field), edge_m, config, config.seed)
    refined = refine(start, task, lambda state: save_state(out / CHECKPOINT, state))
    refined = replace(refined, mesh=untangle(refined.mesh))
    write_results(out, refined, task.shade)
    psnr_db = {"psnr_db_extracted": refined.validation_psnr_db[0], "psnr_db_refined": refined.validation_psnr_db[-1]}
    iou = silhouette_iou(refined.mesh, refined.skin, validation)
    health = {key: float(value) for key, value in mesh_health(refined.mesh).items()}
    kept = len(refined.validation_psnr_db) - 1.0
    return {**health, **psnr_db, "silhouette_iou": iou, "edge_m": edge_m, "rounds_kept": kept}


class SurfaceColour(torch.nn.Module):
    """The field's colours alone; its parameters are refined with the mesh."""

    def __init__(self, field: torch.nn.Module) -> None:
        super().__init__()
        self.field = field

    def forward(self, points_m: Float[Tensor, "n 3"]) -> Float[Tensor, "n 3"]:
        """Colours in [0, 1] at canonical points."""
        return self.field(points_m)[0]


def first_mesh(density_of: Callable[[Tensor], Tensor], body: Body, judged: Sequence[View], config: Config) -> Mesh:
    """The density's surface at the level whose silhouettes fit the judged views best."""
    samples = sample_canonical(density_of, body, config)
    level_per_m, _ = choose_level(
        samples, config, config.levels_per_m, lambda mesh: silhouette_iou(mesh, skin_of(mesh, body), judged)
    )
    return extract_mesh(samples, level_per_m, config)


def load_views(
    capture: Capture, positions: Int[np.ndarray, "k"], inputs: Mapping[str, Path], body: Body, config: Config
) -> list[View]:
    """Crops of the frames at these positions, evenly thinned to `max_frames`."""
    camera = load_camera(inputs["body"] / "camera.npz")
    transforms = canonical_to_world(body, load_motion(inputs["field"] / "motion.npz"))
    thinned = positions[spread(len(positions), config.max_frames)]
    return [
        crop_view(capture.image(k), capture.mask(k), camera, transforms[k], config.person_height_px)
        for k in track(thinned.tolist(), "reading frames")
    ]


def save_state(path: Path, state: Refined) -> None:
    """Write a round's result, whole or not at all."""
    progress = [float(state.rounds_done), float(state.finished), *state.validation_psnr_db]
    tensors = {
        "vertices": torch.from_numpy(state.mesh.vertices),
        "faces": torch.from_numpy(state.mesh.faces),
        "skin_weights": state.skin.weights,
        "progress": torch.tensor(progress, dtype=torch.float64),
    }
    save_tensors(path, tensors | {f"{APPEARANCE}{name}": tensor for name, tensor in state.appearance.items()})


def load_state(path: Path) -> Refined | None:
    """What `save_state` wrote, or None when there is nothing."""
    if not path.exists():
        return None
    tensors, _ = load_tensors(path)
    rounds_done, finished, *psnr_db = tensors["progress"].tolist()
    appearance = {name.removeprefix(APPEARANCE): t for name, t in tensors.items() if name.startswith(APPEARANCE)}
    mesh = Mesh(tensors["vertices"].numpy(), tensors["faces"].numpy())
    skin = bind(mesh, tensors["skin_weights"])
    return Refined(mesh, skin, appearance, int(rounds_done), tuple(psnr_db), bool(finished))


def write_results(out: Path, refined: Refined, shade: torch.nn.Module) -> None:
    """The mesh with its skin and vertex colours, and the contact sheet."""
    mesh = refined.mesh
    joint_indices, joint_weights = top_k_weights(refined.skin.weights.numpy())
    with torch.no_grad():
        vertex_colors = shade(torch.from_numpy(mesh.vertices)).numpy()
    arrays = {"vertices": mesh.vertices.astype(np.float32), "faces": mesh.faces.astype(np.int32)}
    arrays |= {"joint_indices": joint_indices, "joint_weights": joint_weights, "vertex_colors": vertex_colors}
    save_npz(out / "mesh.npz", arrays)
    write_rgb(out / "preview.png", turntable_sheet(mesh, shade))


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
