"""Artifacts of the body stage: round trips; poses that are not finite are refused."""

from dataclasses import replace

import numpy as np
import pytest
import torch

from pipeline.body.body import Motion, load_anny
from pipeline.body.files import (
    FrameScores,
    load_body,
    load_camera,
    load_motion,
    load_observations,
    load_scores,
    save_body,
    save_camera,
    save_motion,
    save_observations,
    save_scores,
)
from pipeline.core.errors import UserError
from pipeline.geometry.camera import Camera
from pipeline.io.npz import save_npz
from tests.body.acting import synthetic_recording


def test_body_round_trip(tmp_path) -> None:
    parametric = load_anny()
    body = parametric.at_shape(parametric.shape_defaults)
    save_body(tmp_path / "body.npz", body)
    again = load_body(tmp_path / "body.npz")
    assert again.joint_names == body.joint_names
    assert again.shape == body.shape
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


def test_observations_round_trip_into_a_turned_world(tmp_path) -> None:
    """3D landmarks are directions in the world: they turn with it when the camera's pose changes."""
    recording = synthetic_recording(load_anny(), frames=4)
    observations, places_m = recording.observations(recording.camera), torch.rand(41, 3, dtype=torch.float64)
    save_observations(tmp_path / "observations.npz", observations, places_m)
    again, places = load_observations(tmp_path / "observations.npz", recording.time_s, recording.camera)
    for name in ("time_s", "landmarks_px", "landmarks_3d_m", "confidence", "confidence_3d"):
        torch.testing.assert_close(getattr(again, name), getattr(observations, name))
    torch.testing.assert_close(places, places_m)
    turn = np.eye(4)
    turn[:3, :3] = [[0.0, 0.0, 1.0], [0.0, 1.0, 0.0], [-1.0, 0.0, 0.0]]
    turned_camera = replace(recording.camera, world_to_camera=recording.camera.world_to_camera @ turn.T)
    turned, _ = load_observations(tmp_path / "observations.npz", recording.time_s, turned_camera)
    expected = observations.landmarks_3d_m @ torch.from_numpy(turn[:3, :3]).T
    torch.testing.assert_close(turned.landmarks_3d_m, expected)


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
    with pytest.raises(UserError, match=r"scores\.npz has no array .landmark_error_px.*run python -m stages body"):
        load_scores(tmp_path / "scores.npz")
