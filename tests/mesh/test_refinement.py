"""Rounds of refinement against views of a known mesh: better PSNR, discarded rounds, and resumed runs."""

from dataclasses import replace

import numpy as np
import pytest
import torch

from pipeline.body.body import Body, Motion
from pipeline.geometry.mesh import Mesh
from pipeline.geometry.rotation import axis_angle_to_matrix, matrix_to_quaternion
from pipeline.geometry.skinning import rigid_transform
from pipeline.geometry.surface import is_closed_manifold
from pipeline.mesh import refinement as refinement_module
from pipeline.mesh.pose_alignment import PoseOffsets
from pipeline.mesh.refinement import RefinementState, refine_mesh
from pipeline.mesh.skin_transfer import SkinnedTopology, transfer_skin
from pipeline.mesh.vertex_optimisation import RefinementInputs
from pipeline.mesh.views import PosedView, mesh_psnr_db
from tests.mesh.egg import PATTERN, SETTINGS, Pattern, Views, refinement_inputs

VIEW_ROWS = (np.flatnonzero(np.arange(12) % 3), np.arange(0, 12, 3))
"""Of the training and of the validation views, in the order of their times."""


def test_rounds_improve_the_psnr_and_keep_a_closed_manifold(dented_egg: Mesh, egg_body: Body, egg_views: Views) -> None:
    states: list[RefinementState] = []
    result = refine_mesh(dented_egg, refinement_inputs(egg_body, egg_views), states.append)
    assert result.finished
    assert list(result.validation_psnr_db) == sorted(result.validation_psnr_db)
    assert result.validation_psnr_db[-1] > result.validation_psnr_db[0] + 3.0
    assert is_closed_manifold(result.mesh)
    assert states[-1].rounds_done == result.rounds_done


def test_a_resumed_run_ends_with_the_same_bytes(dented_egg: Mesh, egg_body: Body, egg_views: Views) -> None:
    settings = replace(SETTINGS, seed=3)

    def inputs() -> object:
        return refinement_inputs(egg_body, egg_views, steps=8, settings=settings, shader=Pattern())

    states: list[RefinementState] = []
    whole = refine_mesh(dented_egg, inputs(), states.append)
    assert not states[0].finished
    resumed = refine_mesh(states[0], inputs())
    assert whole.mesh.vertices.tobytes() == resumed.mesh.vertices.tobytes()
    assert whole.mesh.faces.tobytes() == resumed.mesh.faces.tobytes()
    assert whole.validation_psnr_db == resumed.validation_psnr_db
    assert torch.equal(whole.shader_state["contrast"], resumed.shader_state["contrast"])


def test_a_round_that_lowers_the_validation_psnr_is_discarded(
    dented_egg: Mesh, egg_body: Body, egg_views: Views, monkeypatch: pytest.MonkeyPatch
) -> None:
    inputs = refinement_inputs(egg_body, egg_views, shader=Pattern())

    def spoil(mesh: Mesh, *_: object) -> Mesh:
        inputs.shader.contrast.data.fill_(0.1)
        return Mesh(mesh.vertices * np.float32(1.3), mesh.faces)

    monkeypatch.setattr(refinement_module, "optimise_vertices", spoil)
    result = refine_mesh(dented_egg, inputs)
    assert result.finished
    assert result.rounds_done == 1
    assert len(result.validation_psnr_db) == 1
    assert result.mesh is dented_egg
    assert float(inputs.shader.contrast.detach()) == pytest.approx(0.4)


