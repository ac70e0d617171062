"""Texture lookups: the compiled loop against the reference, and against known texels."""

import pytest
import torch

from pipeline.kernels.raster import rasterize
from pipeline.kernels.texture_sampling import supersample_attributes, supersample_texture
from pipeline.kernels.texture_sampling.reference import supersample_attributes_reference


def random_raster(samples: int, seed: int) -> tuple[torch.Tensor, ...]:
    """Random triangles in an image of 24 x 32 pixels, with random uv, some outside [0, 1]."""
    generator = torch.Generator().manual_seed(seed)
    corners = torch.rand(30, 2, generator=generator) * torch.tensor([32.0, 24.0]) * samples
    depth = 1.0 + torch.rand(30, generator=generator)
    faces = torch.randint(0, 30, (20, 3), generator=generator, dtype=torch.int32)
    face_id, barycentric, _ = rasterize(corners, depth, faces, 24 * samples, 32 * samples)
    uv = 1.4 * torch.rand(40, 2, generator=generator) - 0.2
    faces_uv = torch.randint(0, 40, (20, 3), generator=generator, dtype=torch.int32)
    return face_id, barycentric, faces_uv, uv, torch.rand(9, 13, 3, generator=generator)


@pytest.mark.parametrize(("samples", "seed"), [(1, 0), (2, 1), (3, 2)])
def test_compiled_lookup_matches_reference(samples: int, seed: int) -> None:
    face_id, *rest = random_raster(samples, seed)
    fast = supersample_texture(face_id, *rest, samples)
    exact = supersample_texture(face_id, *(x.double() if x.is_floating_point() else x for x in rest), samples)
    assert 0.2 < float(exact[..., 3].mean()) < 0.99
    # In float32 a lookup is accurate to 1e-6 of a texture of 13 texels, whose neighbours differ by up to 1.
    torch.testing.assert_close(fast, exact.float(), atol=5e-5, rtol=0.0)


def test_one_pixel_is_the_mean_of_four_texels() -> None:
    texture = torch.tensor([[[1.0], [0.0]], [[0.0], [0.0]]])
    face_id = torch.tensor([[0, 0], [0, -1]], dtype=torch.int32)
    barycentric = torch.tensor([[[1.0, 0, 0], [0, 1.0, 0]], [[0, 0, 1.0], [0, 0, 0]]])
    uv = torch.tensor([[0.25, 0.75], [0.75, 0.75], [0.25, 0.25]])
    image = supersample_texture(
        face_id, barycentric, torch.tensor([[0, 1, 2]], dtype=torch.int32), uv, texture, samples=2
    )
    assert image.tolist() == [[[0.25, 0.75]]]


def test_texture_gradient_when_required() -> None:
    face_id, barycentric, faces_uv, uv, texture = random_raster(2, 3)
    inputs = (barycentric.double(), faces_uv, uv.double(), texture.double().requires_grad_())
    assert torch.autograd.gradcheck(
        lambda t: supersample_texture(face_id, *inputs[:3], t, 2).sum(dim=(0, 1)), inputs[3]
    )
    single = texture.clone().requires_grad_()
    assert supersample_texture(face_id, barycentric, faces_uv, uv, single, 2).requires_grad


@pytest.mark.parametrize(("samples", "seed"), [(1, 4), (2, 5), (3, 6)])
def test_compiled_mean_of_attributes_matches_reference(samples: int, seed: int) -> None:
    face_id, barycentric, faces, _, _ = random_raster(samples, seed)
    values = torch.rand(40, 4, generator=torch.Generator().manual_seed(seed))
    fast = supersample_attributes(face_id, barycentric, faces, values, samples)
    exact = supersample_attributes_reference(face_id, barycentric.double(), faces, values.double(), samples)
    torch.testing.assert_close(fast, exact.float(), atol=2e-6, rtol=0.0)


def test_mean_of_attributes_counts_covered_points_only() -> None:
    face_id = torch.tensor([[0, -1, -1, -1], [0, -1, -1, -1]], dtype=torch.int32)
    barycentric = torch.zeros(2, 4, 3)
    barycentric[0, 0], barycentric[1, 0] = torch.tensor([1.0, 0, 0]), torch.tensor([0, 0.5, 0.5])
    faces = torch.tensor([[0, 1, 2]], dtype=torch.int32)
    image = supersample_attributes(face_id, barycentric, faces, torch.tensor([[1.0], [2.0], [4.0]]), 2)
    assert image.tolist() == [[[2.0], [0.0]]]
