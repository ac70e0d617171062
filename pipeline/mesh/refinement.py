"""Refinement of the canonical mesh in rounds: optimisation of the vertices, then remeshing by the image error.

Each round after the first starts with adaptive remeshing: faces with an accumulated image error above an upper
percentile are subdivided, those below a lower percentile are decimated; the vertex offsets start from zero (IHM paper,
section 2.3). `MeshSettings.remeshing` has alternatives for ablations. A round that lowers the validation PSNR is
discarded and ends the refinement. Skin weights are transferred from the body after remeshing and stay with the vertices
during optimisation, so that each round is scored with the weights that are exported. After each accepted
round the poses of the views are aligned to the surface, unless validation prefers the present ones. All rounds but the
last see the training views with fewer pixels and have more steps (`MeshSettings.coarse_scale`).
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import torch
from torch import Tensor

from pipeline.body.body import Motion, canonical_to_world
from pipeline.body.pose_correction import PoseCorrection
from pipeline.geometry.mesh import Mesh
from pipeline.kernels.common.heap import trim_heap
from pipeline.mesh.correction_prior import drifting_prior
from pipeline.mesh.pose_alignment import AlignedSurface, PoseOffsets, align_poses
from pipeline.mesh.remeshing import FREE, detailed_faces, faces_by_part, remesh_adaptively, remesh_uniformly
from pipeline.mesh.skin_transfer import SkinnedTopology, transfer_skin
from pipeline.mesh.vertex_optimisation import RefinementInputs, optimise_vertices
from pipeline.mesh.views import PosedView, accumulate_face_errors, mesh_psnr_db


@dataclass(frozen=True)
class RefinementState:
    """The result of a round, which is also the content of a checkpoint.

    mesh, skin: the mesh with the skin weights of its optimisation and validation. shader_state: state of the shader.
    rounds_done: number of completed rounds, including a discarded one. validation_psnr_db: of the initial mesh and of
    each accepted round, with its aligned poses; NaN without validation views. finished: there is no further round.
    pose_offsets: of the poses of `RefinementInputs.train_motion`; None if they are not aligned.
    """

    mesh: Mesh
    skin: SkinnedTopology
    shader_state: dict[str, Tensor]
    rounds_done: int
    validation_psnr_db: tuple[float, ...]
    finished: bool
    pose_offsets: PoseOffsets | None = None


def refine_mesh(
    start: Mesh | RefinementState,
    inputs: RefinementInputs,
    on_round_end: Callable[[RefinementState], None] = lambda state: None,
) -> RefinementState:
    """Run the remaining rounds of the refinement.

    Deterministic in (start, inputs): a run that continues from a state passed to `on_round_end` gives the same mesh.

    Args:
        start: the initial mesh, or the state to continue from.
        inputs: see `RefinementInputs`; its shader has the state of the result afterwards.
        on_round_end: called with the state after each round.
    """
    state = _initial_state(start, inputs) if isinstance(start, Mesh) else start
    while not state.finished:
        state = _run_round(state, inputs)
        on_round_end(state)
    inputs.shader.load_state_dict(state.shader_state)
    return state


def _initial_state(mesh: Mesh, inputs: RefinementInputs) -> RefinementState:
    if inputs.settings.remeshing == "uniform":
        mesh = remesh_uniformly(mesh, detailed_faces(mesh, inputs.body), inputs.settings.remeshed_faces)
    skin = transfer_skin(mesh, inputs.body)
    psnr_db = mesh_psnr_db(mesh, skin, inputs.validation, inputs.shader)
    return RefinementState(mesh, skin, _shader_state(inputs), 0, (psnr_db,), inputs.rounds == 0)


def _shader_state(inputs: RefinementInputs) -> dict[str, Tensor]:
    return {name: tensor.detach().clone() for name, tensor in inputs.shader.state_dict().items()}


def _run_round(state: RefinementState, inputs: RefinementInputs) -> RefinementState:
    """Remesh (not in the first round) and optimise; return the old state as finished if the validation PSNR falls."""
    mesh, skin, rounds_done = state.mesh, state.skin, state.rounds_done + 1
    inputs = with_offsets(inputs, state.pose_offsets)
    if rounds_done < inputs.rounds:
        inputs = _with_fewer_pixels(inputs)
    inputs.shader.load_state_dict(state.shader_state)
    if state.rounds_done > 0:
        mesh = _remesh(mesh, skin, inputs)
        skin = transfer_skin(mesh, inputs.body)
    trim_heap()
    seed = inputs.settings.seed + 1000 * rounds_done
    mesh = optimise_vertices(mesh, skin, inputs, seed, f"mesh round {rounds_done}")
    psnr_db = mesh_psnr_db(mesh, skin, inputs.validation, inputs.shader)
    if inputs.validation and psnr_db < state.validation_psnr_db[-1]:
        return replace(state, rounds_done=rounds_done, finished=True)
    trim_heap()
    accepted = (*state.validation_psnr_db, psnr_db)
    finished = rounds_done == inputs.rounds
    new = RefinementState(mesh, skin, _shader_state(inputs), rounds_done, accepted, finished, state.pose_offsets)
    return _align(new, inputs)


def _with_fewer_pixels(inputs: RefinementInputs) -> RefinementInputs:
    """Return the inputs of a coarse round: a step costs half as much, so there are more of them."""
    settings = inputs.settings
    return replace(
        inputs,
        train=[view.scaled(settings.coarse_scale) for view in inputs.train],
        steps=round(settings.coarse_step_ratio * inputs.steps),
    )


def with_offsets(inputs: RefinementInputs, offsets: PoseOffsets | None) -> RefinementInputs:
    """Return the inputs with the views of `train_motion` and `validation_motion` in corrected poses."""
    if offsets is None or inputs.train_motion is None:
        return inputs
    correction = offsets.of(inputs.body, inputs.train_motion)

    def corrected(views: Sequence[PosedView], motion: Motion | None) -> list[PosedView]:
        poses = canonical_to_world(inputs.body, correction.apply(motion)) if motion is not None else ()
        moved = [replace(view, canonical_to_world=pose) for view, pose in zip(views, poses, strict=False)]
        return [*moved, *views[len(moved) :]]

    return replace(
        inputs,
        train=corrected(inputs.train, inputs.train_motion),
        validation=corrected(inputs.validation, inputs.validation_motion),
    )


def _align(state: RefinementState, inputs: RefinementInputs) -> RefinementState:
    """Return the state with the poses aligned to its surface, unless validation prefers the present ones."""
    motion = inputs.train_motion
    if motion is None or inputs.settings.alignment_steps == 0:
        return state
    offsets = state.pose_offsets
    correction = PoseCorrection(inputs.body, motion) if offsets is None else offsets.of(inputs.body, motion)
    views = inputs.train[: len(motion.frame_index)]
    surface = AlignedSurface.with_colours(torch.from_numpy(state.mesh.vertices), state.skin, inputs.shader)
    prior = drifting_prior(motion.time_s, correction.size)
    offsets = align_poses(surface, views, correction, prior, inputs.settings.alignment_steps)
    psnr_db = mesh_psnr_db(state.mesh, state.skin, with_offsets(inputs, offsets).validation, inputs.shader)
    if inputs.validation and psnr_db < state.validation_psnr_db[-1]:
        return state
    return replace(state, pose_offsets=offsets, validation_psnr_db=(*state.validation_psnr_db[:-1], psnr_db))


def _remesh(mesh: Mesh, skin: SkinnedTopology, inputs: RefinementInputs) -> Mesh:
    settings = inputs.settings
    if settings.remeshing == "none":
        return mesh
    if settings.remeshing == "uniform":
        return remesh_uniformly(mesh, detailed_faces(mesh, inputs.body), settings.remeshed_faces)
    errors = accumulate_face_errors(mesh, skin, inputs.train, inputs.shader)
    kept = faces_by_part(mesh, inputs.body) != FREE
    return remesh_adaptively(mesh, errors, kept, inputs.target_edge_m, inputs.max_faces, settings)
