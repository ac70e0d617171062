"""Inpainted vertex colours on a sphere: kept where observed, harmonic elsewhere (known solution)."""

import numpy as np
import pytest
import trimesh

from pipeline.geometry.atlas import Texels, rasterize_texels
from pipeline.geometry.mesh import Mesh
from pipeline.texture.inpainting import average_texels_per_vertex, inpaint_vertex_colours
from tests.texture.painted_ball import SIZE_PX, ball_atlas, ball_mesh


@pytest.fixture(scope="module")
def ball() -> Mesh:
    sphere = trimesh.creation.icosphere(subdivisions=4)
    return Mesh(np.array(sphere.vertices, dtype=np.float32), np.array(sphere.faces, dtype=np.int32))


def test_observed_vertices_keep_their_colour(ball: Mesh) -> None:
    colour = (0.5 + 0.4 * ball.vertices).astype(np.float32)
    kept = inpaint_vertex_colours(ball, colour, np.ones(len(colour), dtype=np.float32))
    np.testing.assert_allclose(kept, colour, atol=0.01)


def test_the_centre_of_an_unobserved_cap_has_the_mean_of_its_rim(ball: Mesh) -> None:
    # mean value property of harmonic functions
    colour = (0.5 + 0.4 * ball.vertices).astype(np.float32)
    hidden = ball.vertices[:, 1] > 0.8
    filled = inpaint_vertex_colours(
        ball, np.where(hidden[:, None], 9.0, colour).astype(np.float32), (~hidden).astype(np.float32)
    )
    middle = np.argmax(ball.vertices[:, 1])
    np.testing.assert_allclose(filled[middle], [0.5, 0.5 + 0.4 * 0.8, 0.5], atol=0.03)
    assert filled[hidden].max() <= colour[~hidden].max() + 1e-3


def test_an_unobserved_component_has_the_mean_colour(ball: Mesh) -> None:
    count = len(ball.vertices)
    two = Mesh(
        np.concatenate([ball.vertices, ball.vertices + [5.0, 0.0, 0.0]]).astype(np.float32),
        np.concatenate([ball.faces, ball.faces + count]),
    )
    colour = np.zeros((2 * count, 3), dtype=np.float32)
    colour[: count // 2], colour[count // 2 : count] = 0.2, 0.6
    weight = np.concatenate([np.ones(count), np.zeros(count)]).astype(np.float32)
    expected = colour[:count].mean(axis=0)
    np.testing.assert_allclose(
        inpaint_vertex_colours(two, colour, weight)[count:], np.tile(expected, (count, 1)), atol=1e-4
    )


def test_vertices_have_the_mean_colour_of_the_texels_around_them() -> None:
    mesh = ball_mesh()
    texels: Texels = rasterize_texels(ball_atlas(mesh), SIZE_PX)
    ramp = (0.5 + 0.3 * mesh.vertices).astype(np.float32)
    colour = texels.interpolate(mesh.faces, ramp)
    halves = (colour[:, 1] > 0.5).astype(np.float32)
    means, weights = average_texels_per_vertex(texels, mesh.faces, len(mesh.vertices), colour, halves)
    assert np.all((weights >= 0.0) & (weights <= 1.0 + 1e-6))
    inside = weights > 0.99
    assert inside.sum() > 100
    np.testing.assert_allclose(means[inside], ramp[inside], atol=0.02)
    assert not means[weights == 0].any()
