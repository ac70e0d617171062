"""Clothes are outside the body, end at their cuts, and do not change face and hands."""

from dataclasses import replace

import numpy as np
import pytest

from data_tools.synthetic.person.anatomy import EYE, SKIN, label_faces, measure_anatomy
from data_tools.synthetic.person.outfit import LAYERS, choose_outfit, compute_layer_depths_m
from data_tools.synthetic.person.person import make_person
from data_tools.synthetic.person.surface import append_midpoint_values, subdivide_at_midpoints
from data_tools.synthetic.rig.subject import Subject
from pipeline.body.body import Body, load_anny
from pipeline.geometry.mesh import Mesh


@pytest.fixture(scope="module")
def skin(bare: Body) -> np.ndarray:
    """Vertices and edge midpoints of the body without clothes, in the order of the clothed ones."""
    return append_midpoint_values(bare.vertices, subdivide_at_midpoints(bare.faces, len(bare.vertices))[0])


def dominated_by(subject: Subject, *parts: str) -> np.ndarray:
    columns = [index for index, name in enumerate(subject.body.joint_names) if name.endswith(parts)]
    return subject.body.skin_weights[:, columns].sum(axis=1) > 0.95


def test_clothes_are_outside_the_body(subject: Subject, skin: np.ndarray) -> None:
    """Torso and legs move outwards along the normals of the body, by 6 cm at most; cloth that spans a hollow's rim
    may cut off a few millimetres of it."""
    normals = Mesh(skin, subject.body.faces).vertex_normals()
    out_m = ((subject.body.vertices - skin) * normals).sum(axis=1)
    clothed = dominated_by(subject, "Spine", "Spine1") | dominated_by(subject, "UpLeg", "Leg")
    assert np.percentile(out_m[clothed], 10) > 0.001
    assert out_m[clothed].min() > -0.008
    assert out_m[clothed].max() < 0.06


def test_hands_and_eyes_are_unchanged(subject: Subject, skin: np.ndarray, bare: Body) -> None:
    moved = np.linalg.norm(subject.body.vertices - skin, axis=1)
    assert (
        moved[dominated_by(subject, "Hand", *(f"Hand{f}{k}" for f in ("Index", "Thumb") for k in (1, 2, 3)))].max() == 0
    )
    eyes = np.unique(bare.faces[label_faces(bare) == EYE])
    assert moved[eyes].max() == 0


def test_skeleton_is_unchanged(subject: Subject, bare: Body) -> None:
    assert np.array_equal(subject.body.joints_m, bare.joints_m)
    assert np.allclose(subject.body.skin_weights.sum(axis=1), 1.0, atol=1e-5)
    assert len(subject.body.faces) == len(subject.faces_uv) == 4 * len(bare.faces)


def test_shoes_cover_the_toes_and_have_flat_soles(subject: Subject) -> None:
    """The sole is planar, and the front of a shoe has a convex outline without gaps between toes."""
    vertices = subject.body.vertices
    foot = dominated_by(subject, "LeftFoot", "LeftToeBase") & (vertices[:, 1] < 0.06)
    sole = np.abs(vertices[foot, 1] - vertices[foot, 1].min()) < 1e-4
    assert sole.sum() > 50
    toes = vertices[foot & (vertices[:, 2] > subject.body.joints_m[subject.body.joint("LeftToeBase"), 2])]
    columns = np.digitize(toes[:, 0], np.linspace(toes[:, 0].min(), toes[:, 0].max(), 9)[1:-1])
    front = np.array([toes[columns == column, 2].max() for column in range(8)])
    second_differences = front[2:] - 2 * front[1:-1] + front[:-2]
    assert second_differences.max() < 0.012


def closed_edge_fraction(faces: np.ndarray) -> float:
    """Fraction of edges with exactly two faces."""
    edges = np.sort(faces[:, [[0, 1], [1, 2], [2, 0]]].reshape(-1, 2), axis=1)
    return float((np.unique(edges, axis=0, return_counts=True)[1] == 2).mean())


def test_clothed_surface_is_as_closed_as_the_body(subject: Subject, bare: Body) -> None:
    skin_only = label_faces(bare) == SKIN
    clothed = closed_edge_fraction(subject.body.faces[np.repeat(skin_only, 4)])
    assert clothed >= closed_edge_fraction(bare.faces[skin_only])


def test_layers_cover_their_body_regions(bare: Body) -> None:
    anatomy, outfit = measure_anatomy(load_anny(), bare), choose_outfit(0)
    joints = anatomy.joints_m
    between = 0.5 * (joints["LeftUpLeg"] + joints["LeftLeg"])
    points = np.stack(
        [
            joints["Spine1"],
            between,
            joints["LeftHand"],
            [0.0, anatomy.crown_y_m, anatomy.skull_m()[2]],
            joints["LeftToeBase"],
        ]
    ).astype(np.float32)
    arm_head_weights = np.array([[0, 0], [0, 0], [1, 0], [0, 1], [0, 0]], dtype=np.float32)
    inside = compute_layer_depths_m(points, arm_head_weights, anatomy, outfit) > 0
    names = [tuple(layer for layer, is_in in zip(LAYERS, row, strict=True) if is_in) for row in inside]
    assert names == [("shirt",), ("trousers",), (), ("hair",), ("shoes",)]


