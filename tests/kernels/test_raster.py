"""Rasterisation: closed forms, a brute-force truth, the compiled loops against the reference, silhouette gradients."""

import math

import numpy as np
import pytest
import torch
import trimesh
from torch import Tensor

from pipeline.geometry.differentiable_raster import face_adjacency
from pipeline.kernels.raster import antialias, rasterize, reference, silhouette_blends
from pipeline.kernels.raster.cpu import silhouette_edges_cpu
from pipeline.kernels.raster.reference import rasterize_reference, silhouette_edges

HEIGHT, WIDTH = 37, 53


def triangle_soup(count: int, seed: int, size_px: float = 12.0) -> tuple[Tensor, Tensor, Tensor]:
    """Random triangles, some partly or completely outside the image, at depths of 1 to 3 m."""
    generator = torch.Generator().manual_seed(seed)
    centres = torch.rand(count, 1, 2, generator=generator) * torch.tensor([WIDTH + 20.0, HEIGHT + 20.0]) - 10.0
    corners = centres + size_px * (torch.rand(count, 3, 2, generator=generator) - 0.5)
    depth = 1.0 + 2.0 * torch.rand(count, 3, generator=generator)
    return corners.reshape(-1, 2), depth.reshape(-1), torch.arange(3 * count, dtype=torch.int32).view(-1, 3)


def brute_force_raster(vertices_px: Tensor, depth_m: Tensor, faces: Tensor) -> tuple[np.ndarray, np.ndarray]:
    """Every face against every pixel centre, by solving for the barycentrics; face id and depth."""
    ids, nearest = np.full((HEIGHT, WIDTH), -1), np.full((HEIGHT, WIDTH), np.inf)
    y, x = np.mgrid[:HEIGHT, :WIDTH] + 0.5
    points = np.stack([x.ravel(), y.ravel(), np.ones(x.size)])
    for f, face in enumerate(faces.tolist()):
        corners = np.concatenate([vertices_px[face].double().numpy().T, np.ones((1, 3))])
        if abs(np.linalg.det(corners)) < 1e-12:
            continue
        weights = np.linalg.solve(corners, points)
        depth = 1.0 / (weights / depth_m[face].double().numpy()[:, None]).sum(axis=0)
        wins = ((weights >= 0).all(axis=0) & (depth < nearest.ravel())).reshape(HEIGHT, WIDTH)
        ids[wins], nearest[wins] = f, depth.reshape(HEIGHT, WIDTH)[wins]
    return ids, nearest


@pytest.mark.parametrize("seed", range(3))
def test_nearest_face_is_visible_at_every_pixel(seed: int) -> None:
    vertices_px, depth_m, faces = triangle_soup(80, seed)
    face_id, _, depth = rasterize(vertices_px, depth_m, faces, HEIGHT, WIDTH)
    truth_id, truth_depth = brute_force_raster(vertices_px, depth_m, faces)
    assert (truth_id >= 0).mean() > 0.2
    np.testing.assert_array_equal(face_id.numpy(), truth_id)
    np.testing.assert_allclose(depth.numpy(), truth_depth, rtol=1e-6)


@pytest.mark.parametrize("cull", [False, True])
def test_compiled_raster_equals_reference(cull: bool) -> None:
    vertices_px, depth_m, faces = triangle_soup(600, seed=7)
    fast = rasterize(vertices_px, depth_m, faces, HEIGHT, WIDTH, cull_backfaces=cull)
    plain = rasterize_reference(vertices_px, depth_m, faces, HEIGHT, WIDTH, 0.01, cull)
    assert torch.equal(fast[0], plain[0])
    # Both compute in float64 and round once.
    torch.testing.assert_close(fast[1], plain[1], rtol=0.0, atol=2e-7)
    torch.testing.assert_close(fast[2], plain[2], rtol=2e-7, atol=0.0)


def test_float64_runs_the_reference_with_the_same_result() -> None:
    vertices_px, depth_m, faces = triangle_soup(50, seed=3)
    double = rasterize(vertices_px.double(), depth_m.double(), faces, HEIGHT, WIDTH)
    assert double[1].dtype == torch.float64
    assert torch.equal(double[0], rasterize(vertices_px, depth_m, faces, HEIGHT, WIDTH)[0])


