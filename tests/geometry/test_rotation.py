"""Rotations against scipy's, and the axioms of a group."""

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from pipeline.geometry import rotation as rot

vectors = st.lists(st.floats(-3.0, 3.0), min_size=3, max_size=3).map(lambda v: torch.tensor([v], dtype=torch.float64))


def to_scipy(quaternion_wxyz: torch.Tensor) -> Rotation:
    return Rotation.from_quat(quaternion_wxyz.numpy()[:, [1, 2, 3, 0]])


@settings(max_examples=50)
@given(vectors)
def test_exponential_agrees_with_scipy(axis_angle: torch.Tensor) -> None:
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
def test_logarithm_undoes_the_exponential(axis_angle: torch.Tensor) -> None:
    quaternion = rot.axis_angle_to_quaternion(axis_angle)
    again = rot.axis_angle_to_quaternion(rot.quaternion_to_axis_angle(quaternion))
    torch.testing.assert_close(rot.quaternion_to_matrix(again), rot.quaternion_to_matrix(quaternion), atol=1e-7, rtol=0)


@pytest.mark.parametrize("angle_rad", [1e-9, 1e-4, 0.0099, 0.0101, 1.0])
def test_small_angles_are_as_exact_as_large_ones(angle_rad: float) -> None:
    axis = torch.tensor([[0.48, -0.6, 0.64]], dtype=torch.float64)
    expected = Rotation.from_rotvec(angle_rad * axis.numpy()).as_matrix()
    np.testing.assert_allclose(rot.axis_angle_to_matrix(angle_rad * axis).numpy(), expected, atol=1e-15)
    single = rot.axis_angle_to_matrix((angle_rad * axis).float())
    np.testing.assert_allclose(single.numpy(), expected, atol=3e-7)


@pytest.mark.parametrize("angle_rad", [0.0, 0.009, 0.011, 0.5, 3.0])
def test_gradients_are_those_of_differences(angle_rad: float) -> None:
    turn = (angle_rad * torch.tensor([[0.48, -0.6, 0.64]], dtype=torch.float64)).requires_grad_(True)
    assert torch.autograd.gradcheck(rot.axis_angle_to_matrix, (turn,))


def test_slerp_walks_the_shorter_arc_at_constant_speed() -> None:
    start = rot.axis_angle_to_quaternion(torch.tensor([[0.0, 0.2, 0.0]]))
    end = -rot.axis_angle_to_quaternion(torch.tensor([[0.0, 1.0, 0.0]]))  # the same rotation, other hemisphere
    quarter = rot.slerp(start, end, torch.tensor([[0.25]]))
    expected = rot.axis_angle_to_matrix(torch.tensor([[0.0, 0.4, 0.0]]))
    torch.testing.assert_close(rot.quaternion_to_matrix(quarter), expected, atol=1e-5, rtol=0)


def test_continuous_quaternions_remove_sign_flips_only() -> None:
    angles = torch.linspace(0, 6, 40)[:, None] * torch.tensor([[0.0, 1.0, 0.0]])
    smooth = rot.axis_angle_to_quaternion(angles)
    flipped = smooth * torch.tensor([1.0, -1.0]).repeat(20)[:, None]
    torch.testing.assert_close(rot.continuous_quaternions(flipped), smooth)


def test_six_d_gives_proper_rotations() -> None:
    matrix = rot.six_d_to_matrix(torch.randn(10, 6, dtype=torch.float64))
    torch.testing.assert_close(matrix @ matrix.mT, torch.eye(3, dtype=torch.float64).expand(10, 3, 3))
    torch.testing.assert_close(torch.linalg.det(matrix), torch.ones(10, dtype=torch.float64))
    assert to_scipy(rot.matrix_to_quaternion(matrix)).as_matrix().shape == (10, 3, 3)
