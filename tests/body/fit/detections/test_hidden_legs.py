"""Guessed landmarks and the cut outline of a leg that a box hides do not bend it."""

from dataclasses import replace

import numpy as np
import pytest
import torch

from pipeline.body.body import load_anny
from pipeline.body.fit.detections.hidden_legs import (
    LEG_JOINTS,
    LEG_LANDMARKS,
    MIN_SHOWN,
    hidden_leg_share,
    leg_visibility_factor,
    outline_weights,
)
from pipeline.body.fit.diagnostics import make_observations
from pipeline.body.fit.fit import fit_body
from pipeline.body.fit.landmark_regressor import LANDMARK_COUNT
from pipeline.body.fit.linear_body import ACTIVE_JOINTS
from pipeline.body.fit.options import FitOptions
from pipeline.body.fit.silhouette_icp import crop_mask_window, posed_vertices
from pipeline.geometry.camera import project
from pipeline.kernels.raster import rasterize
from tests.body.acting import SyntheticRecording, fitted_joints_m, simulate_detections, synthetic_recording

FPS = 24.0
LEFT_KNEE, LEFT_ANKLE, RIGHT_KNEE = 25, 27, 26
TURN_FRAMES = 24


def test_a_leg_that_is_hidden_once_is_hidden_in_the_frames_beside() -> None:
    visibility = np.ones((12, 33))
    visibility[6, LEFT_ANKLE] = 0.1
    visibility[3, RIGHT_KNEE] = 0.35
    factor = leg_visibility_factor(visibility, np.arange(12) / FPS)
    left, right = (factor[:, list(landmarks)] for landmarks in LEG_LANDMARKS)
    assert np.flatnonzero(left[:, 0] == MIN_SHOWN).tolist() == [4, 5, 6, 7, 8]
    assert (left == left[:, :1]).all()
    assert right[1:6] == pytest.approx(0.5)
    assert right[6:] == pytest.approx(1.0)
    assert hidden_leg_share(visibility, np.arange(12) / FPS) == pytest.approx(5 / 12)
    assert (np.delete(factor, [*LEG_LANDMARKS[0], *LEG_LANDMARKS[1]], axis=1) == 1.0).all()


def test_a_frame_in_which_nobody_was_detected_hides_no_leg() -> None:
    visibility = np.ones((12, 33))
    visibility[6] = np.nan
    assert (leg_visibility_factor(visibility, np.arange(12) / FPS) == 1.0).all()
    assert hidden_leg_share(visibility, np.arange(12) / FPS) == 0.0


def test_the_outline_of_a_hidden_leg_has_no_weight_but_undetected_ones_do() -> None:
    confidence = torch.ones(2, LANDMARK_COUNT)
    confidence[0, LEFT_KNEE] = 1e-4
    confidence[1] = 0.0
    weight = outline_weights(confidence)
    hidden = [index for index, name in enumerate(ACTIVE_JOINTS) if name in ("LeftUpLeg", "LeftLeg", "LeftFoot")]
    assert weight[0, hidden].max() < 1e-3
    assert weight[0].sum() == pytest.approx(len(ACTIVE_JOINTS) - 4, abs=0.01)
    assert (weight[1] == 1.0).all()


def standing_recording() -> SyntheticRecording:
    """Return a turn of someone whose legs stay as they are."""
    moving = synthetic_recording(load_anny(), TURN_FRAMES)
    rotations = moving.state.rotations.clone()
    legs = [ACTIVE_JOINTS.index(side + name) for side in ("Left", "Right") for name in LEG_JOINTS]
    rotations[:, legs] = rotations[:1, legs]
    state = replace(moving.state, rotations=rotations)
    return simulate_detections(load_anny(), moving.model, state, moving.camera, moving.time_s)


def masks_without_left_leg(scene: SyntheticRecording, frames: range) -> list[np.ndarray]:
    """Return the masks; in these frames something covers what is seen of the left leg."""
    leg = torch.tensor([ACTIVE_JOINTS.index("Left" + name) for name in LEG_JOINTS])
    is_leg = torch.isin(scene.model.skin_weights.argmax(1)[scene.model.faces[:, 0].long()], leg).numpy()
    masks = scene.masks()
    vertices = posed_vertices(scene.model, scene.state)
    for frame in frames:
        pixels, depth_m = project(vertices[frame], scene.camera)
        face_id = rasterize(pixels, depth_m, scene.model.faces, scene.camera.height, scene.camera.width)[0].numpy()
        masks[frame][(face_id >= 0) & is_leg[face_id]] = 0
    return masks


@pytest.mark.slow
def test_an_object_before_a_leg_does_not_bend_it() -> None:
    """The detector takes the other leg for it. Without the factor on the confidence, the ankle is 0.6 m off."""
    scene, hidden = standing_recording(), range(9, 15)
    left, right = (list(landmarks) for landmarks in LEG_LANDMARKS)
    visibility = np.ones((TURN_FRAMES, 33))
    for frame in hidden:
        visibility[frame, left] = 0.15
        scene.landmarks_px[frame, left] = scene.landmarks_px[frame, right]
        scene.landmarks_world_m[frame, left] = scene.landmarks_world_m[frame, right]
    observations = make_observations(
        scene.time_s, scene.landmarks_px, visibility, scene.landmarks_world_m, scene.camera
    )
    windows = [crop_mask_window(mask) for mask in masks_without_left_leg(scene, hidden)]
    options = FitOptions(scene.model.height_m()[0], 0.0, shared_frames=12, rounds=4)
    found = fit_body(load_anny(), observations, windows, options)
    error_m = (fitted_joints_m(found, scene) - scene.joints_m()).norm(dim=-1)
    assert float(error_m[list(hidden), ACTIVE_JOINTS.index("LeftFoot")].max()) < 0.1
