"""Colours from the other side of the body: known mirrored places, agreement and disagreement of both sides."""

import numpy as np

from pipeline.geometry.mesh import Mesh
from pipeline.geometry.surface import remove_unreferenced_vertices
from pipeline.template.correspondence import correspond
from pipeline.template.mirror import MIRROR_WEIGHT, add_mirrored_colours, mirror_vertices
from pipeline.template.regions import load_template
from tests.stages.painted_run import known_registration
from tests.template.generated_person import generated_person


def body_surface() -> tuple[Mesh, tuple[np.ndarray, np.ndarray]]:
    body, template = generated_person().bare, load_template()
    mesh = remove_unreferenced_vertices(Mesh(body.vertices, template.faces[template.skin_faces]))
    registration = known_registration(body)
    points = correspond(body, registration, mesh, np.full_like(mesh.vertices, 0.5))
    return mesh, mirror_vertices(points, registration.vertices, mesh)


def test_the_partner_of_a_vertex_is_on_the_other_side() -> None:
    mesh, (partner, exists) = body_surface()
    assert exists.mean() > 0.95
    flipped = mesh.vertices[partner] * [-1.0, 1.0, 1.0]
    error_mm = 1e3 * np.linalg.norm(flipped - mesh.vertices, axis=1)[exists]
    assert np.median(error_mm) < 5.0
    assert np.quantile(error_mm, 0.99) < 20.0


def test_an_unseen_arm_takes_the_other_arms_colour_where_clothes_are_the_same() -> None:
    mesh, partner = body_surface()
    x, y, _ = mesh.vertices.T
    colour = np.stack([np.abs(x), y / 2.0, np.full_like(x, 0.5)], axis=1).astype(np.float32)
    unseen = (x > 0.3) & partner[1]
    weight = np.where(unseen, 0.0, 0.9).astype(np.float32)
    hidden = np.where(unseen[:, None], 0.0, colour).astype(np.float32)
    filled, weights = add_mirrored_colours(mesh, partner, hidden, weight)
    assert np.median(np.abs(filled - colour)[unseen]) < 0.01
    assert np.median(weights[unseen]) > 0.8 * MIRROR_WEIGHT * 0.9
    np.testing.assert_array_equal(filled[~unseen], hidden[~unseen])
    np.testing.assert_array_equal(weights[~unseen], weight[~unseen])


def test_sides_of_different_colours_are_not_mixed() -> None:
    mesh, partner = body_surface()
    left = mesh.vertices[:, 0] > 0.0
    colour = np.where(left[:, None], [0.9, 0.1, 0.1], [0.1, 0.1, 0.9]).astype(np.float32)
    unseen = (mesh.vertices[:, 0] > 0.3) & partner[1]
    weight = np.where(unseen, 0.0, 0.9).astype(np.float32)
    _, weights = add_mirrored_colours(mesh, partner, colour, weight)
    assert weights[unseen].max() < 0.01 * MIRROR_WEIGHT
