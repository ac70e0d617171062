"""Scores of a field against the truth: haze of known alphas, and a camera that sees through a similarity transform."""

import numpy as np
import pytest
import torch

from data_tools.evaluate.field_truth import HAZE_DISTANCE_PX, camera_before_similarity, haze_alpha
from pipeline.geometry.camera import Camera, project
from pipeline.geometry.rotation import axis_angle_to_quaternion, quaternion_to_matrix
from pipeline.geometry.similarity import SimilarityTransform


def test_haze_is_the_mean_alpha_off_the_mask():
    truth = np.zeros((200, 120), np.uint8)
    truth[50:150, 40:80] = 255
    assert haze_alpha(truth / 255.0, truth) == 0.0
    # The box is 10 px wider on all sides. A strip of 4 px at its border, farther than 6 px from the mask, remains.
    assert haze_alpha(np.full(truth.shape, 0.2, np.float32), truth) == pytest.approx(0.2)
    alpha = np.zeros(truth.shape, np.float32)
    alpha[:40] = alpha[160:] = 1.0
    assert haze_alpha(alpha, truth) == 0.0
    near = np.zeros(truth.shape, np.float32)
    near[50:150, 80 : 80 + int(HAZE_DISTANCE_PX)] = 1.0
    assert haze_alpha(near, truth) == 0.0
    far = np.zeros(truth.shape, np.float32)
    far[50:150, 80 + int(HAZE_DISTANCE_PX) : 90] = 1.0
    # Of the 100 x 4 px strips on both sides and 40 x 4 px above and below, and the corners without their quarter discs.
    corners = sum(np.hypot(x, y) > HAZE_DISTANCE_PX for x in range(1, 11) for y in range(1, 11))
    assert haze_alpha(far, truth) == pytest.approx(400 / (2 * 400 + 2 * 160 + 4 * corners), rel=1e-6)


def test_haze_of_an_empty_mask_is_refused():
    with pytest.raises(ValueError, match="empty"):
        haze_alpha(np.zeros((4, 4), np.float32), np.zeros((4, 4), np.uint8))


def test_a_camera_before_a_similarity_sees_the_same_pixels():
    random = torch.Generator().manual_seed(0)
    turns = quaternion_to_matrix(axis_angle_to_quaternion(torch.randn(2, 3, generator=random).double())).numpy()
    world_to_camera = np.eye(4, dtype=np.float32)
    world_to_camera[:3, :3], world_to_camera[:3, 3] = turns[0], (0.1, -0.2, 3.0)
    camera = Camera(width=320, height=240, fx=300.0, fy=310.0, cx=161.0, cy=118.0, world_to_camera=world_to_camera)
    transform = SimilarityTransform(1.3, turns[1], np.array([0.05, 0.2, -0.1]))
    points = torch.rand(40, 3, generator=random).double().numpy() - 0.5
    expected_px, depth_m = project(torch.from_numpy(transform(points)).float(), camera)
    found_px, found_depth_m = project(torch.from_numpy(points).float(), camera_before_similarity(camera, transform))
    torch.testing.assert_close(found_px, expected_px, atol=1e-2, rtol=1e-4)
    torch.testing.assert_close(found_depth_m * 1.3, depth_m, atol=1e-4, rtol=1e-4)