def test_barycentrics_are_perspective_correct() -> None:
    """A plane z = 2 + x (world) at 45 px focal length: the interpolated world x equals the intersection of the ray."""
    points = torch.tensor([[-1.0, -2.0, 1.0], [3.0, -2.0, 5.0], [-1.0, 2.0, 1.0], [3.0, 2.0, 5.0]])
    pixels = 45.0 * points[:, :2] / points[:, 2:] + torch.tensor([WIDTH / 2, HEIGHT / 2])
    faces = torch.tensor([[0, 1, 2], [1, 3, 2]])
    face_id, barycentric, depth = rasterize(pixels, points[:, 2].contiguous(), faces, HEIGHT, WIDTH)
    seen = face_id >= 0
    world_x = (barycentric * points[:, 0][faces[face_id.clamp_min(0).long()]]).sum(2)
    ray_x = ((torch.arange(WIDTH) + 0.5 - WIDTH / 2) / 45.0).expand(HEIGHT, WIDTH)
    expected = 2.0 * ray_x / (1.0 - ray_x)
    assert seen.sum() > 1000
    torch.testing.assert_close(world_x[seen], expected[seen], rtol=1e-4, atol=1e-4)
    torch.testing.assert_close(depth[seen], (2.0 + expected)[seen], rtol=1e-4, atol=1e-4)


def test_tiled_square_has_no_gaps_and_ties_go_to_the_lower_face() -> None:
    """Every pixel inside is covered, both with pixel centres exactly on edges and corners and in general position."""
    y, x = torch.meshgrid(torch.arange(6.0), torch.arange(6.0), indexing="ij")
    vertices = torch.stack([x.reshape(-1), y.reshape(-1)], 1) * 4.0 + 0.5
    quads = [[6 * r + c, 6 * r + c + 1, 6 * r + c + 6, 6 * r + c + 7] for r in range(5) for c in range(5)]
    faces = torch.tensor([t for a, b, c, d in quads for t in ([a, b, c], [b, d, c])], dtype=torch.int32)
    face_id, _, _ = rasterize(vertices, torch.ones(36), faces, 21, 21)
    assert int(face_id.min()) == 0
    assert face_id[0, 0] == 0
    assert face_id[0, 4] == 0  # corner shared by faces 0, 1 and 2
    rotation = torch.tensor([[math.cos(0.3), -math.sin(0.3)], [math.sin(0.3), math.cos(0.3)]])
    centre = torch.tensor([20.7, 18.1])
    rotated = (vertices - 10.5) @ rotation.T + centre
    face_id, _, _ = rasterize(rotated, 1.0 + torch.rand(36, generator=torch.Generator().manual_seed(0)), faces, 40, 40)
    pixels = torch.stack(torch.meshgrid(torch.arange(40) + 0.5, torch.arange(40) + 0.5, indexing="xy"), 2)
    inside = ((pixels - centre) @ rotation).abs().amax(2) < 9.9
    assert inside.sum() > 350
    assert (face_id[inside] >= 0).all()


def test_faces_behind_near_plane_or_with_nan_are_dropped() -> None:
    vertices_px = torch.tensor([[0.0, 0.0], [0.0, 90.0], [90.0, 0.0], [torch.nan, 0.0]])
    faces = torch.tensor([[0, 1, 2], [0, 1, 3], [0, 0, 1]])
    for depth in ([1.0, 1.0, 0.001, 1.0], [1.0, -2.0, 1.0, 1.0], [1.0, 1.0, torch.nan, 1.0]):
        for run in (rasterize, lambda *a: rasterize_reference(*a, 0.01, False)):
            face_id, barycentric, found = run(vertices_px, torch.tensor(depth), faces, HEIGHT, WIDTH)
            assert (face_id == -1).all()
            assert (barycentric == 0).all()
            assert torch.isinf(found).all()
    assert (rasterize(vertices_px, torch.ones(4), faces[:1], HEIGHT, WIDTH)[0] == 0).all()


def test_very_distant_vertices_do_not_overflow() -> None:
    vertices_px = torch.tensor([[-1e12, -1e12], [-1e12, 1e13], [1e13, -1e12]])
    face_id, _, _ = rasterize(vertices_px, torch.ones(3), torch.tensor([[0, 1, 2]]), HEIGHT, WIDTH)
    assert (face_id == 0).all()


