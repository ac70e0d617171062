"""Fingers of a given width."""

import numpy as np
import pytest

from data_tools.synthetic.person.fingers import FINGERS, nearest_on_polyline, with_finger_width
from pipeline.body.body import Body, load_anny

JOINTS = [f"{side}Hand{finger}{number}" for side in ("Left", "Right") for finger in FINGERS for number in (1, 2, 3)]


@pytest.fixture(scope="module")
def body() -> Body:
    model = load_anny()
    return model.at_shape(model.shape_defaults)


def width_mm(body: Body, finger: str) -> float:
    """Twice the mean distance of the surface of the middle bone from it, far from both of its ends."""
    start, end = (body.joints_m[body.joint(f"{finger}{number}")].astype(np.float64) for number in (2, 3))
    rows = body.skin_weights[:, [body.joint(f"{finger}{number}") for number in (1, 2, 3)]].sum(axis=1) > 0.9
    along = (body.vertices[rows] - start) @ (end - start) / ((end - start) ** 2).sum()
    middle = body.vertices[rows][(along > 0.2) & (along < 0.8)]
    return 2000.0 * float(np.linalg.norm(nearest_on_polyline(middle, np.stack([start, end])) - middle, axis=1).mean())


def test_the_nearest_point_of_a_polyline() -> None:
    line = np.array([[0.0, 0.0, 0.0], [1.0, 0.0, 0.0], [1.0, 2.0, 0.0]])
    points = np.array([[0.5, -0.2, 0.3], [1.4, 1.0, 0.0], [1.0, 5.0, 1.0], [-1.0, -1.0, 0.0]])
    assert np.allclose(nearest_on_polyline(points, line), [[0.5, 0, 0], [1, 1, 0], [1, 2, 0], [0, 0, 0]])


@pytest.mark.parametrize("wanted_mm", [4.0, 8.0])
def test_fingers_have_the_width_that_is_asked_for(body: Body, wanted_mm: float) -> None:
    thin = with_finger_width(body, 1e-3 * wanted_mm)
    for finger in ("LeftHandIndex", "LeftHandRing", "RightHandMiddle"):
        assert width_mm(body, finger) > 11.0
        assert width_mm(thin, finger) == pytest.approx(wanted_mm, rel=0.3)
    elsewhere = body.skin_weights[:, [body.joint(name) for name in JOINTS]].sum(axis=1) == 0.0
    assert np.array_equal(thin.vertices[elsewhere], body.vertices[elsewhere])
    assert np.array_equal(thin.faces, body.faces)
