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
from pipeline.geometry.surface import remesh_isotropic, subdivide
from pipeline.mesh.isosurface import keep_if_repair_fails
from pipeline.mesh.vertex_optimisation import RefinementConfig, RefinementInputs, optimise_vertices
from pipeline.mesh.views import SkinnedTopology, accumulate_face_errors, transfer_skin, validation_psnr_db


@dataclass(frozen=True)
class RefinementState:
    """Where the refinement stands after a round: also what a checkpoint holds.

    skin: what the mesh was optimised and judged with. appearance: state of the task's ``shader``. validation_psnr_db:
    of
    the start and of every round that was kept.
    """

    mesh: Mesh
    skin: SkinnedTopology
    shader_state: dict[str, Tensor]
    rounds_done: int
    validation_psnr_db: tuple[float, ...]
    finished: bool


def refine(
    start: Mesh | RefinementState,
    task: RefinementInputs,
    on_round_end: Callable[[RefinementState], None] = lambda state: None,
) -> RefinementState:
    """Runs the rounds that are left; ``on_round_end`` is called after each. ``task.shader`` ends as the result's
    appearance.

    Deterministic in (start, task): going on from a `RefinementState` that `on_round_end` was given ends with the same
    mesh.
    """
    state = _initial_state(start, task) if isinstance(start, Mesh) else start
    while not state.finished:
        state = _run_round(state, task)
        on_round_end(state)
    task.shader.load_state_dict(state.shader_state)
    return state


def _initial_state(mesh: Mesh, task: RefinementInputs) -> RefinementState:
    skin = transfer_skin(mesh, task.body)
    psnr_db = validation_psnr_db(mesh, skin, task.validation, task.shader)
    return RefinementState(mesh, skin, _shader_state(task), 0, (psnr_db,), task.config.rounds == 0)


def _shader_state(task: RefinementInputs) -> dict[str, Tensor]:
    return {name: tensor.detach().clone() for name, tensor in task.shader.state_dict().items()}


def _run_round(state: RefinementState, task: RefinementInputs) -> RefinementState:
    """New triangles (not in the first round), optimisation, and back to the start if validation frames got worse."""
    mesh, skin, rounds_done = state.mesh, state.skin, state.rounds_done + 1
    task.shader.load_state_dict(state.shader_state)
    if state.rounds_done > 0:
        errors = accumulate_face_errors(mesh, skin, task.train, task.shader)
        mesh = remesh_adaptively(mesh, errors, task.target_edge_m, task.config)
        skin = transfer_skin(mesh, task.body)
    mesh = optimise_vertices(mesh, skin, task, task.seed + 1000 * rounds_done, f"mesh round {rounds_done}")
    psnr_db = validation_psnr_db(mesh, skin, task.validation, task.shader)
    if task.validation and psnr_db < state.validation_psnr_db[-1]:
        return replace(state, rounds_done=rounds_done, finished=True)
    kept = (*state.validation_psnr_db, psnr_db)
    return RefinementState(mesh, skin, _shader_state(task), rounds_done, kept, rounds_done == task.config.rounds)


def remesh_adaptively(
    mesh: Mesh, errors: Float[np.ndarray, "f"], target_edge_m: float, config: RefinementConfig
) -> Mesh:
    """Splits faces above the upper percentile of the error at midpoints, decimates and remeshes those below the lower
    one, which stay where that would leave the surface open."""
    low = errors <= np.percentile(errors, config.decimate_percentile)
    high = errors > np.percentile(errors, config.subdivide_percentile)
    face_budget = max(0, config.max_faces - len(mesh.faces)) // 4
    if high.sum() > face_budget:
        high &= (
            errors >= np.partition(errors, len(errors) - face_budget)[len(errors) - face_budget]
            if face_budget
            else False
        )
    fine, _ = subdivide(mesh, high)
    # the faces to decimate are found again by their corners, which splitting elsewhere leaves alone
    keys = {tuple(face) for face in np.sort(mesh.faces[low], axis=1).tolist()}
    selected = np.array([tuple(face) in keys for face in np.sort(fine.faces, axis=1).tolist()])
    if not selected.any():
        return fine
    return keep_if_repair_fails(
        lambda: remesh_isotropic(fine, config.decimated_edge_ratio * target_edge_m, iterations=3, selected=selected),
        fine,
        "triangles with little error were not joined in this round",
    )
