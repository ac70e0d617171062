"""Atlases: charts cover the texture once with padding between them."""

import numpy as np
import pytest
import trimesh
from scipy.spatial import cKDTree

from pipeline.geometry.atlas import Atlas, rasterize_texels, texture_size_px, unwrap
from pipeline.geometry.mesh import Mesh

SIZE_PX, PADDING_PX = 256, 4


@pytest.fixture(scope="module")
def ball() -> Mesh:
    sphere = trimesh.creation.icosphere(subdivisions=3, radius=0.5)
    return Mesh(sphere.vertices.astype(np.float32), sphere.faces.astype(np.int32))


@pytest.fixture(scope="module")
def halves(ball: Mesh) -> np.ndarray:
    return (ball.vertices[ball.faces].mean(axis=1)[:, 0] > 0).astype(np.int32)


@pytest.fixture(scope="module")
def atlas(ball: Mesh, halves: np.ndarray) -> Atlas:
    return unwrap(ball, halves, SIZE_PX, PADDING_PX)


def connected_charts(faces_uv: np.ndarray) -> np.ndarray:
    """Chart label of every face: faces that share a uv corner are merged until nothing changes."""
    label = np.arange(faces_uv.max() + 1)
    while True:
        lowest = label[faces_uv].min(axis=1)
        merged = label.copy()
        np.minimum.at(merged, faces_uv.ravel(), np.repeat(lowest, 3))
        if np.array_equal(merged, label):
            return label[faces_uv[:, 0]]
        label = merged


def test_every_atlas_corner_refers_to_its_mesh_vertex(ball: Mesh, atlas: Atlas) -> None:
    np.testing.assert_array_equal(atlas.vertex_of_uv[atlas.faces_uv], ball.faces)
    assert atlas.uv.min() >= 0.0
    assert atlas.uv.max() <= 1.0


def test_unwrap_is_deterministic(ball: Mesh, halves: np.ndarray, atlas: Atlas) -> None:
    again = unwrap(ball, halves, SIZE_PX, PADDING_PX)
    assert again.uv.tobytes() == atlas.uv.tobytes()
    assert again.faces_uv.tobytes() == atlas.faces_uv.tobytes()


def test_no_chart_contains_faces_of_two_segments(halves: np.ndarray, atlas: Atlas) -> None:
    charts = connected_charts(atlas.faces_uv)
    assert all(len(np.unique(halves[charts == chart])) == 1 for chart in np.unique(charts))


def test_charts_keep_their_padding(atlas: Atlas) -> None:
    charts, texels = connected_charts(atlas.faces_uv), rasterize_texels(atlas, SIZE_PX)
    positions = np.stack([texels.rows, texels.columns], axis=1)
    chart_of_texel = charts[texels.face]
    for chart in np.unique(charts):
        inside, outside = positions[chart_of_texel == chart], positions[chart_of_texel != chart]
        apart, _ = cKDTree(outside).query(inside, p=np.inf)
        assert apart.min() > PADDING_PX - 1


def test_the_surface_point_of_a_texel_has_the_uv_of_its_centre(ball: Mesh, atlas: Atlas) -> None:
    texels = rasterize_texels(atlas, SIZE_PX)
    np.testing.assert_allclose(texels.barycentric.sum(axis=1), 1.0, atol=1e-5)
    uv = texels.interpolate(atlas.faces_uv, atlas.uv)
    np.testing.assert_allclose(uv[:, 0] * SIZE_PX, texels.columns + 0.5, atol=2e-2)
    np.testing.assert_allclose((1.0 - uv[:, 1]) * SIZE_PX, texels.rows + 0.5, atol=2e-2)
    radius = np.linalg.norm(texels.interpolate(ball.faces, ball.vertices), axis=1)
    assert np.all((radius > 0.48) & (radius < 0.501))


def test_texels_cover_the_surface_evenly(ball: Mesh, atlas: Atlas) -> None:
    texels = rasterize_texels(atlas, SIZE_PX)
    per_area = np.bincount(texels.face, minlength=len(ball.faces)).sum() / ball.face_areas_m2().sum()
    assert len(np.unique(texels.face)) == len(ball.faces)
    upper = ball.vertices[ball.faces].mean(axis=1)[:, 1] > 0
    upper_per_area = np.isin(texels.face, np.flatnonzero(upper)).sum() / ball.face_areas_m2()[upper].sum()
    assert upper_per_area == pytest.approx(per_area, rel=0.1)


def test_to_texture_writes_the_texels_of_the_coverage_mask(atlas: Atlas) -> None:
    texels = rasterize_texels(atlas, SIZE_PX)
    image = texels.to_texture(np.ones((len(texels.face), 1), dtype=np.float32))
    np.testing.assert_array_equal(image[..., 0] > 0, texels.coverage_mask())


@pytest.mark.parametrize(("pixel_footprint_m", "expected"), [(0.0035, 512), (0.0021, 1024), (1e-5, 2048), (1.0, 256)])
def test_texture_size_follows_the_pixel_footprint(pixel_footprint_m: float, expected: int) -> None:
    size = texture_size_px(1.8, pixel_footprint_m, min_size_px=256, max_size_px=2048)
    assert size == expected
    if 256 < size < 2048:
        texel_m = np.sqrt(1.8 / 0.65) / size
        assert 0.5 * pixel_footprint_m < texel_m <= pixel_footprint_m
