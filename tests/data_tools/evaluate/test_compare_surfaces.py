"""Scores of the surface: parts of the truth, and distances without alignment."""

from dataclasses import replace

import numpy as np
import pytest
import torch
import trimesh
from scipy.spatial import cKDTree

from data_tools.evaluate.compare_avatar import (
    compare_clay,
    compare_heldout_surfaces,
    compare_labelled_surfaces,
    compare_matched_surfaces,
    compare_novel_poses,
    compare_rest_surfaces,
    compare_shown_surface,
)
from data_tools.evaluate.comparison import Comparison
from data_tools.evaluate.shown_surface import shown_faces
from tests.data_tools.ground_truth_run import with_motion, with_scale


@pytest.mark.slow
def test_a_wrong_part_is_found_by_its_label(perfect: Comparison) -> None:
    """The hair of the avatar stands out by 6 mm: its label shows that, the shoes' does not."""
    subject = perfect.truth.subject
    labels = subject.labels
    assert labels is not None
    hair = np.unique(subject.body.faces[labels.of_face == labels.names.index("hair")])
    vertices = subject.body.vertices.copy()
    vertices[hair] += 0.006 * subject.body.mesh().vertex_normals()[hair]
    avatar = replace(perfect.run.avatar, vertices=torch.from_numpy(vertices))
    scores = compare_labelled_surfaces(replace(perfect, run=replace(perfect.run, avatar=avatar)))
    right = compare_labelled_surfaces(perfect)
    assert scores["hair"]["chamfer_mm"] == pytest.approx(6.0, abs=1.2)
    assert scores["shoes"]["chamfer_mm"] < 1.0  # the hair shifts the alignment a little
    assert max(part["chamfer_mm"] for part in right.values()) < 0.3
    assert sum(part["area_share"] for part in right.values()) == pytest.approx(1.0)


@pytest.mark.slow
def test_clay_shows_where_the_shape_is_wrong(perfect: Comparison) -> None:
    """Truth and avatar are equal in clay; a dent in the chest of the avatar is seen from the front only."""
    body = perfect.truth.subject.body
    for pair in compare_clay(perfect):
        assert pair.scores()["psnr_body"] > 30.0
    at_height = np.abs(body.vertices[:, 1] - body.joints_m[body.joint("Spine2")][1]) < 0.02
    chest_m = body.vertices[at_height][body.vertices[at_height, 2].argmax()]
    near = np.exp(-(((body.vertices - chest_m) / 0.08) ** 2).sum(axis=1))
    dented = body.vertices - 0.03 * near[:, None].astype(np.float32) * np.array([0, 0, 1], np.float32)
    avatar = replace(perfect.run.avatar, vertices=torch.from_numpy(dented))
    wrong = [
        pair.scores()["psnr_body"] for pair in compare_clay(replace(perfect, run=replace(perfect.run, avatar=avatar)))
    ]
    assert len(wrong) == 8
    assert wrong[0] < wrong[4] - 1.0


def test_a_capture_without_labels_has_no_parts(perfect: Comparison) -> None:
    older = replace(perfect, truth=replace(perfect.truth, subject=replace(perfect.truth.subject, labels=None)))
    assert compare_labelled_surfaces(older) == {}


@pytest.mark.slow
def test_without_alignment_a_smaller_person_is_wrong(perfect: Comparison) -> None:
    """A person of nine tenths on the same floor: each point is moved by a tenth of its distance from the origin."""
    true = perfect.true_rest_mesh
    scores = compare_rest_surfaces(with_scale(perfect, 0.9))
    assert scores["stature_mm"] == pytest.approx(0.9 * scores["true_stature_mm"], abs=2.0)
    assert scores["true_stature_mm"] == pytest.approx(1000 * np.ptp(true.vertices[:, 1]), abs=0.1)
    smaller = trimesh.Trimesh(0.9 * true.vertices, true.faces, process=False)
    same = trimesh.Trimesh(true.vertices, true.faces, process=False)
    dense = [trimesh.sample.sample_surface(surface, 100_000, seed=3)[0] for surface in (smaller, same)]
    expected_mm = 500 * sum(cKDTree(target).query(source[::5])[0].mean() for source, target in (dense, dense[::-1]))
    assert scores["chamfer_unaligned_mm"] == pytest.approx(expected_mm, rel=0.08)
    assert compare_rest_surfaces(perfect)["chamfer_unaligned_mm"] < 0.2


@pytest.mark.slow
def test_without_alignment_a_wrong_distance_is_an_error(perfect: Comparison) -> None:
    """The person 5 cm too far away in all frames: aligned there is no error, unaligned up to 5 cm."""
    motion = perfect.run.motion
    farther = motion.with_pose(motion.rotations_wxyz, motion.root_translation_m + np.array([0, 0, -0.05], np.float32))
    scores = compare_heldout_surfaces(with_motion(perfect, farther))
    assert scores["chamfer_mm"] < 0.2
    assert 5.0 < scores["chamfer_unaligned_mm"] < 50.0
    assert compare_heldout_surfaces(perfect)["chamfer_unaligned_mm"] < 0.2
    assert compare_novel_poses(perfect)[0]["novel_poses"]["chamfer_unaligned_mm"] < 1.0


@pytest.mark.slow
def test_what_no_frame_shows_does_not_count_as_shown(perfect: Comparison) -> None:
    """A turn shows chest and back, not the soles; soles that stand out by 2 cm are an error of the whole."""
    shown, true = shown_faces(perfect.rigs), perfect.true_rest_mesh
    normals, centres_m = true.face_normals(), true.vertices[true.faces].mean(axis=1)
    floor_m = true.vertices[:, 1].min()
    is_sole = (normals[:, 1] < -0.9) & (centres_m[:, 1] < floor_m + 0.01)
    is_trunk = (
        (np.abs(normals[:, 2]) > 0.9)
        & (np.abs(centres_m[:, 0]) < 0.08)
        & (np.abs(centres_m[:, 1] - floor_m - 1.2) < 0.1)
    )
    assert is_sole.sum() > 50
    assert shown[is_sole].mean() < 0.1
    assert shown[is_trunk].mean() > 0.95
    soles = np.unique(true.faces[is_sole])
    vertices = perfect.truth.subject.body.vertices.copy()
    vertices[soles, 1] -= 0.02
    avatar = replace(perfect.run.avatar, vertices=torch.from_numpy(vertices))
    wrong = replace(perfect, run=replace(perfect.run, avatar=avatar))
    whole, part = compare_matched_surfaces(wrong), compare_shown_surface(wrong)
    assert 0.5 < part["area_share"] < 1.0
    assert part["chamfer_mm"] < whole["chamfer_mm"] - 0.15  # the alignment moves all by half of that
