"""From density to mesh: analytic densities around a small stick body, hollow insides, floaters, hands, skin weights."""

import numpy as np
import pytest
import torch
from torch import Tensor

from pipeline.body.body import Body
from pipeline.core.progress import take_warnings
from pipeline.geometry.mesh import Mesh
from pipeline.geometry.surface import OpenSurfaceError, is_closed_manifold, isosurface
from pipeline.mesh import isosurface as extract_module
from pipeline.mesh.isosurface import (
    ExtractConfig,
    extract_mesh,
    hand_skin_weights,
    indicator_grid,
    sample_canonical_grid,
    select_isovalue,
    simplify,
    transfer_skin_weights,
)

CONFIG = ExtractConfig(voxel_size_m=0.02, max_body_distance_m=0.12, solid_core_depth_m=0.05)
SEGMENTS = {"Hips": (-0.25, 0.05), "RightHand": (0.05, 0.3)}
RADIUS_M = 0.1


def capsule_distance(points: np.ndarray, low_x: float = -0.25, high_x: float = 0.3) -> np.ndarray:
    along = np.clip(points[..., 0], low_x, high_x)
    nearest = np.stack([along, np.full_like(along, 0.5), np.zeros_like(along)], axis=-1)
    return np.linalg.norm(points - nearest, axis=-1)


@pytest.fixture(scope="module")
def body() -> Body:
    """A lying capsule of radius 0.1 m with two joints; the right end is a hand."""
    axis = np.arange(-0.45, 0.5001, 0.025)
    points = np.stack(np.meshgrid(axis, axis + 0.5, axis, indexing="ij"), axis=-1)
    mesh = isosurface(RADIUS_M - capsule_distance(points), 0.0, np.array([axis[0], axis[0] + 0.5, axis[0]]), 0.025)
    share = np.clip((mesh.vertices[:, 0] - 0.0) / 0.1, 0.0, 1.0)
    return Body(
        joint_names=("Hips", "RightHand"),
        parents=np.array([-1, 0], dtype=np.int32),
        joints_m=np.array([[0.0, 0.5, 0.0], [0.05, 0.5, 0.0]], dtype=np.float32),
        vertices=mesh.vertices,
        faces=mesh.faces,
        skin_weights=np.stack([1.0 - share, share], axis=1).astype(np.float32),
        shape={},
    )


def shell(points: Tensor) -> Tensor:
    """A clothed capsule, 0.03 m outside the body, hollow inside, with a floater and a hand that is too thick."""
    distance = torch.from_numpy(capsule_distance(points.numpy().astype(np.float64)))
    density = torch.where((distance - 0.11).abs() < 0.03, 300.0, 0.0)
    floater = (points - torch.tensor([-0.25, 0.5, 0.2])).norm(dim=1) < 0.03
    return torch.where(floater, 300.0, density).float()


def test_hollow_density_becomes_one_solid_of_its_outer_surface(body: Body) -> None:
    samples = sample_canonical_grid(shell, body, CONFIG.model_copy(update={"hands_from_body": False}))
    mesh = extract_mesh(samples, 50.0, CONFIG)
    assert is_closed_manifold(mesh)
    assert len(mesh.vertices) - len(mesh.faces) // 2 == 2  # a sphere's topology: no floater, no inner shell
    np.testing.assert_allclose(capsule_distance(mesh.vertices), 0.14, atol=0.016)


def test_where_the_field_saw_nothing_the_body_core_closes_the_surface(body: Body) -> None:
    config = CONFIG.model_copy(update={"hands_from_body": False, "voxel_size_m": 0.01})
    mesh = extract_mesh(sample_canonical_grid(lambda points: torch.zeros(len(points)), body, config), 50.0, config)
    assert is_closed_manifold(mesh)
    # the depth is counted in voxels of double size: half of one is 0.01
    np.testing.assert_allclose(capsule_distance(mesh.vertices), RADIUS_M - CONFIG.solid_core_depth_m, atol=0.015)


