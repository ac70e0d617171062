"""Rotations against SciPy, axioms of the rotation group, and the smallest rotation between two directions."""

import numpy as np
import pytest
import torch
from hypothesis import assume, given, settings
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from pipeline.geometry import rotation as rot

vectors = st.lists(st.floats(-3.0, 3.0), min_size=3, max_size=3).map(lambda v: torch.tensor([v], dtype=torch.float64))


def to_scipy(quaternion_wxyz: torch.Tensor) -> Rotation:
    return Rotation.from_quat(quaternion_wxyz.numpy()[:, [1, 2, 3, 0]])


@settings(max_examples=50)
@given(vectors)
def test_exponential_map_agrees_with_scipy(axis_angle: torch.Tensor) -> None:
    expected = Rotation.from_rotvec(axis_angle.numpy()).as_matrix()
    np.testing.assert_allclose(rot.axis_angle_to_matrix(axis_angle).numpy(), expected, atol=1e-9)


@settings(max_examples=50)
@given(vectors, vectors)
def test_product_applies_the_right_factor_first(first: torch.Tensor, second: torch.Tensor) -> None:
    product = rot.quaternion_multiply(rot.axis_angle_to_quaternion(second), rot.axis_angle_to_quaternion(first))
    expected = rot.axis_angle_to_matrix(second) @ rot.axis_angle_to_matrix(first)
    torch.testing.assert_close(rot.quaternion_to_matrix(product), expected, atol=1e-9, rtol=0)


@settings(max_examples=50)
@given(vectors)
def test_matrix_and_quaternion_are_inverse(axis_angle: torch.Tensor) -> None:
    matrix = rot.axis_angle_to_matrix(axis_angle)
    quaternion = rot.matrix_to_quaternion(matrix)
    assert quaternion[0, 0] >= 0
    torch.testing.assert_close(rot.quaternion_to_matrix(quaternion), matrix, atol=1e-9, rtol=0)


@settings(max_examples=50)
@given(vectors)
def test_logarithm_map_inverts_the_exponential_map(axis_angle: torch.Tensor) -> None:
    quaternion = rot.axis_angle_to_quaternion(axis_angle)
    again = rot.axis_angle_to_quaternion(rot.quaternion_to_axis_angle(quaternion))
    torch.testing.assert_close(rot.quaternion_to_matrix(again), rot.quaternion_to_matrix(quaternion), atol=1e-7, rtol=0)


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
@pytest.mark.parametrize("angle_rad", [0.0, 1e-30, 1e-9, 1e-4, 1.0, 3.1, 3.2, 6.2])
def test_logarithm_map_agrees_with_scipy(angle_rad: float, dtype: torch.dtype) -> None:
    half = torch.tensor(0.5 * angle_rad, dtype=torch.float64)
    axis = torch.tensor([[0.48, -0.6, 0.64]], dtype=torch.float64)
    quaternion = torch.cat([half.cos().view(1, 1), half.sin() * axis], dim=1)
    expected = to_scipy(quaternion).as_rotvec()
    given = rot.quaternion_to_axis_angle(quaternion.to(dtype)).numpy()
    np.testing.assert_allclose(given, expected, atol=2e-6 * angle_rad if dtype == torch.float32 else 1e-14 * angle_rad)


@pytest.mark.parametrize("angle_rad", [1e-9, 1e-4, 0.0099, 0.0101, 1.0])
def test_small_angles_are_as_accurate_as_large_ones(angle_rad: float) -> None:
    axis = torch.tensor([[0.48, -0.6, 0.64]], dtype=torch.float64)
    expected = Rotation.from_rotvec(angle_rad * axis.numpy()).as_matrix()
    np.testing.assert_allclose(rot.axis_angle_to_matrix(angle_rad * axis).numpy(), expected, atol=1e-15)
    single = rot.axis_angle_to_matrix((angle_rad * axis).float())
    np.testing.assert_allclose(single.numpy(), expected, atol=3e-7)


@pytest.mark.parametrize("angle_rad", [0.0, 0.009, 0.011, 0.5, 3.0])
def test_gradients_equal_finite_differences(angle_rad: float) -> None:
    turn = (angle_rad * torch.tensor([[0.48, -0.6, 0.64]], dtype=torch.float64)).requires_grad_(True)
    assert torch.autograd.gradcheck(rot.axis_angle_to_matrix, (turn,))