def test_missing_vertex_raises_index_error() -> None:
    with pytest.raises(IndexError, match=r"0\.\.3, the mesh has 3"):
        rasterize(torch.zeros(3, 2), torch.ones(3), torch.tensor([[0, 1, 3]]), 4, 4)


def test_empty_mesh_gives_an_empty_image() -> None:
    for dtype in (torch.float32, torch.float64):
        empty = torch.zeros(0, 3, dtype=torch.int32)
        face_id, _, _ = rasterize(torch.zeros(0, 2, dtype=dtype), torch.zeros(0, dtype=dtype), empty, 3, 5)
        assert face_id.shape == (3, 5)
        assert (face_id == -1).all()


def disc(radius_px: float, count: int = 64) -> tuple[Tensor, Tensor, Tensor]:
    """A triangle fan around the image centre: vertices (float64), depth, faces."""
    angle = torch.arange(count, dtype=torch.float64) * (2 * math.pi / count)
    rim = radius_px * torch.stack([angle.cos(), angle.sin()], 1)
    centre = torch.tensor([WIDTH / 2 + 0.13, HEIGHT / 2 - 0.21], dtype=torch.float64)
    vertices = torch.cat([centre[None], centre + rim])
    ring = torch.arange(count)
    faces = torch.stack([torch.zeros_like(ring), 1 + (ring + 1) % count, 1 + ring], 1)
    return vertices, torch.full((count + 1,), 2.0, dtype=torch.float64), faces


def coverage(vertices_px: Tensor, depth_m: Tensor, faces: Tensor) -> Tensor:
    face_id, _, depth = rasterize(vertices_px, depth_m, faces, HEIGHT, WIDTH)
    flat = (face_id >= 0).to(vertices_px.dtype).view(-1, 1)
    blends = silhouette_blends(face_id, depth, vertices_px, depth_m, faces, face_adjacency(faces))
    return antialias(flat, blends).view(HEIGHT, WIDTH)


def test_antialiased_coverage_is_near_the_exact_area_of_each_pixel() -> None:
    vertices, depth_m, faces = disc(14.3)
    exact = rasterize(vertices * 16, depth_m, faces, 16 * HEIGHT, 16 * WIDTH)[0] >= 0
    exact = exact.double().view(HEIGHT, 16, WIDTH, 16).mean(dim=(1, 3))
    hard = (rasterize(vertices, depth_m, faces, HEIGHT, WIDTH)[0] >= 0).double()
    soft = coverage(vertices, depth_m, faces)
    assert (soft - exact).abs().sum() < 0.25 * (hard - exact).abs().sum()
    assert abs(float(soft.sum() - exact.sum())) < 0.01 * float(exact.sum())


def test_silhouette_gradient_is_the_border_length() -> None:
    """d(area) / d(radius) = perimeter: a border crossed by rows and by columns is not counted twice."""
    vertices, depth_m, faces = disc(14.3, count=256)
    outward = vertices - vertices[0]
    scale = torch.ones((), dtype=torch.float64, requires_grad=True)
    coverage(vertices[0] + scale * outward, depth_m, faces).sum().backward()
    assert float(scale.grad) == pytest.approx(2 * math.pi * 14.3**2, rel=0.01)


def test_antialias_gradient_equals_finite_differences() -> None:
    vertices, depth_m, faces = disc(11.7, count=9)
    generator = torch.Generator().manual_seed(0)
    weights = torch.rand(HEIGHT, WIDTH, generator=generator, dtype=torch.float64)

    def loss(points: Tensor) -> Tensor:
        return (coverage(points, depth_m, faces) * weights).sum()

    points = vertices.clone().requires_grad_()
    loss(points).backward()
    step = 1e-6
    for vertex, axis in ((1, 0), (3, 1), (7, 0)):
        moved = torch.zeros_like(vertices)
        moved[vertex, axis] = step
        # The weights of rows and columns are constant by design: the gradient lacks their small derivative.
        slope = float(loss(vertices + moved) - loss(vertices - moved)) / (2 * step)
        assert float(points.grad[vertex, axis]) == pytest.approx(slope, rel=0.2, abs=0.3)