def test_a_longer_sleeve_covers_more(bare: Body) -> None:
    anatomy, outfit = measure_anatomy(load_anny(), bare), choose_outfit(0)
    elbow = anatomy.joints_m["LeftForeArm"][None]
    on_arm = np.array([[1.0, 0.0]], dtype=np.float32)
    shirt = LAYERS.index("shirt")
    assert compute_layer_depths_m(elbow, on_arm, anatomy, outfit)[0, shirt] < 0
    assert compute_layer_depths_m(elbow, on_arm, anatomy, replace(outfit, sleeve_fraction=1.3))[0, shirt] > 0


def test_anatomy_is_symmetric_and_in_place(bare: Body) -> None:
    anatomy = measure_anatomy(load_anny(), bare)
    assert anatomy.eyes_m[0, 0] > anatomy.mouth_m[0] > anatomy.eyes_m[1, 0]
    assert anatomy.ears_m[0, 0] > 0.05
    assert anatomy.ears_m[1, 0] < -0.05
    assert 0.01 < anatomy.eye_radius_m < 0.02
    assert anatomy.joints_m["Head"][1] < anatomy.mouth_m[1] < anatomy.eyes_m[:, 1].min() < anatomy.crown_y_m
    assert np.ptp(anatomy.eyes_m[:, 1]) < 0.002


@pytest.mark.parametrize("seed", [1, 2, 3])
def test_outfits_vary_with_the_seed(seed: int) -> None:
    assert choose_outfit(seed) == choose_outfit(seed)
    assert choose_outfit(seed) != choose_outfit(0)


@pytest.mark.slow
def test_wide_sleeves_widen_to_their_hem_alone() -> None:
    narrow, wide = (
        make_person(0, 64, replace(choose_outfit(0), sleeve_flare_m=flare_m))[0].body for flare_m in (0.0, 0.05)
    )
    moved_m = np.linalg.norm(wide.vertices - narrow.vertices, axis=1)
    joints = {name: narrow.joints_m[narrow.joint(name)] for name in ("LeftArm", "LeftForeArm", "Hips")}
    bone = joints["LeftForeArm"] - joints["LeftArm"]
    along = (narrow.vertices - joints["LeftArm"]) @ bone / (bone**2).sum()
    on_arm = narrow.skin_weights[:, [narrow.joint(name) for name in ("LeftArm", "LeftForeArm")]].sum(axis=1) > 0.9
    hem = on_arm & (along > 0.55) & (along < 0.64)
    assert moved_m[hem].mean() == pytest.approx(0.045, abs=0.01)
    assert moved_m[on_arm & (along > 0.8)].max() < 0.002
    assert moved_m[narrow.vertices[:, 1] < joints["Hips"][1]].max() < 0.002


@pytest.mark.parametrize(("seed", "heel_m"), [(0, 0.0), (205, 0.0), (1, 0.08)])
def test_shoes_are_closed_below(seed: int, heel_m: float) -> None:
    subject, bare = make_person(seed, 64, replace(choose_outfit(seed), heel_m=heel_m))
    mesh, labels = subject.body.mesh(), subject.labels
    assert labels is not None
    corners = mesh.vertices[mesh.faces]
    area = 0.5 * np.linalg.norm(np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]), axis=1)
    faces_down = (labels.of_face == labels.names.index("shoes")) & (mesh.face_normals()[:, 1] < -0.8)
    above_sole = corners[..., 1].mean(axis=1) > mesh.vertices[:, 1].min() + 0.01
    assert area[faces_down].sum() > 0.015  # both soles, square metres
    assert area[faces_down & above_sole].sum() < 0.15 * area[faces_down].sum()  # rims
    ankle = bare.joints_m[bare.joint("LeftFoot"), 1]
    assert ankle == pytest.approx(0.075 + heel_m, abs=0.03)


@pytest.mark.slow
def test_a_jacket_is_padded_down_to_the_wrists_and_wide_trousers_widen_to_their_hem() -> None:
    shirt, jacket, wide = (
        make_person(0, 64, replace(choose_outfit(0), **cut))[0].body
        for cut in ({}, {"jacket_m": 0.04}, {"trouser_flare_m": 0.05})
    )
    joints = {name: shirt.joints_m[shirt.joint(name)] for name in ("LeftForeArm", "LeftHand", "LeftFoot", "Hips")}
    moved_m = np.linalg.norm(jacket.vertices - shirt.vertices, axis=1)
    bone = joints["LeftHand"] - joints["LeftForeArm"]
    along = (shirt.vertices - joints["LeftForeArm"]) @ bone / (bone**2).sum()
    on_forearm = shirt.skin_weights[:, shirt.joint("LeftForeArm")] > 0.9
    assert 0.03 < moved_m[on_forearm & (along > 0.3) & (along < 0.6)].mean() < 0.06  # with the shirt's own thickness
    assert moved_m[shirt.vertices[:, 1] < joints["Hips"][1] - 0.15].max() < 0.002
    moved_m = np.linalg.norm(wide.vertices - shirt.vertices, axis=1)
    height = shirt.vertices[:, 1]
    assert moved_m[(height > joints["LeftFoot"][1]) & (height < joints["LeftFoot"][1] + 0.03)].mean() > 0.035
    assert moved_m[height > joints["Hips"][1]].max() < 0.002