def test_hands_come_from_the_body(body: Body) -> None:
    samples = sample_canonical_grid(shell, body, CONFIG)
    mesh = extract_mesh(samples, 50.0, CONFIG)
    hand, trunk = (
        capsule_distance(mesh.vertices[part]) for part in (mesh.vertices[:, 0] > 0.2, mesh.vertices[:, 0] < -0.1)
    )
    np.testing.assert_allclose(hand, RADIUS_M, atol=0.01)
    np.testing.assert_allclose(trunk, 0.14, atol=0.016)


def test_pits_inside_the_body_are_filled_and_hollows_outside_it_are_not(body: Body) -> None:
    """A bore of 4 cm through the trunk goes; the same bore through a second, thicker layer of clothes stays open."""

    def bored(points: Tensor) -> Tensor:
        distance = torch.from_numpy(capsule_distance(points.numpy().astype(np.float64)))
        bore = (points[:, [0, 2]] - torch.tensor([-0.15, 0.0])).norm(dim=1) < 0.02
        return torch.where((distance < 0.16) & ~bore, 300.0, 0.0).float()

    config = CONFIG.model_copy(
        update={"hands_from_body": False, "voxel_size_m": 0.01, "solid_core_depth_m": 0.2, "blur_sigma_voxels": 0.0}
    )
    samples = sample_canonical_grid(bored, body, config)
    column = ((np.array([-0.15, 0.5, 0.0]) - samples.origin_m) / 0.01).round().astype(int)
    heights = samples.origin_m[1] + 0.01 * np.arange(samples.density.shape[1]) - 0.5
    for closing_radius_m, bottom in ((0.04, RADIUS_M), (0.0, 0.0)):
        value = indicator_grid(samples, 50.0, config.model_copy(update={"closing_radius_m": closing_radius_m}))[
            column[0], :, column[2]
        ]
        assert (value[np.abs(heights) < bottom - 0.015] >= 0.5).all()
        assert (value[np.abs(heights) > bottom + 0.015] < 0.5).all()


def test_hand_weights_count_every_joint_of_a_hand(body: Body) -> None:
    weights = hand_skin_weights(body)
    assert weights.min() == 0.0
    assert weights.max() == 1.0


def test_samples_hold_density_only_within_reach(body: Body) -> None:
    asked = []

    def everywhere(points: Tensor) -> Tensor:
        asked.append(points)
        return torch.full((len(points),), 9.0)

    samples = sample_canonical_grid(everywhere, body, CONFIG)
    distance = capsule_distance(torch.cat(asked).numpy()) - RADIUS_M
    assert distance.max() < CONFIG.max_body_distance_m + 0.01
    assert (samples.density[samples.body_distance_m > CONFIG.max_body_distance_m] == 0).all()
    assert indicator_grid(samples, 3.0, CONFIG).max() <= 1.0


def test_distance_is_exact_at_the_hand_and_interpolated_elsewhere(body: Body) -> None:
    samples = sample_canonical_grid(shell, body, CONFIG)
    index = np.stack(np.meshgrid(*map(np.arange, samples.density.shape), indexing="ij"), axis=-1)
    truth = capsule_distance(index * samples.spacing_m + samples.origin_m) - RADIUS_M
    hand = (np.abs(truth) < 0.04) & (samples.hand_weight > 0)
    assert hand.sum() > 1000
    np.testing.assert_allclose(samples.body_distance_m[hand], truth[hand], atol=0.006)
    beyond = (truth > 0.05) & (truth < 0.12)
    np.testing.assert_allclose(samples.body_distance_m[beyond], truth[beyond], atol=0.03)


def test_the_level_that_scores_best_is_chosen(body: Body) -> None:
    def ramp(points: Tensor) -> Tensor:
        distance = torch.from_numpy(capsule_distance(points.numpy().astype(np.float64))).float()
        return 100.0 * torch.exp((0.12 - distance) / 0.02)

    samples = sample_canonical_grid(ramp, body, CONFIG.model_copy(update={"hands_from_body": False}))

    def score(mesh: Mesh) -> float:
        return -abs(float(np.median(capsule_distance(mesh.vertices))) - 0.12)

    level, best = select_isovalue(samples, CONFIG, (1600.0, 400.0, 100.0, 25.0), score)
    assert level == 100.0
    assert best > -0.01


