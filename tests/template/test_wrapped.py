"""The template wrapped on a generated person: closed quads on the surface, its layout, colours of the person."""

from functools import lru_cache

import numpy as np
import pytest

from pipeline.geometry.atlas import rasterize_texels
from pipeline.geometry.mesh import Mesh
from pipeline.geometry.surface import closest_points_on_mesh
from pipeline.template.layout import load_layout
from pipeline.template.regions import load_template
from pipeline.template.registration import count_flipped_faces, register_template
from pipeline.template.wrapped import WrappedTemplate, wrap_template
from tests.template.face.test_animated_face import captured, closed_surface
from tests.template.generated_person import generated_person


@lru_cache(maxsize=1)
def wrapped() -> WrappedTemplate:
    person = generated_person()
    registration = register_template(person.fitted, closed_surface(), person.landmarks())
    return wrap_template(person.fitted, registration, captured()[1])


@pytest.mark.slow
def test_the_quads_lie_on_the_person_without_folds() -> None:
    found, template, person = wrapped(), load_template(), generated_person()
    rows = np.flatnonzero(template.skin_vertices)
    distance_mm = 1e3 * closest_points_on_mesh(found.skinned.mesh.vertices[rows], closed_surface())[0]
    assert np.median(distance_mm) < 1.5
    assert np.quantile(distance_mm, 0.95) < 6.0
    skin = template.faces[template.skin_faces]
    assert count_flipped_faces(person.fitted.vertices, found.skinned.mesh.vertices, skin) == 0


def test_quads_and_their_halves_are_the_same_surface() -> None:
    found = wrapped()
    assert len(found.quads) * 2 == len(found.skinned.mesh.faces)
    halves = found.skinned.mesh.faces.reshape(-1, 6)
    assert all(set(quad) == set(half) for quad, half in zip(found.quads.tolist(), halves.tolist(), strict=True))
    np.testing.assert_array_equal(found.atlas.vertex_of_uv[found.quads_uv], found.quads)
    np.testing.assert_array_equal(found.atlas.vertex_of_uv[found.atlas.faces_uv], found.skinned.mesh.faces)
    # counter-clockwise: the quad's normal is that of its halves
    vertices = found.skinned.mesh.vertices.astype(np.float64)
    a, b, c, d = (vertices[found.quads[:, k]] for k in range(4))
    normals = Mesh(vertices, found.skinned.mesh.faces).face_normals().reshape(-1, 2, 3).sum(axis=1)
    assert (np.sum(np.cross(c - a, d - b) * normals, axis=1) > 0.0).mean() > 0.999


def test_the_skin_has_the_templates_layout_and_other_parts_the_reserved_square() -> None:
    found, layout, template = wrapped(), load_layout(), load_template()
    skin = template.skin_faces
    np.testing.assert_allclose(found.atlas.uv[found.atlas.faces_uv[skin]], layout.uv[layout.faces_uv[skin]], atol=1e-6)
    left, bottom, right, top = layout.reserved
    others = found.atlas.uv[found.atlas.faces_uv[~skin]]
    assert ((others > [left, bottom]) & (others < [right, top])).all()
    a, b, c = (found.atlas.uv[found.atlas.faces_uv[:, k]].astype(np.float64) for k in range(3))
    covered = len(rasterize_texels(found.atlas, 1024).face) / 1024**2
    assert covered == pytest.approx(np.abs(np.cross(b - a, c - a)).sum() / 2, rel=0.01)


def test_the_texture_is_the_persons() -> None:
    """The captured colour is a function of the height: texels of the head have their own."""
    found = wrapped()
    mesh, size_px = found.skinned.mesh, len(found.diffuse)
    texels = rasterize_texels(found.atlas, size_px)
    points_m = texels.interpolate(mesh.faces, mesh.vertices)
    rows = load_template().skin_faces[texels.face] & (points_m[:, 1] > 1.45) & (points_m[:, 1] < 1.85)
    expected = (points_m[rows, 1] - 1.4) / 0.5
    seen = found.diffuse[texels.rows[rows], texels.columns[rows], 0]
    assert np.quantile(np.abs(seen - expected), 0.95) < 0.02
    assert found.roughness is not None
    assert np.quantile(np.abs(found.roughness[texels.rows[rows], texels.columns[rows]] - 0.5 * seen), 0.95) < 0.01
    assert len(found.names) == 67
    assert found.displacements_m.shape == (67, len(mesh.vertices), 3)
