"""Another shape: against generated people of both shapes; bad changes are one sentence."""

import numpy as np
import pytest

from pipeline.core.errors import UserError
from pipeline.geometry.mesh import Mesh
from pipeline.template.regions import load_template
from pipeline.template.registration import Registration
from pipeline.template.reshape import (
    SHAPE_KEYS,
    carry_to_surface,
    parse_shape,
    reshape_body,
    reshape_registration,
    shape_change,
)
from tests.template.generated_person import generated_person


def exact(vertices: np.ndarray) -> Registration:
    count = len(vertices)
    return Registration(vertices.astype(np.float64), np.zeros(count), np.ones(count, dtype=bool), 0, True)


def skin_of(vertices: np.ndarray) -> Mesh:
    template = load_template()
    return Mesh(vertices, template.faces[template.skin_faces])


def test_the_body_itself_takes_the_models_shape() -> None:
    body = generated_person().bare
    changes = {"weight": 0.2, "height": -0.1}
    change = shape_change(body, changes)
    reshaped = reshape_body(body, change, changes)
    assert reshaped.shape["weight"] == pytest.approx(body.shape["weight"] + 0.2)
    assert reshaped.height_m() < body.height_m() - 0.02
    rows = load_template().skin_vertices
    moved = carry_to_surface(change, exact(body.vertices), skin_of(body.vertices))
    error_mm = 1e3 * np.linalg.norm(body.vertices + moved - reshaped.vertices, axis=1)[rows]
    assert np.median(error_mm) < 1.0
    assert np.quantile(error_mm, 0.99) < 4.0  # the smoothing rounds off fingers
    assert np.linalg.norm(change.joints_m, axis=1).max() > 0.01


@pytest.mark.slow
def test_clothes_keep_their_offset_and_the_way_back_is_the_start() -> None:
    person = generated_person()
    surface, registration = person.surface, exact(person.template_m)
    there = shape_change(person.bare, {"weight": 0.4})
    moved = Mesh(surface.vertices + carry_to_surface(there, registration, surface), surface.faces)
    assert np.linalg.norm(moved.vertices - surface.vertices, axis=1).max() > 0.01
    heavier = reshape_body(person.bare, there, {"weight": 0.4})
    back = shape_change(heavier, {"weight": -0.4})
    returned = moved.vertices + carry_to_surface(back, reshape_registration(registration, there), moved)
    error_mm = 1e3 * np.linalg.norm(returned - surface.vertices, axis=1)
    assert np.median(error_mm) < 0.5
    assert np.quantile(error_mm, 0.99) < 3.0


def test_a_person_at_the_end_of_the_range_still_moves() -> None:
    body = generated_person().bare
    heavy = reshape_body(body, shape_change(body, {"weight": 0.5}), {"weight": 0.5})
    assert heavy.shape["weight"] > 0.9
    change = shape_change(heavy, {"weight": 0.3})
    assert np.linalg.norm(change.vertices_m, axis=1).max() > 0.01


@pytest.mark.parametrize(
    "entry", ["wieght=+0.2", "weight", "weight=0.6", "weight=-0.51", "weight=nan", "weight=0.1 0.2", "gender=0.1"]
)
def test_a_bad_change_is_one_sentence_that_names_the_keys(entry: str) -> None:
    with pytest.raises(UserError, match="use height, weight, muscle, age") as error:
        parse_shape([entry])
    assert "\n" not in str(error.value)


def test_changes_are_read_with_and_without_signs() -> None:
    assert parse_shape(["weight=+0.2", "height=-.1", "age=0"]) == {"weight": 0.2, "height": -0.1, "age": 0.0}
    with pytest.raises(UserError, match="each once"):
        parse_shape(["weight=0.1", "weight=0.2"])
    assert set(SHAPE_KEYS) <= set(generated_person().bare.shape)