def test_nothing_at_all_is_an_error_of_the_surface(body: Body) -> None:
    config = CONFIG.model_copy(update={"solid_core_depth_m": 0.2, "hands_from_body": False})
    samples = sample_canonical_grid(lambda points: torch.zeros(len(points)), body, config)
    with pytest.raises(ValueError, match="reaches the level"):
        extract_mesh(samples, 50.0, config)


def test_simplify_reaches_the_edge_length(body: Body) -> None:
    samples = sample_canonical_grid(shell, body, CONFIG)
    fine = extract_mesh(samples, 50.0, CONFIG)
    mesh = simplify(fine, 0.04)
    lengths = np.linalg.norm(np.diff(mesh.vertices[mesh.edges()], axis=1), axis=2)
    assert np.median(lengths) == pytest.approx(0.04, rel=0.25)
    assert is_closed_manifold(mesh)


@pytest.mark.parametrize(
    ("failing_function", "expected_warning"),
    [("remesh_isotropic", "stay uneven"), ("repair", "not reduced before remeshing")],
)
def test_a_step_of_simplifying_that_tears_the_surface_is_left_out(
    body: Body, monkeypatch: pytest.MonkeyPatch, failing_function: str, expected_warning: str
) -> None:
    fine = extract_mesh(sample_canonical_grid(shell, body, CONFIG), 50.0, CONFIG)

    def tear(*_: object, **__: object) -> Mesh:
        raise OpenSurfaceError("a surface could not be closed: its holes border on each other")

    monkeypatch.setattr(extract_module, failing_function, tear)
    take_warnings()
    mesh = simplify(fine, 0.05)
    assert is_closed_manifold(mesh)
    assert len(mesh.faces) < len(fine.faces)  # the other step still makes triangles larger
    (warning,) = take_warnings()
    assert expected_warning in warning


def test_weights_of_the_body_itself_are_kept(body: Body) -> None:
    weights = transfer_skin_weights(body.mesh(), body, smoothing=0)
    np.testing.assert_allclose(weights, body.skin_weights, atol=1e-5)


def test_weights_do_not_jump_across_a_gap() -> None:
    """A trunk and an arm hang side by side; a sleeve's inner side is nearer to the trunk yet must follow the arm."""
    trunk = isosurface(*tube_values((0.0, 0.0)))
    arm = isosurface(*tube_values((0.24, 0.0)))
    body = Body(
        joint_names=("Hips", "LeftArm"),
        parents=np.array([-1, 0], dtype=np.int32),
        joints_m=np.zeros((2, 3), dtype=np.float32),
        vertices=np.concatenate([trunk.vertices, arm.vertices]),
        faces=np.concatenate([trunk.faces, arm.faces + len(trunk.vertices)]).astype(np.int32),
        skin_weights=np.repeat(np.eye(2, dtype=np.float32), [len(trunk.vertices), len(arm.vertices)], axis=0),
        shape={},
    )
    sleeve = isosurface(*tube_values((0.24, 0.0), radius=0.14))
    inner = sleeve.vertices[:, 0] < 0.12
    naive = np.linalg.norm(sleeve.vertices[inner][:, [0, 2]], axis=1) - 0.08 < 0.06
    assert naive.any()  # some of it is nearer to the trunk than to the arm
    weights = transfer_skin_weights(sleeve, body)
    assert weights[:, 1].min() > 0.99
    np.testing.assert_allclose(weights.sum(axis=1), 1.0, atol=1e-6)


def tube_values(centre_xz: tuple[float, float], radius: float = 0.08) -> tuple[np.ndarray, float, np.ndarray, float]:
    """Arguments of `isosurface` for a vertical capsule."""
    origin = np.array([centre_xz[0] - 0.2, -0.5, centre_xz[1] - 0.2])
    index = np.stack(np.meshgrid(np.arange(21), np.arange(51), np.arange(21), indexing="ij"), axis=-1)
    points = origin + 0.02 * index - np.array([centre_xz[0], 0.0, centre_xz[1]])
    points[..., 1] -= np.clip(points[..., 1], -0.25, 0.25)
    return radius - np.linalg.norm(points, axis=-1), 0.0, origin, 0.02
