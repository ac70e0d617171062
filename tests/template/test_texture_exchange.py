"""Exchange of textures: between two generated people, whose template points are known on both."""

import numpy as np
import pytest

from pipeline.geometry.atlas import Atlas
from pipeline.geometry.mesh import Mesh
from pipeline.template.regions import load_template
from pipeline.template.registration import register_template
from pipeline.template.texture_exchange import (
    RegisteredSurface,
    SurfacePoints,
    below_neck,
    corresponding_points,
    exchanged_map,
    template_points,
)
from tests.template.generated_person import GeneratedPerson, generated_person

SEEDS = (3, 5)


def known_points(count: int = 5000) -> SurfacePoints:
    """Return points spread evenly over the area of the template's skin."""
    random, skin = np.random.default_rng(0), RegisteredSurface(*_known_surface(generated_person(SEEDS[0]))).skin()
    area = skin.face_areas_m2()
    face = random.choice(len(area), count, p=area / area.sum())
    return SurfacePoints(face, random.dirichlet(np.ones(3), count))


def _known_surface(person: GeneratedPerson) -> tuple[Mesh, np.ndarray]:
    return person.surface, person.template_m


def at_m(points: SurfacePoints, person: GeneratedPerson) -> np.ndarray:
    skin = RegisteredSurface(*_known_surface(person)).skin()
    return points.interpolate(skin.faces, skin.vertices)


def place_errors_mm(
    here: tuple[GeneratedPerson, RegisteredSurface], there: tuple[GeneratedPerson, RegisteredSurface]
) -> np.ndarray:
    points, mesh = known_points(), there[0].surface
    found = corresponding_points(template_points(at_m(points, here[0]), here[1]), there[1])
    return 1e3 * np.linalg.norm(found.interpolate(mesh.faces, mesh.vertices) - at_m(points, there[0]), axis=1)


@pytest.mark.parametrize("is_exact", [pytest.param(False, marks=pytest.mark.slow), True])
def test_places_of_one_person_are_found_on_another(is_exact: bool) -> None:
    """Both bodies are fitted with the same errors of shape, or one has errors and the other none."""
    first, second = (generated_person(seed) for seed in SEEDS)
    registered, alone = [], []
    for person, fit in ((first, first.fitted), (second, second.bare if is_exact else second.fitted)):
        on_surface = register_template(fit, person.surface, person.landmarks()).vertices
        registered.append((person, RegisteredSurface(person.surface, on_surface)))
        alone.append((person, RegisteredSurface(person.surface, fit.vertices.astype(np.float64))))
    for order in (1, -1):
        errors_mm, without = place_errors_mm(*registered[::order]), place_errors_mm(*alone[::order])
        assert np.median(errors_mm) < 8.0
        assert np.quantile(errors_mm, 0.95) < 25.0
        assert np.median(without) > 1.3 * np.median(errors_mm)


def test_the_head_is_not_below_the_neck() -> None:
    body, template = generated_person(SEEDS[0]).fitted, load_template()
    skin = np.flatnonzero(template.skin_faces)
    middle = SurfacePoints(np.arange(len(skin)), np.full((len(skin), 3), 1.0 / 3.0))
    weight = below_neck(body, middle)
    height_m = body.vertices[template.faces[skin]].mean(axis=1)[:, 1]
    shoulder_m = body.joints_m[body.joint("LeftArm"), 1]
    assert weight.min() >= 0.0
    assert weight[height_m > body.joints_m[body.joint("Head"), 1] + 0.05].max() < 0.02
    assert weight[height_m < shoulder_m - 0.1].min() > 0.98


def test_a_map_of_places_arrives_where_it_was() -> None:
    """A person who takes their own texture keeps it: each texel comes from itself."""
    person, template = generated_person(SEEDS[0]), load_template()
    skin = template.faces[template.skin_faces]
    surface = RegisteredSurface(Mesh(person.template_m.astype(np.float32), skin.astype(np.int32)), person.template_m)
    used, corners = np.unique(template.faces_uv[template.skin_faces], return_inverse=True)
    vertex = np.zeros(len(used), np.int32)
    vertex[corners.ravel()] = skin.ravel()
    atlas = Atlas(template.uv[used].astype(np.float32), corners.reshape(-1, 3).astype(np.int32), vertex)
    ramp = (np.arange(64, dtype=np.float32) + 0.5) / 64
    places = np.stack(np.broadcast_arrays(ramp[None, :], ramp[:, None], np.float32(0.5)), axis=2)
    mask = np.zeros((64, 64), np.float32)
    mask[:, :32] = 0.25
    colour, alpha = exchanged_map((surface, atlas), (surface, atlas), places.copy(), person.fitted, mask)
    assert set(np.unique(alpha)) == {np.float32(0.0), np.float32(0.25)}
    assert not alpha[:, 32:].any()
    np.testing.assert_allclose(colour[alpha > 0], places[alpha > 0], atol=0.01)
    assert exchanged_map((surface, atlas), (surface, atlas), places, person.fitted, 32)[1].shape == (32, 32)
