"""Interpolation: compiled loop against reference in values and gradients, reference against finite differences."""

import pytest
import torch
from torch import Tensor

from pipeline.kernels.interpolate import interpolate
from pipeline.kernels.interpolate.reference import interpolate_reference
from pipeline.kernels.raster import rasterize

HEIGHT, WIDTH = 31, 45


def scene(channels: int, seed: int) -> tuple[Tensor, ...]:
    """A crumpled triangle mesh at depths of 1 to 2 m, as arguments of `interpolate`."""
    generator = torch.Generator().manual_seed(seed)
    y, x = torch.meshgrid(torch.arange(7.0), torch.arange(9.0), indexing="ij")
    grid = torch.stack([x.reshape(-1) * 6.0, y.reshape(-1) * 5.5], dim=1)
    vertices_px = grid + 2.0 * torch.rand(63, 2, generator=generator)
    depth_m = 1.0 + torch.rand(63, generator=generator)
    corner = (9 * torch.arange(6)[:, None] + torch.arange(8)).reshape(-1, 1)
    faces = torch.cat([corner + torch.tensor([0, 9, 1]), corner + torch.tensor([1, 9, 10])]).int()
    face_id = rasterize(vertices_px, depth_m, faces, HEIGHT, WIDTH)[0].reshape(-1)
    covered = torch.nonzero(face_id >= 0).squeeze(1)
    attributes = torch.randn(63, channels, generator=generator)
    return covered, face_id[covered], vertices_px, depth_m, faces, attributes


@pytest.mark.parametrize("channels", [1, 3, 6])
def test_values_and_gradients_match_reference(channels: int) -> None:
    covered, face_ids, *floats, faces, attributes = scene(channels, seed=channels)
    upstream = torch.randn(len(covered), channels, generator=torch.Generator().manual_seed(9))
    results = []
    for run in (interpolate, interpolate_reference):
        inputs = [tensor.clone().requires_grad_() for tensor in (*floats, attributes)]
        values = run(covered, face_ids, WIDTH, inputs[0], inputs[1], faces, inputs[2])
        results.append((values.detach(), *torch.autograd.grad((values * upstream).sum(), inputs)))
    assert len(covered) > 1000
    for name, fast, plain in zip(("values", "vertices", "depth", "attributes"), *results, strict=True):
        # The reference runs in float32, the kernel in float64 inside: thin faces magnify the rounding of the reference.
        scale = float(plain.abs().max())
        torch.testing.assert_close(fast, plain, rtol=1e-3, atol=1e-4 * scale, msg=lambda m, name=name: f"{name}: {m}")


def test_reference_gradients_equal_finite_differences() -> None:
    covered, face_ids, vertices_px, depth_m, faces, attributes = scene(2, seed=0)
    some = slice(None, None, 90)
    inputs = [tensor.double().requires_grad_() for tensor in (vertices_px, depth_m, attributes)]

    def values(points: Tensor, depth: Tensor, colours: Tensor) -> Tensor:
        return interpolate(covered[some], face_ids[some], WIDTH, points, depth, faces, colours)

    assert torch.autograd.gradcheck(values, inputs, eps=1e-6, atol=1e-6)


def test_gradients_are_bitwise_reproducible() -> None:
    covered, face_ids, vertices_px, depth_m, faces, attributes = scene(3, seed=4)
    gradients = []
    for _ in range(3):
        points = vertices_px.clone().requires_grad_()
        interpolate(covered, face_ids, WIDTH, points, depth_m, faces, attributes).square().sum().backward()
        gradients.append(points.grad.numpy().tobytes())
    assert len(set(gradients)) == 1


def test_no_covered_pixels_gives_empty_output() -> None:
    _, _, vertices_px, depth_m, faces, attributes = scene(3, seed=1)
    none = torch.zeros(0, dtype=torch.int64)
    assert interpolate(none, none.int(), WIDTH, vertices_px, depth_m, faces, attributes).shape == (0, 3)
