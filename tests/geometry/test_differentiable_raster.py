"""Differentiable rendering: adjacency, known colours, gradients against finite differences, a fit that converges."""

import numpy as np
import pytest
import torch
from torch import Tensor

from pipeline.geometry.camera import Camera
from pipeline.geometry.differentiable_raster import face_adjacency, render_attributes, render_shaded

CAMERA = Camera(60.0, 60.0, 24.0, 20.0, 48, 40)


def square(depth_m: float, half_m: float, dtype: torch.dtype = torch.float64) -> tuple[Tensor, Tensor]:
    """A square perpendicular to the viewing direction, facing the camera."""
    corners = torch.tensor([[-1.0, -1.0], [1.0, -1.0], [1.0, 1.0], [-1.0, 1.0]], dtype=dtype) * half_m
    return torch.cat([corners, torch.full((4, 1), -depth_m, dtype=dtype)], 1), torch.tensor([[0, 1, 2], [0, 2, 3]])


def test_adjacency_of_two_triangles_and_of_an_edge_with_three_faces() -> None:
    assert face_adjacency(torch.tensor([[0, 1, 2], [0, 2, 3]])).tolist() == [[-1, -1, 1], [0, -1, -1]]
    fin = torch.tensor([[0, 1, 2], [1, 0, 3], [0, 1, 4]])
    assert face_adjacency(fin).tolist() == [[-1] * 3] * 3  # three faces at one edge: the neighbour is not unique


def test_adjacency_is_mutual_on_a_closed_mesh() -> None:
    faces = torch.tensor([[0, 2, 1], [0, 1, 3], [1, 2, 3], [2, 0, 3]], dtype=torch.int32)
    adjacency = face_adjacency(faces)
    assert (adjacency >= 0).all()
    for face in range(4):
        for edge in range(3):
            shared = {int(faces[face, edge]), int(faces[face, (edge + 1) % 3])}
            assert shared <= set(faces[adjacency[face, edge]].tolist())


def test_area_and_colour_of_a_square() -> None:
    vertices, faces = square(2.0, 0.5)
    colours = torch.full((4, 3), 0.25, dtype=torch.float64)
    image, alpha = render_attributes(vertices, faces, CAMERA, colours)
    assert float(alpha.sum()) == pytest.approx(30.0 * 30.0, rel=1e-6)
    torch.testing.assert_close(image, 0.25 * alpha[..., None].expand_as(image))


def test_interpolation_is_perspective_correct() -> None:
    """With the world position as attribute on a slanted plane, each pixel's value projects back to that pixel."""
    vertices, faces = square(2.0, 0.6)
    vertices[:, 2] -= 1.2 * vertices[:, 0]
    image, alpha = render_attributes(vertices, faces, CAMERA, vertices)
    inside = (alpha == 1.0) & (torch.nn.functional.avg_pool2d(alpha[None, None], 3, 1, 1)[0, 0] == 1.0)
    back_x = 60.0 * image[..., 0] / -image[..., 2] + 24.0
    expected = (torch.arange(48) + 0.5).expand(40, 48).double()
    assert inside.sum() > 300
    torch.testing.assert_close(back_x[inside], expected[inside], rtol=0, atol=1e-9)


def test_image_is_linear_in_attributes_and_the_shader_is_called_once() -> None:
    vertices, faces = square(2.0, 0.5)
    calls = []

    def shader(values: Tensor) -> Tensor:
        calls.append(len(values))
        return 1.0 - values[:, :2]

    attributes = torch.rand(4, 3, dtype=torch.float64, generator=torch.Generator().manual_seed(0))
    shaded, alpha, face_id = render_shaded(vertices, faces, CAMERA, attributes, shader)
    plain, _ = render_attributes(vertices, faces, CAMERA, attributes)
    assert calls == [int((face_id >= 0).sum())]
    torch.testing.assert_close(shaded, alpha[..., None] - plain[..., :2])


def test_gradients_inside_faces_equal_finite_differences() -> None:
    """Inside a face the image is smooth in the vertices: autograd through interpolation against finite differences."""
    vertices, faces = square(2.0, 3.0)  # covers the whole image: no silhouette in it
    vertices[:, 2] -= 0.3 * vertices[:, 0]
    colours = torch.rand(4, 2, dtype=torch.float64, generator=torch.Generator().manual_seed(1))

    def sampled_pixels(points: Tensor, values: Tensor) -> Tensor:
        return render_attributes(points, faces, CAMERA, values)[0][10:30:7, 5:40:9].reshape(-1)

    torch.autograd.gradcheck(sampled_pixels, (vertices.requires_grad_(), colours.requires_grad_()), eps=1e-7, atol=1e-5)


def test_float32_and_float64_agree() -> None:
    vertices, faces = square(1.7, 0.43)
    colours = torch.rand(4, 3, dtype=torch.float64, generator=torch.Generator().manual_seed(2))
    double = render_attributes(vertices, faces, CAMERA, colours)
    single = render_attributes(vertices.float(), faces, CAMERA, colours.float())
    for a, b in zip(double, single, strict=True):
        torch.testing.assert_close(a.float(), b, rtol=0, atol=2e-4)


def test_gradients_of_the_silhouette_move_a_square_to_its_target() -> None:
    vertices, faces = square(2.0, 0.4)
    with torch.no_grad():
        _, target = render_attributes(
            vertices + torch.tensor([0.09, -0.05, 0.0]), faces, CAMERA, torch.ones(4, 1).double()
        )
    shift = torch.zeros(3, dtype=torch.float64, requires_grad=True)
    optimiser = torch.optim.Adam([shift], lr=0.01)
    for _ in range(60):
        _, alpha = render_attributes(vertices + shift, faces, CAMERA, torch.ones(4, 1).double())
        loss = (alpha - target).square().mean()
        optimiser.zero_grad()
        loss.backward()
        optimiser.step()
    np.testing.assert_allclose(shift.detach().numpy()[:2], [0.09, -0.05], atol=0.01)


def test_a_mesh_behind_the_camera_is_not_rendered() -> None:
    vertices, faces = square(-1.0, 0.4)
    image, alpha = render_attributes(vertices, faces, CAMERA, torch.ones(4, 3).double())
    assert float(alpha.abs().sum()) == 0.0
    assert float(image.abs().sum()) == 0.0
