"""Registration of the template: against the known correspondence of a generated person."""

import numpy as np
import pytest

from pipeline.geometry.mesh import Mesh
from pipeline.geometry.similarity import fit_similarity
from pipeline.template.regions import load_template
from pipeline.template.registration import Registration, count_flipped_faces, register_template
from tests.template.generated_person import GeneratedPerson, generated_person


@pytest.fixture(scope="module")
def person() -> GeneratedPerson:
    return generated_person()


@pytest.fixture(scope="module")
def registration(person: GeneratedPerson) -> Registration:
    return register_template(person.fitted, person.surface, person.landmarks())


def error_mm(person: GeneratedPerson, vertices: np.ndarray) -> np.ndarray:
    skin = load_template().skin_vertices
    return 1000.0 * np.linalg.norm(vertices - person.template_m, axis=1)[skin]


def test_the_template_lies_on_the_surface(registration: Registration) -> None:
    distance_mm = 1000.0 * registration.distance_m[load_template().skin_vertices]
    assert np.median(distance_mm) < 1.5
    assert np.quantile(distance_mm, 0.95) < 6.0
    assert registration.flipped_faces == 0


def test_the_correspondence_is_the_known_one(person: GeneratedPerson, registration: Registration) -> None:
    before, after = error_mm(person, person.fitted.vertices), error_mm(person, registration.vertices)
    assert np.median(before) > 10.0  # the body without registration fails
    assert np.median(after) < 8.0
    assert np.quantile(after, 0.95) < 25.0


def test_eyeballs_and_tongue_move_with_their_surroundings(person: GeneratedPerson, registration: Registration) -> None:
    template = load_template()
    for part in (*template.eye_faces, template.tongue_faces):
        rows = template.vertices_of(part)
        error = np.linalg.norm(registration.vertices[rows] - person.template_m[rows], axis=1)
        assert error.max() < 0.006


def test_lids_and_lips_keep_their_form(person: GeneratedPerson, registration: Registration) -> None:
    """The skin around an eye differs from a scaled and turned copy by little: lids that close the eye still do."""
    template = load_template()
    rows = template.vertices_of(template.socket_faces[0])
    before, after = person.fitted.vertices[rows], registration.vertices[rows]
    residual = after - fit_similarity(before, after)(before)
    assert np.sqrt(np.mean(residual**2)) < 0.001


def test_the_body_itself_stays_where_it_is(person: GeneratedPerson) -> None:
    template, body = load_template(), person.fitted
    found = register_template(body, Mesh(body.vertices, body.faces[template.skin_faces]))
    assert np.abs(found.vertices - body.vertices)[template.skin_vertices].max() < 2e-4


def test_a_turned_face_is_counted() -> None:
    flat = np.array([[0.0, 0, 0], [1, 0, 0], [1, 1, 0], [0, 1, 0]])
    faces = np.array([[0, 1, 2], [0, 2, 3]])
    folded = flat.copy()
    folded[3] = [1.0, 0.2, 0.0]
    assert count_flipped_faces(flat, flat, faces) == 0
    assert count_flipped_faces(flat, folded, faces) == 1
