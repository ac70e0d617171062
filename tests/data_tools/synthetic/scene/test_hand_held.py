"""The camera in a hand, against points that are projected."""

import numpy as np
from scipy.spatial.transform import Rotation

from data_tools.synthetic.scene.hand_held import PITCH_RATIO, ROLL_RATIO, hand_held_angles_rad, turn_picture


def test_angles_stay_within_the_amplitude_and_use_most_of_it():
    largest = np.abs(hand_held_angles_rad(2000, 24.0, 0.03)).max(axis=0) / (
        0.03 * np.array([PITCH_RATIO, 1, ROLL_RATIO])
    )
    assert (largest <= 1.0).all()
    assert (largest > 0.9).all()
    assert not hand_held_angles_rad(10, 24.0, 0.0).any()


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