def test_a_round_is_scored_with_the_skin_weights_of_its_optimisation(
    egg: Mesh, egg_body: Body, egg_views: Views, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Vertices that move across a step of the body's weights keep their weights; a new transfer would change them."""
    above = (egg_body.vertices[:, 1:2] > 0.0).astype(np.float32)
    two_joints = replace(
        egg_body,
        joint_names=("Hips", "Spine"),
        parents=np.array([-1, 0], dtype=np.int32),
        joints_m=np.zeros((2, 3), dtype=np.float32),
        skin_weights=np.concatenate([1.0 - above, above], axis=1),
    )
    lift = rigid_transform(torch.eye(3)[None], torch.tensor([[0.0, 0.05, 0.0]]))[0]
    bent = [
        replace(
            view, canonical_to_world=torch.cat([view.canonical_to_world, (lift @ view.canonical_to_world[0])[None]])
        )
        for view in egg_views[1]
    ]
    used: list[SkinnedTopology] = []

    def move_down(mesh: Mesh, skin: SkinnedTopology, *_: object) -> Mesh:
        used.append(skin)
        return Mesh(mesh.vertices - np.array([0.0, 0.1, 0.0], dtype=np.float32), mesh.faces)

    monkeypatch.setattr(refinement_module, "optimise_vertices", move_down)
    initial = refine_mesh(egg, refinement_inputs(two_joints, ([], bent), rounds=0))
    start = replace(initial, validation_psnr_db=(0.0,), finished=False)
    result = refine_mesh(start, refinement_inputs(two_joints, ([], bent), rounds=1))
    assert result.rounds_done == 1
    assert torch.equal(result.skin.weights, used[0].weights)
    assert result.validation_psnr_db[-1] == mesh_psnr_db(result.mesh, result.skin, bent, PATTERN)
    with_new_transfer = mesh_psnr_db(result.mesh, transfer_skin(result.mesh, two_joints), bent, PATTERN)
    assert abs(with_new_transfer - result.validation_psnr_db[-1]) > 1e-3


def test_zero_rounds_keep_the_initial_mesh(dented_egg: Mesh, egg_body: Body, egg_views: Views) -> None:
    result = refine_mesh(dented_egg, refinement_inputs(egg_body, egg_views, rounds=0))
    assert result.finished
    assert result.mesh is dented_egg


def test_without_validation_views_every_round_is_accepted(dented_egg: Mesh, egg_body: Body, egg_views: Views) -> None:
    result = refine_mesh(dented_egg, refinement_inputs(egg_body, (egg_views[0], []), steps=2))
    assert result.rounds_done == 2
    assert np.isnan(result.validation_psnr_db).tolist() == [True, True, True]


def test_all_rounds_but_the_last_have_fewer_pixels_and_more_steps(
    dented_egg: Mesh, egg_body: Body, egg_views: Views, monkeypatch: pytest.MonkeyPatch
) -> None:
    seen = []

    def optimise(mesh: Mesh, skin: SkinnedTopology, inputs: RefinementInputs, seed: int, label: str) -> Mesh:
        seen.append((inputs.train[0].camera.height, inputs.steps))
        return mesh

    monkeypatch.setattr(refinement_module, "optimise_vertices", optimise)
    settings = replace(SETTINGS, coarse_scale=0.5, coarse_step_ratio=3.0)
    refine_mesh(dented_egg, refinement_inputs(egg_body, (egg_views[0], []), steps=4, settings=settings))
    height = egg_views[0][0].camera.height
    assert seen == [(height // 2, 12), (height, 4)]


def test_rounds_without_remeshing_keep_the_faces(dented_egg: Mesh, egg_body: Body, egg_views: Views) -> None:
    settings = replace(SETTINGS, remeshing="none")
    result = refine_mesh(dented_egg, refinement_inputs(egg_body, egg_views, steps=10, settings=settings))
    assert len(result.validation_psnr_db) == 3
    np.testing.assert_array_equal(result.mesh.faces, dented_egg.faces)
    assert not np.array_equal(result.mesh.vertices, dented_egg.vertices)


def test_uniform_rounds_have_the_number_of_faces_even_if_none_is_kept(
    dented_egg: Mesh, egg_body: Body, egg_views: Views, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The image error is not evaluated: no colour of the views has an influence on the faces."""
    monkeypatch.setattr(refinement_module, "accumulate_face_errors", lambda *_: pytest.fail("error was evaluated"))
    wanted = len(dented_egg.faces) // 2
    settings = replace(SETTINGS, remeshing="uniform", remeshed_faces=wanted)
    for steps, rounds in ((10, 2), (1, 0)):
        inputs = refinement_inputs(egg_body, egg_views, steps=steps, rounds=rounds, settings=settings)
        result = refine_mesh(dented_egg, inputs)
        assert wanted <= len(result.mesh.faces) <= 1.02 * wanted
        assert is_closed_manifold(result.mesh)


def motion_of(views: list[PosedView], rows: np.ndarray) -> Motion:
    """The poses of views of a single joint, a twentieth of a second apart."""
    poses = torch.stack([view.canonical_to_world[0] for view in views])
    rotations_wxyz = matrix_to_quaternion(poses[:, :3, :3]).numpy()[:, None]
    return Motion(rows.astype(np.int32), rows / 20.0, rotations_wxyz, poses[:, :3, 3].numpy())


def disturbance_rad(rows: np.ndarray) -> np.ndarray:
    """Rotation vectors of up to five degrees, slowly changing."""
    return np.outer(np.radians(5.0) * np.sin(0.4 * rows), [0.2, 1.0, 0.0])


def disturbed_views(views: list[PosedView], rows: np.ndarray) -> list[PosedView]:
    """Views whose recorded poses are off by `disturbance_rad`."""
    turns = axis_angle_to_matrix(torch.from_numpy(disturbance_rad(rows)).float())
    moved = [rigid_transform(turn, torch.zeros(3)) for turn in turns]
    return [replace(v, canonical_to_world=v.canonical_to_world @ turn) for v, turn in zip(views, moved, strict=True)]


def disturbed_inputs(body: Body, views: Views, **changes: object) -> RefinementInputs:
    parts = [disturbed_views(part, rows) for part, rows in zip(views, VIEW_ROWS, strict=True)]
    motions = [motion_of(part, rows) for part, rows in zip(parts, VIEW_ROWS, strict=True)]
    inputs = refinement_inputs(body, (parts[0], parts[1]), rounds=1, steps=30, **changes)
    return replace(inputs, train_motion=motions[0], validation_motion=motions[1])


def test_poses_are_aligned_after_a_round(
    egg: Mesh, egg_body: Body, egg_views: Views, monkeypatch: pytest.MonkeyPatch
) -> None:
    still = replace(SETTINGS, learning_rate=1e-9, global_learning_rate=0.0)
    inputs = replace(disturbed_inputs(egg_body, egg_views, settings=still), steps=1)
    errors = torch.from_numpy(disturbance_rad(VIEW_ROWS[0])).float()[:, None]
    monkeypatch.setattr(refinement_module, "align_poses", lambda *_: PoseOffsets(-errors, torch.zeros(len(errors), 3)))
    aligned = refine_mesh(egg, inputs)
    as_recorded = refine_mesh(egg, replace(inputs, settings=replace(still, alignment_steps=0)))
    assert as_recorded.pose_offsets is None
    assert aligned.validation_psnr_db[-1] > as_recorded.validation_psnr_db[-1] + 2.0


def test_poses_stay_where_validation_prefers_them(
    egg: Mesh, egg_body: Body, egg_views: Views, monkeypatch: pytest.MonkeyPatch
) -> None:
    inputs = disturbed_inputs(egg_body, egg_views)
    worse = PoseOffsets(torch.full((len(egg_views[0]), 1, 3), 0.3), torch.zeros(len(egg_views[0]), 3))
    monkeypatch.setattr(refinement_module, "align_poses", lambda *_: worse)
    assert refine_mesh(egg, inputs).pose_offsets is None
