"""Forward kinematics: the compiled loops against the reference in float64, in values and gradients."""

import math

import torch

from pipeline.kernels.kinematics import FittedPoses, Skeleton, reference, skinning_matrices

FRAMES = 3
PARENTS = torch.tensor([-1, 0, 1, 1, 3])
CORRECTION_ROW = torch.tensor([0, -1, 1, 2, -1])


def random_rotations(*shape: int, random: torch.Generator) -> torch.Tensor:
    rotations = torch.linalg.qr(torch.randn(*shape, 3, 3, generator=random, dtype=torch.float64))[0]
    return rotations * torch.linalg.det(rotations)[..., None, None]


def inputs(dtype: torch.dtype) -> tuple[torch.Tensor, torch.Tensor, Skeleton, FittedPoses]:
    random = torch.Generator().manual_seed(0)
    joints_m = torch.randn(5, 3, generator=random, dtype=torch.float64)
    world_to_posed = torch.eye(4, dtype=torch.float64).repeat(FRAMES, 1, 1)
    world_to_posed[:, :3, :3] = random_rotations(FRAMES, random=random)
    world_to_posed[:, :3, 3] = torch.randn(FRAMES, 3, generator=random, dtype=torch.float64)
    rotations = random_rotations(FRAMES, 5, random=random)
    root_m = torch.randn(FRAMES, 3, generator=random, dtype=torch.float64)
    axis_angles = 0.4 * torch.randn(FRAMES, 3, 3, generator=random, dtype=torch.float64)
    axis_angles[0, 0] *= 1e-3  # the series near zero
    shift_m = 0.1 * torch.randn(FRAMES, 3, generator=random, dtype=torch.float64)
    leaves = (axis_angles.to(dtype).requires_grad_(), shift_m.to(dtype).requires_grad_())
    fitted = FittedPoses(rotations.to(dtype), root_m.to(dtype), world_to_posed.to(dtype))
    return *leaves, Skeleton(joints_m.to(dtype), PARENTS, CORRECTION_ROW), fitted


def test_values_and_gradients_match_reference() -> None:
    grad_output = torch.randn(FRAMES, 5, 4, 4, generator=torch.Generator().manual_seed(1), dtype=torch.float64)
    results = []
    for dtype in (torch.float32, torch.float64):
        axis_angles, shift_m, skeleton, fitted = inputs(dtype)
        matrices = skinning_matrices(axis_angles, shift_m, skeleton, fitted)
        gradients = torch.autograd.grad((matrices * grad_output.to(dtype)).sum(), (axis_angles, shift_m))
        results.append([matrices.detach().double(), *(gradient.double() for gradient in gradients)])
    for single, double in zip(*results, strict=True):
        torch.testing.assert_close(single, double, atol=2e-5, rtol=1e-5)


def test_reference_passes_gradcheck() -> None:
    axis_angles, shift_m, skeleton, fitted = inputs(torch.float64)
    assert torch.autograd.gradcheck(
        lambda a, s: reference.skinning_matrices(a, s, skeleton, fitted), (axis_angles, shift_m)
    )


def test_correction_rotates_a_child_about_its_parent() -> None:
    """Two joints along x; the root rotates by 90 degrees about z: a point at the child moves to the y axis."""
    joints_m, identity = torch.tensor([[0.0, 0.0, 0.0], [1.0, 0.0, 0.0]]), torch.eye(3).expand(1, 2, 3, 3).contiguous()
    skeleton = Skeleton(joints_m, torch.tensor([-1, 0]), torch.tensor([0, -1]))
    fitted = FittedPoses(identity, torch.zeros(1, 3), torch.eye(4)[None].contiguous())
    turn = torch.tensor([[[0.0, 0.0, math.pi / 2]]])
    for dtype in (torch.float32, torch.float64):
        matrices = skinning_matrices(turn.to(dtype), torch.zeros(1, 3, dtype=dtype), skeleton, fitted)
        point = matrices[0, 1] @ torch.tensor([1.0, 0.0, 0.0, 1.0], dtype=dtype)
        torch.testing.assert_close(point, torch.tensor([0.0, 1.0, 0.0, 1.0], dtype=dtype), atol=1e-6, rtol=0)
