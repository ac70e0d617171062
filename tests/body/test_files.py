"""Artifacts of the body stage: round trips; poses that are not finite are refused."""

from dataclasses import replace

import numpy as np
import pytest

from pipeline.body.body import Motion, load_anny
from pipeline.body.files import (
    FrameScores,
    load_body,
    load_camera,
    load_motion,
    load_scores,
    save_body,
    save_camera,
    save_motion,
    save_scores,
)
from pipeline.core.errors import UserError
from pipeline.geometry.camera import Camera
from pipeline.io.npz import save_npz


@pytest.mark.parametrize("hem_m", [None, 0.5])
def test_body_round_trip(tmp_path, hem_m) -> None:
    parametric = load_anny()
    body = replace(parametric.at_shape(parametric.shape_defaults), hem_m=hem_m)
    save_body(tmp_path / "body.npz", body)
    again = load_body(tmp_path / "body.npz")
    assert again.joint_names == body.joint_names
    assert (again.shape, again.hem_m) == (body.shape, body.hem_m)
    for name in ("parents", "joints_m", "vertices", "faces", "skin_weights"):
        np.testing.assert_array_equal(getattr(again, name), getattr(body, name))


def test_camera_round_trip(tmp_path) -> None:
    camera = Camera(1.5, 2.5, 3.0, 4.0, 50, 60)
    save_camera(tmp_path / "camera.npz", camera)
    again = load_camera(tmp_path / "camera.npz")
    assert again.fx == 1.5
    assert again.height == 60


@pytest.mark.parametrize("place", ["rotations_wxyz", "root_translation_m"])
def test_poses_that_are_not_finite_are_refused_with_their_frames(tmp_path, place) -> None:
    turns = np.tile(np.float32([1, 0, 0, 0]), (5, 3, 1))
    motion = Motion(np.arange(10, 60, 10), np.arange(5.0), turns, np.zeros((5, 3), np.float32))
    save_motion(tmp_path / "motion.npz", motion)
    np.testing.assert_array_equal(load_motion(tmp_path / "motion.npz").rotations_wxyz, turns)
    values = getattr(motion, place)
    values[1, -1], values[4, 0] = np.nan, np.inf
    save_motion(tmp_path / "motion.npz", motion)
    with pytest.raises(UserError, match=r"motion.npz: the poses of frames 20, 50 are not finite"):
        load_motion(tmp_path / "motion.npz")


def test_scores_round_trip(tmp_path) -> None:
    values = np.array([0.5, np.nan])
    flags = np.array([True, False])
    scores = FrameScores(np.array([3, 6]), values, values + 1.0, flags, values + 2.0, ~flags)
    save_scores(tmp_path / "scores.npz", scores)
    again = load_scores(tmp_path / "scores.npz")
    for name, array in vars(scores).items():
        np.testing.assert_array_equal(getattr(again, name), array)


def test_scores_of_an_older_version_are_refused(tmp_path) -> None:
    save_npz(tmp_path / "scores.npz", {"frame_index": np.arange(2), "silhouette_iou": np.ones(2)})
    with pytest.raises(UserError, match=r"scores\.npz has no array .landmark_error_px.*run .*python -m stages body"):
        load_scores(tmp_path / "scores.npz")