def test_hidden_silhouette_has_no_effect() -> None:
    near, _, near_faces = disc(15.0)
    far, _, far_faces = disc(8.0)
    vertices, faces = torch.cat([near, far]), torch.cat([near_faces, far_faces + len(near)])
    depth_m = torch.cat([torch.full((len(near),), 2.0), torch.full((len(far),), 3.0)]).double()
    both = coverage(vertices, depth_m, faces)
    alone = coverage(near, depth_m[: len(near)], near_faces)
    torch.testing.assert_close(both, alone, rtol=0, atol=1e-12)


def test_near_part_is_blended_over_far_part() -> None:
    """Colour 1 in front of colour 0: the blended sum is the area of the front disc."""
    far, _, far_faces = disc(15.0)
    near, _, near_faces = disc(8.0)
    vertices, faces = torch.cat([far, near]), torch.cat([far_faces, near_faces + len(far)])
    depth_m = torch.cat([torch.full((len(far),), 3.0), torch.full((len(near),), 2.0)]).double()
    face_id, _, depth = rasterize(vertices, depth_m, faces, HEIGHT, WIDTH)
    colour = (face_id >= len(far_faces)).double().view(-1, 1)
    blended = antialias(colour, silhouette_blends(face_id, depth, vertices, depth_m, faces, face_adjacency(faces)))
    assert float(blended.sum()) == pytest.approx(math.pi * 64.0, rel=0.01)


def test_silhouette_edges_of_a_tetrahedron_are_its_outline() -> None:
    points = torch.tensor([[0.0, 0.0], [10.0, 0.0], [5.0, 9.0], [5.0, 3.0]])
    faces = torch.tensor([[0, 2, 1], [0, 1, 3], [1, 2, 3], [2, 0, 3]])
    edges = silhouette_edges(points, faces, face_adjacency(faces))
    assert {tuple(sorted(e)) for e in edges[:, :2].tolist()} == {(0, 1), (1, 2), (0, 2)}


def test_compiled_silhouette_edges_are_those_of_the_reference() -> None:
    """A crumpled torus with a hole: folds and borders, in the same order."""
    torus = trimesh.creation.torus(1.0, 0.4)
    generator = torch.Generator().manual_seed(0)
    points = torch.from_numpy(torus.vertices[:, :2]).float() * 40.0
    points += torch.randn(points.shape, generator=generator)
    faces = torch.from_numpy(torus.faces[7:])
    adjacency = face_adjacency(faces)
    expected = silhouette_edges(points, faces, adjacency)
    compiled = silhouette_edges_cpu(points.numpy(), faces.to(torch.int32).numpy(), adjacency.numpy())
    assert int((adjacency < 0).sum()) > 0
    assert len(expected) > 100
    np.testing.assert_array_equal(compiled, expected.numpy())


def test_compiled_blends_and_their_gradient_are_those_of_the_reference() -> None:
    """A crumpled torus at changing depths, partly outside the picture and with a corner behind the camera."""
    torus = trimesh.creation.torus(1.0, 0.4)
    generator = torch.Generator().manual_seed(0)
    points = torch.from_numpy(torus.vertices[:, :2]).float() * 0.3 * HEIGHT + torch.tensor([0.3 * WIDTH, 0.5 * HEIGHT])
    points += torch.randn(points.shape, generator=generator)
    depth_m = 2.0 + torch.from_numpy(torus.vertices[:, 2]).float()
    depth_m[5] = -1.0
    faces = torch.from_numpy(torus.faces[7:])
    adjacency = face_adjacency(faces)
    face_id, _, depth = rasterize(points, depth_m, faces, HEIGHT, WIDTH)
    edges = silhouette_edges(points, faces, adjacency)
    twins = [points.clone().requires_grad_() for _ in range(2)]
    compiled = silhouette_blends(face_id, depth, twins[0], depth_m, faces, adjacency)
    expected = reference.silhouette_blends(face_id, depth, twins[1], depth_m, edges)
    assert len(expected.target) > 100
    for name in ("target", "near", "far"):
        assert torch.equal(getattr(compiled, name), getattr(expected, name))
    torch.testing.assert_close(compiled.fraction, expected.fraction, rtol=1e-4, atol=1e-5)
    upstream = torch.randn(len(expected.fraction), generator=generator)
    for blends in (compiled, expected):
        (blends.fraction * upstream).sum().backward()
    assert float(twins[1].grad.abs().max()) > 1.0
    torch.testing.assert_close(twins[0].grad, twins[1].grad, rtol=1e-3, atol=1e-3)
