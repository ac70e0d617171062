"""Rounds of refinement of the canonical mesh: vertices are optimised, then triangles go where the image error is.

Rounds after the first begin with new triangles: faces whose accumulated image error is above an upper percentile are
split at midpoints, those below a lower one decimated and remeshed, and vertex offsets start from zero (IHM paper, 2.3).
A round that makes the validation frames worse is undone and ends the refinement. Skin weights come from the body when
triangles are new and stay with the vertices that move: those that a round is judged with are those that are exported.
"""

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Float
from torch import Tensor

from pipeline.geometry.mesh import Mesh
from pipeline.geometry.surface import remesh, subdivide
from pipeline.mesh.isosurface import unless_open
from pipeline.mesh.vertex_optimisation import RefineConfig, RefineTask, optimise
from pipeline.mesh.views import Skin, face_errors, skin_of, validation_psnr_db


@dataclass(frozen=True)
class Refined:
    """Where the refinement stands after a round: also what a checkpoint holds.

    skin: what the mesh was optimised and judged with. appearance: state of the task's ``shade``. validation_psnr_db: of
    the start and of every round that was kept.
    """

    mesh: Mesh
    skin: Skin
    appearance: dict[str, Tensor]
    rounds_done: int
    validation_psnr_db: tuple[float, ...]
    finished: bool


def refine(
    start: Mesh | Refined, task: RefineTask, on_round: Callable[[Refined], None] = lambda state: None
) -> Refined:
    """Runs the rounds that are left; ``on_round`` is called after each. ``task.shade`` ends as the result's appearance.

    Deterministic in (start, task): going on from a `Refined` that `on_round` was given ends with the same mesh.
    """
    state = _begin(start, task) if isinstance(start, Mesh) else start
    while not state.finished:
        state = _round(state, task)
        on_round(state)
    task.shade.load_state_dict(state.appearance)
    return state


def _begin(mesh: Mesh, task: RefineTask) -> Refined:
    skin = skin_of(mesh, task.body)
    psnr_db = validation_psnr_db(mesh, skin, task.validation, task.shade)
    return Refined(mesh, skin, _appearance(task), 0, (psnr_db,), task.config.rounds == 0)


def _appearance(task: RefineTask) -> dict[str, Tensor]:
    return {name: tensor.detach().clone() for name, tensor in task.shade.state_dict().items()}


def _round(state: Refined, task: RefineTask) -> Refined:
    """New triangles (not in the first round), optimisation, and back to the start if validation frames got worse."""
    mesh, skin, rounds_done = state.mesh, state.skin, state.rounds_done + 1
    task.shade.load_state_dict(state.appearance)
    if state.rounds_done > 0:
        errors = face_errors(mesh, skin, task.train, task.shade)
        mesh = adapt_triangles(mesh, errors, task.edge_m, task.config)
        skin = skin_of(mesh, task.body)
    mesh = optimise(mesh, skin, task, task.seed + 1000 * rounds_done, f"mesh round {rounds_done}")
    psnr_db = validation_psnr_db(mesh, skin, task.validation, task.shade)
    if task.validation and psnr_db < state.validation_psnr_db[-1]:
        return replace(state, rounds_done=rounds_done, finished=True)
    kept = (*state.validation_psnr_db, psnr_db)
    return Refined(mesh, skin, _appearance(task), rounds_done, kept, rounds_done == task.config.rounds)


def adapt_triangles(mesh: Mesh, errors: Float[np.ndarray, "f"], edge_m: float, config: RefineConfig) -> Mesh:
    """Splits faces above the upper percentile of the error at midpoints, decimates and remeshes those below the lower
    one, which stay where that would leave the surface open."""
    low = errors <= np.percentile(errors, config.decimate_percentile)
    high = errors > np.percentile(errors, config.subdivide_percentile)
    room = max(0, config.max_faces - len(mesh.faces)) // 4
    if high.sum() > room:
        high &= errors >= np.partition(errors, len(errors) - room)[len(errors) - room] if room else False
    fine, _ = subdivide(mesh, high)
    # the faces to decimate are found again by their corners, which splitting elsewhere leaves alone
    keys = {tuple(face) for face in np.sort(mesh.faces[low], axis=1).tolist()}
    selected = np.array([tuple(face) in keys for face in np.sort(fine.faces, axis=1).tolist()])
    if not selected.any():
        return fine
    return unless_open(
        lambda: remesh(fine, config.decimate_edge * edge_m, iterations=3, selected=selected),
        fine,
        "triangles with little error were not joined in this round",
    )
