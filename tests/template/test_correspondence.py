"""The correspondence of a person's vertices with the template: against known garments and points; the file."""

from functools import lru_cache
from pathlib import Path

import numpy as np
import pytest

from data_tools.synthetic.person.outfit import choose_outfit
from data_tools.synthetic.person.person import make_person
from pipeline.core.errors import UserError
from pipeline.geometry.mesh import Mesh
from pipeline.template.correspondence import CLOSE, HAIR, LABELS, LOOSE, Correspondence, correspond
from pipeline.template.files import TEMPLATE_NPZ, FittedTemplate, load_fitted_template, save_template
from pipeline.template.regions import load_template
from pipeline.template.registration import Registration, register_template
from tests.template.generated_person import GeneratedPerson, generated_person


def grey(mesh: Mesh) -> np.ndarray:
    return np.full(mesh.vertices.shape, 0.5)


@lru_cache(maxsize=1)
def found() -> tuple[GeneratedPerson, Registration, Correspondence]:
    person = generated_person()
    registration = register_template(person.fitted, person.surface, person.landmarks())
    return person, registration, correspond(person.fitted, registration, person.surface, grey(person.surface))


@pytest.mark.slow
def test_vertices_lie_where_the_template_does() -> None:
    """The vertices of the generated person that are the template's own come first."""
    person, _, points = found()
    rows = np.flatnonzero(load_template().skin_vertices)
    error_mm = 1e3 * np.linalg.norm(points.interpolate(person.template_m)[rows] - person.template_m[rows], axis=1)
    assert np.median(error_mm) < 8.0
    assert np.quantile(error_mm, 0.95) < 25.0
    assert points.barycentric.min() >= 0.0
    np.testing.assert_allclose(points.barycentric.sum(axis=1), 1.0)
    assert load_template().skin_faces[points.face].all()


def test_distance_and_offset_are_those_of_the_surfaces() -> None:
    """A surface that is the body, moved outwards by 1 cm, has this offset, and no distance to a template on it."""
    body, template = generated_person().bare, load_template()
    skin = template.faces[template.skin_faces]
    normals = Mesh(body.vertices, body.faces).vertex_normals()
    moved = body.vertices.astype(np.float64) + 0.01 * normals
    count = len(moved)
    registration = Registration(moved, np.zeros(count), np.ones(count, dtype=bool), 0, False)
    points = correspond(body, registration, Mesh(moved, skin), grey(Mesh(moved, skin)))
    rows = template.skin_vertices
    assert points.distance_m[rows].max() < 1e-6
    assert np.median(points.offset_m[rows]) == pytest.approx(0.01, abs=1e-3)


def test_short_hair_is_told_by_its_colour_and_a_bald_head_has_none() -> None:
    """The body itself, with the scalp painted dark above the brows and behind the ears, and a dark beard."""
    body, template = generated_person().bare, load_template()
    count = len(body.vertices)
    registration = Registration(body.vertices.astype(np.float64), np.zeros(count), np.ones(count, dtype=bool), 0, False)
    mesh = Mesh(body.vertices, template.faces[template.skin_faces])
    eyes_m = body.vertices[template.vertices_of(template.eye_faces.any(axis=0))].mean(axis=0)
    up, ahead = body.vertices[:, 1] - eyes_m[1], body.vertices[:, 2] - body.joints_m[body.joint("Head"), 2]
    scalp = template.skin_vertices & ((up > 0.06) | ((up > 0.0) & (ahead < -0.02)))
    beard = template.skin_vertices & (ahead > 0.05) & (up < -0.08) & (up > -0.12)
    skin, dark = (0.8, 0.6, 0.5), (0.15, 0.1, 0.08)
    colours = np.where((scalp | beard)[:, None], dark, skin)
    label = correspond(body, registration, mesh, colours).label
    assert (label[scalp] == HAIR).mean() > 0.95
    assert (label[beard] == HAIR).mean() < 0.05
    assert (label[template.skin_vertices & ~scalp] == HAIR).mean() < 0.02
    bald = correspond(body, registration, mesh, np.broadcast_to(skin, colours.shape)).label
    assert not (bald == HAIR).any()


@pytest.mark.slow
def test_skin_skirt_and_hair_are_told_apart() -> None:
    template, seed = load_template(), 3
    subject, bare = make_person(seed, 64, choose_outfit(seed, "skirt"))
    visible = np.ones(len(subject.body.faces), dtype=bool)
    visible[: 4 * len(template.skin_faces)] = np.repeat(template.skin_faces, 4)
    surface = Mesh(subject.body.vertices, subject.body.faces[visible])
    registration = register_template(bare, surface)
    label = correspond(bare, registration, surface, grey(surface)).label[surface.faces]
    assert subject.labels is not None
    of_face = np.array(subject.labels.names)[subject.labels.of_face[visible]]
    for part, expected, share in (
        ("skirt", LOOSE, 0.85),
        ("hands", CLOSE, 0.95),
        ("legs", CLOSE, 0.9),
        ("hair", HAIR, 0.5),
    ):
        assert (label[of_face == part] == expected).mean() > share, part


def test_the_file_returns_what_was_written(tmp_path: Path) -> None:
    _, registration, points = found()
    save_template(tmp_path, FittedTemplate(registration, points))
    read = load_fitted_template(tmp_path)
    assert read is not None
    np.testing.assert_allclose(read.registration.vertices, registration.vertices, atol=1e-6)
    assert read.registration.has_face
    np.testing.assert_array_equal(read.correspondence.face, points.face)
    np.testing.assert_array_equal(read.correspondence.label, points.label)
    assert points.shares().keys() == set(LABELS)
    assert sum(points.shares().values()) == pytest.approx(1.0)
    save_template(tmp_path, None)
    assert load_fitted_template(tmp_path) is None
    (tmp_path / TEMPLATE_NPZ).unlink()
    with pytest.raises(UserError, match="earlier version"):
        load_fitted_template(tmp_path)
