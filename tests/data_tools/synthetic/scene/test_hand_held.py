"""The camera in a hand, against points that are projected."""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from data_tools.synthetic.scene.hand_held import PITCH_RATIO, ROLL_RATIO, hand_held_angles_rad, turn_picture


def test_angles_span_twice_the_amplitude():
    """Over a long time; the median of so many frames is near the middle."""
    angles = hand_held_angles_rad(2000, 24.0, 0.03) / (0.03 * np.array([PITCH_RATIO, 1, ROLL_RATIO]))
    span = np.ptp(angles, axis=0)
    assert (span <= 2.0).all()
    assert (span > 1.8).all()
    assert np.abs(angles).max() < 1.1
    assert not hand_held_angles_rad(10, 24.0, 0.0).any()


@pytest.mark.parametrize("count", [6, 96])
def test_the_median_orientation_is_that_of_the_still_camera(count: int):
    """Stabilised frames have it, and the ground truth is compared with them."""
    np.testing.assert_allclose(np.median(hand_held_angles_rad(count, 24.0, 0.03), axis=0), 0.0, atol=1e-12)


def test_a_dot_is_where_the_turned_camera_sees_it():
    image = np.zeros((90, 120, 3), np.uint8)
    image[28:33, 78:83] = 200
    angles = np.array([0.04, -0.06, 0.1])
    turned = turn_picture(image, 150.0, angles)[..., 0].astype(float)
    rows, columns = np.mgrid[:90, :120] + 0.5
    ray = Rotation.from_rotvec(angles).apply([(80.5 - 60.0) / 150.0, (30.5 - 45.0) / 150.0, 1.0])
    expected = 150.0 * ray[:2] / ray[2] + (60.0, 45.0)
    found = np.array([(columns * turned).sum(), (rows * turned).sum()]) / turned.sum()
    np.testing.assert_allclose(found, expected, atol=0.1)


def test_a_mask_is_turned_as_the_picture_is():
    mask = np.zeros((90, 120), np.uint8)
    mask[28:60, 50:83] = 255
    angles = np.array([0.04, -0.06, 0.1])
    picture = turn_picture(np.dstack([mask] * 3), 150.0, angles)
    np.testing.assert_array_equal(turn_picture(mask, 150.0, angles), picture[..., 1])
