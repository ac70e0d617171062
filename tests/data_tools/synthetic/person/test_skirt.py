"""The skirt is one closed surface outside the other clothes, spans the gap between the legs and follows both legs."""

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import trimesh

from data_tools.evaluate.truth import verify_ground_truth
from data_tools.sample import main as make_sample
from data_tools.synthetic.person.anatomy import measure_anatomy
from data_tools.synthetic.person.outfit import LAYERS, choose_outfit, compute_layer_depths_m
from data_tools.synthetic.person.person import make_person
from data_tools.synthetic.person.skirt import COLUMNS, ROWS, THICKNESS_M, waist_and_hem_m
from data_tools.synthetic.rig.subject import Subject, load_subject
from pipeline.body.body import Body, load_anny
from tests.data_tools.synthetic.person.test_painting import colour_near, surface_at
from tests.data_tools.synthetic.shapes import ray_triangle_distances

SHEET_FACES = 4 * ROWS * COLUMNS


@pytest.fixture(scope="module")
def capture(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A small capture of the person in a skirt."""
    out = tmp_path_factory.mktemp("captures") / "skirt"
    small = ("--frames", "3", "--fps", "3", "--size", "160", "--texture", "512")
    make_sample([str(out), "--legwear", "skirt", *small, "--novel-views", "0", "--novel-poses", "0"])
    return out


@pytest.fixture(scope="module")
def person(capture: Path) -> Subject:
    return load_subject(capture / "truth")


@pytest.fixture(scope="module")
def corners(person: Subject) -> np.ndarray:
    """Triangles of the skirt; its faces and vertices come last."""
    return person.body.vertices[person.body.faces[-SHEET_FACES:]].astype(np.float64)


def test_skirt_is_one_closed_ring(person: Subject) -> None:
    """Watertight, Euler characteristic 0, one component, and the volume of a sheet: area times thickness."""
    skirt = trimesh.Trimesh(person.body.vertices, person.body.faces[-SHEET_FACES:], process=False)
    skirt.remove_unreferenced_vertices()
    assert skirt.is_watertight
    assert skirt.is_winding_consistent
    assert skirt.euler_number == 0
    assert skirt.body_count == 1
    assert skirt.volume == pytest.approx(THICKNESS_M * skirt.area / 2, rel=0.15)


@pytest.mark.slow
def test_flare_widens_the_hem_only() -> None:
    """The waist keeps its width; the mean radius of the hem grows by the difference of the flares."""
    rings = []
    for hem_flare_m in (0.07, 0.24):
        made, _ = make_person(0, 64, replace(choose_outfit(0, "skirt"), hem_flare_m=hem_flare_m))
        outside = made.body.vertices[-2 * ROWS * COLUMNS : -ROWS * COLUMNS].reshape(ROWS, COLUMNS, 3)
        centre = outside.mean(axis=1, keepdims=True)
        rings.append(np.linalg.norm((outside - centre)[..., [0, 2]], axis=2).mean(axis=1))
    assert rings[1][0] == pytest.approx(rings[0][0], abs=1e-4)
    assert rings[1][-1] - rings[0][-1] == pytest.approx(0.17, abs=0.01)


def test_a_dress_reaches_its_hem() -> None:
    outfit = replace(choose_outfit(0, "skirt"), hem_m=0.04)
    made, _ = make_person(0, 64, outfit)
    rows_m = made.body.vertices[-2 * ROWS * COLUMNS : -ROWS * COLUMNS, 1].reshape(ROWS, COLUMNS)
    np.testing.assert_allclose(rows_m[-1], 0.04, atol=1e-4)


def test_labels_name_garments_and_body_parts(person: Subject) -> None:
    labels = person.labels
    assert labels is not None
    assert {"arms", "hair", "hands", "head", "legs", "shirt", "shoes", "skirt"} <= set(labels.names)
    assert "trousers" not in labels.names
    name_of_face = np.array(labels.names)[labels.of_face]
    assert (name_of_face[-SHEET_FACES:] == "skirt").all()
    assert not (name_of_face[:-SHEET_FACES] == "skirt").any()
    height_m = person.body.vertices[person.body.faces].mean(axis=1)[:, 1]
    stature_m = person.body.height_m()
    middle = {name: height_m[name_of_face == name].mean() / stature_m for name in labels.names}
    assert middle["shoes"] < 0.06 < middle["legs"] < 0.5 < middle["shirt"] < 0.85 < middle["head"] < middle["hair"]
    hands = person.body.vertices[person.body.faces[name_of_face == "hands"]].mean(axis=1)
    assert np.abs(hands[:, 0]).min() > 0.3


def test_skirt_spans_the_gap_between_the_legs(person: Subject, corners: np.ndarray, bare: Body) -> None:
    """A line along Z between the knees hits no leg, and both sides of the skirt twice."""
    _, hem = waist_and_hem_m(measure_anatomy(load_anny(), bare), choose_outfit(0, "skirt"))
    start, back = np.array([0.0007, hem + 0.0131, 2.0]), np.array([0.0, 0.0, -1.0])
    assert len(ray_triangle_distances(start, back, corners)) == 4
    assert (
        len(
            ray_triangle_distances(
                start, back, person.body.vertices[person.body.faces[:-SHEET_FACES]].astype(np.float64)
            )
        )
        == 0
    )


def test_legs_and_shirt_are_inside_the_skirt(person: Subject, corners: np.ndarray, bare: Body) -> None:
    """Outward rays from the legs and the shirt hit both sides of the skirt."""
    waist, hem = waist_and_hem_m(measure_anatomy(load_anny(), bare), choose_outfit(0, "skirt"))
    vertices = person.body.vertices[: -2 * ROWS * COLUMNS]
    inner = (vertices[:, 1] > hem + 0.01) & (vertices[:, 1] < waist - 0.02) & (np.abs(vertices[:, 0]) < 0.28)
    chosen = np.random.default_rng(0).choice(np.flatnonzero(inner), 80, replace=False)
    for place in vertices[chosen].astype(np.float64):
        outwards = place * [1.0, 0.0, 1.0]
        assert len(ray_triangle_distances(place, outwards / np.linalg.norm(outwards), corners)) == 2


def test_skin_weights_blend_smoothly_between_the_legs(person: Subject) -> None:
    body = person.body
    weights = body.skin_weights[-2 * ROWS * COLUMNS :].reshape(2 * ROWS, COLUMNS, -1)[:ROWS]
    left, right = (weights[:, :, body.joint(f"{side}UpLeg")] for side in ("Left", "Right"))
    assert np.allclose(weights.sum(axis=2), 1.0, atol=1e-5)
    assert weights.min() >= 0
    assert left[-1, 0] > 0.95
    assert right[-1, COLUMNS // 2] > 0.95
    front, behind = COLUMNS // 4, 3 * COLUMNS // 4
    for middle in (front, behind):
        assert left[-1, middle] == pytest.approx(right[-1, middle], abs=0.1)
    assert (left + right)[0].max() < 0.1
    assert max(np.abs(np.diff(weights, axis=axis)).max() for axis in (0, 1)) < 0.15


def test_legs_are_bare(person: Subject, bare: Body) -> None:
    anatomy, outfit = measure_anatomy(load_anny(), bare), choose_outfit(0, "skirt")
    knee = bare.joints_m[bare.joint("LeftLeg")]
    depths = compute_layer_depths_m(knee[None], np.zeros((1, 2), np.float32), anatomy, outfit)
    assert depths[0, LAYERS.index("trousers")] < 0
    shin = surface_at(person, knee[0], knee[1] - 0.1, is_front=True)
    assert np.allclose(colour_near(person, shin), outfit.skin, atol=0.12)
    cloth = colour_near(person, surface_at(person, knee[0], knee[1] + 0.2, is_front=True), 0.03)
    low, high = np.minimum(outfit.skirt, outfit.plaid), np.maximum(outfit.skirt, outfit.plaid)
    assert ((low - 0.1 < cloth) & (cloth < high + 0.1)).all()


def test_ground_truth_with_a_skirt_reproduces_the_video(capture: Path) -> None:
    assert verify_ground_truth(capture).passes()
    assert json.loads((capture / "truth" / "capture_settings.json").read_text())["legwear"] == "skirt"