def test_slerp_follows_the_shorter_arc_at_constant_speed() -> None:
    start = rot.axis_angle_to_quaternion(torch.tensor([[0.0, 0.2, 0.0]]))
    end = -rot.axis_angle_to_quaternion(torch.tensor([[0.0, 1.0, 0.0]]))  # the same rotation with the opposite sign
    quarter = rot.slerp(start, end, torch.tensor([[0.25]]))
    expected = rot.axis_angle_to_matrix(torch.tensor([[0.0, 0.4, 0.0]]))
    torch.testing.assert_close(rot.quaternion_to_matrix(quarter), expected, atol=1e-5, rtol=0)


def test_continuous_quaternions_remove_sign_flips_only() -> None:
    angles = torch.linspace(0, 6, 40)[:, None] * torch.tensor([[0.0, 1.0, 0.0]])
    smooth = rot.axis_angle_to_quaternion(angles)
    flipped = smooth * torch.tensor([1.0, -1.0]).repeat(20)[:, None]
    torch.testing.assert_close(rot.continuous_quaternions(flipped), smooth)


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_matrices_of_random_quaternions_are_rotations(dtype: torch.dtype) -> None:
    quaternion = torch.randn(10, 4, dtype=dtype, generator=torch.Generator().manual_seed(0))
    matrix = rot.quaternion_to_matrix(quaternion)
    torch.testing.assert_close(matrix @ matrix.mT, torch.eye(3, dtype=dtype).expand(10, 3, 3))
    torch.testing.assert_close(torch.linalg.det(matrix), torch.ones(10, dtype=dtype))
    np.testing.assert_allclose(to_scipy(rot.matrix_to_quaternion(matrix)).as_matrix(), matrix, atol=1e-6)


coordinates = st.floats(-1.0, 1.0, allow_nan=False)
directions = st.tuples(coordinates, coordinates, coordinates).filter(lambda d: sum(c * c for c in d) > 0.01)


@given(start=directions, end=directions)
def test_rotation_between_takes_start_to_end(start: tuple[float, ...], end: tuple[float, ...]) -> None:
    a, b = torch.tensor(start, dtype=torch.float64), torch.tensor(end, dtype=torch.float64)
    rotation = rot.rotation_between(a, b)
    assert torch.allclose(rotation @ a / a.norm(), b / b.norm(), atol=1e-6)
    assert torch.allclose(rotation @ rotation.T, torch.eye(3, dtype=torch.float64), atol=1e-9)
    assert torch.linalg.det(rotation) == pytest.approx(1.0)


@given(start=directions, end=directions)
def test_rotation_between_has_the_angle_between_the_directions(
    start: tuple[float, ...], end: tuple[float, ...]
) -> None:
    a, b = torch.tensor(start, dtype=torch.float64), torch.tensor(end, dtype=torch.float64)
    cosine = torch.dot(a, b) / (a.norm() * b.norm())
    assume(abs(cosine) < 0.999)
    angle_rad = torch.arccos(((torch.trace(rot.rotation_between(a, b)) - 1) / 2).clamp(-1, 1))
    assert angle_rad == pytest.approx(torch.arccos(cosine).item(), abs=1e-6)


@pytest.mark.parametrize("axis", [0, 1, 2])
def test_rotation_between_opposite_directions(axis: int) -> None:
    start = torch.zeros(3)
    start[axis] = 2.0
    assert torch.allclose(rot.rotation_between(start, -start) @ start, -start, atol=1e-5)


def test_rotation_between_the_x_and_y_axes_is_a_quarter_turn_about_z() -> None:
    x, y = torch.tensor([2.0, 0.0, 0.0]), torch.tensor([0.0, 0.5, 0.0])
    quarter_turn = rot.axis_angle_to_matrix(torch.tensor([0.0, 0.0, np.pi / 2]))
    assert torch.allclose(rot.rotation_between(x, y), quarter_turn, atol=1e-6)
    assert torch.allclose(rot.rotation_between(x, x), torch.eye(3))
