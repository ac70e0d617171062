"""The normal map: a bumpy ball that shades like a sphere, sheets that do not mix, flat maps."""

import numpy as np
import pytest
import trimesh

from pipeline.geometry.atlas import Atlas, rasterize_texels, unwrap
from pipeline.geometry.mesh import Mesh
from pipeline.io.image import to_float, to_uint8
from pipeline.texture.files import FLAT_NORMAL
from pipeline.texture.normal_map import bake_normal_map, decode_normals, texel_frames, widen_flat

RADIUS_M = 0.1


def ball(subdivisions: int) -> Mesh:
    sphere = trimesh.creation.icosphere(subdivisions, RADIUS_M)
    return Mesh(np.asarray(sphere.vertices, np.float32), np.asarray(sphere.faces, np.int32))


def atlas_of(mesh: Mesh) -> Atlas:
    return unwrap(mesh, np.zeros(len(mesh.faces), np.int32), 128, 4, smoothing_steps=0)


def shaded_normals(mesh: Mesh, atlas: Atlas, normal_map: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return points of the surface between the texels of the map, and the normals that a viewer shades with."""
    points = rasterize_texels(atlas, 77)
    frames = texel_frames(mesh, atlas, points)
    points_m = points.interpolate(mesh.faces, mesh.vertices)
    return points_m, decode_normals(normal_map, points.interpolate(atlas.faces_uv, atlas.uv), frames)


def angles_deg(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    return np.degrees(np.arccos(np.clip(np.sum(a * b, axis=1) / np.linalg.norm(b, axis=1), -1.0, 1.0)))


@pytest.fixture(scope="module")
def coarse() -> tuple[Mesh, Atlas]:
    smooth = ball(2)
    radii = np.random.default_rng(0).uniform(0.96, 1.04, (len(smooth.vertices), 1)).astype(np.float32)
    mesh = Mesh(smooth.vertices * radii, smooth.faces)
    return mesh, atlas_of(mesh)


def test_a_bumpy_ball_gets_the_normals_of_a_sphere(coarse: tuple[Mesh, Atlas]) -> None:
    mesh, atlas = coarse
    points_m, normals = shaded_normals(mesh, atlas, to_float(to_uint8(bake_normal_map(mesh, atlas, ball(5), 128))))
    _, flat = shaded_normals(mesh, atlas, np.full((128, 128, 3), FLAT_NORMAL, np.float32))
    with_map, without = angles_deg(normals, points_m), angles_deg(flat, points_m)
    assert without.mean() > 2.5
    assert with_map.mean() < 0.6
    assert np.quantile(with_map, 0.99) < 3.0


def test_the_map_of_a_mesh_with_itself_is_flat(coarse: tuple[Mesh, Atlas]) -> None:
    normal_map = bake_normal_map(*coarse, coarse[0], 64)
    np.testing.assert_allclose(normal_map, np.broadcast_to(FLAT_NORMAL, (64, 64, 3)), atol=1e-5)


@pytest.mark.parametrize("offset_m", [0.02, -0.02])
def test_a_texel_far_from_the_dense_mesh_stays_flat(coarse: tuple[Mesh, Atlas], offset_m: float) -> None:
    mesh, atlas = coarse
    shell = Mesh(mesh.vertices + np.float32(offset_m) * mesh.vertex_normals(), mesh.faces)
    turned = Mesh(shell.vertices + np.float32([0.0, 0.001, 0.0]), shell.faces)
    normal_map = bake_normal_map(mesh, atlas, turned, 64)
    is_covered = rasterize_texels(atlas, 64).coverage_mask()
    np.testing.assert_allclose(normal_map[is_covered], np.broadcast_to(FLAT_NORMAL, (is_covered.sum(), 3)), atol=1e-6)


def test_a_sheet_that_faces_the_other_way_is_not_taken(coarse: tuple[Mesh, Atlas]) -> None:
    mesh, atlas = coarse
    normal_map = bake_normal_map(mesh, atlas, Mesh(mesh.vertices, mesh.faces[:, ::-1]), 64)
    np.testing.assert_allclose(normal_map, np.broadcast_to(FLAT_NORMAL, (64, 64, 3)), atol=1e-6)


def test_green_points_up_and_red_to_the_right_in_the_image() -> None:
    """A flat square in the plane z = 0 under a shallow roof: its normals lean to the side that the roof descends to."""
    corners = np.array([[0, 0], [1, 0], [1, 1], [0, 1]], np.float32)
    faces = np.array([[0, 1, 2], [0, 2, 3]], np.int32)
    square = Mesh(np.column_stack([0.1 * corners, np.zeros(4, np.float32)]), faces)
    atlas = Atlas(corners, faces, np.arange(4, dtype=np.int32))
    for axis in (0, 1):
        slope = Mesh(square.vertices - np.float32([0, 0, 1]) * 0.05 * square.vertices[:, [axis]], faces)
        normal_map = bake_normal_map(square, atlas, slope, 16)
        expected = np.array([0.0, 0.0, 1.0])
        expected[axis] = 0.05
        expected = 0.5 + 0.5 * expected / np.linalg.norm(expected)
        np.testing.assert_allclose(normal_map, np.broadcast_to(expected, (16, 16, 3)), atol=1e-5)


def test_the_right_half_of_a_wide_map_is_flat() -> None:
    normal_map = np.random.default_rng(0).uniform(size=(4, 4, 3)).astype(np.float32)
    wide = widen_flat(normal_map)
    np.testing.assert_array_equal(wide[:, :4], normal_map)
    np.testing.assert_array_equal(wide[:, 4:], np.broadcast_to(np.float32(FLAT_NORMAL), (4, 4, 3)))
