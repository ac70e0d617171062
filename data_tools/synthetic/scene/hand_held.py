"""The camera in a hand: it turns while it films, about its own centre."""

import cv2
import numpy as np
from jaxtyping import Float, UInt8

SWAY_HZ = ((0.23, 0.71, 2.9), (0.31, 0.83, 3.3), (0.17, 0.63, 2.3))
"""Frequencies of pitch, yaw and roll; the person who holds the camera sways slowly and trembles."""
SWAY_SHARES = (0.7, 0.25, 0.05)
PITCH_RATIO, ROLL_RATIO = 0.6, 0.6
"""Amplitudes against that of yaw."""


def hand_held_angles_rad(count: int, fps: float, amplitude_rad: float) -> Float[np.ndarray, "n 3"]:
    """Return pitch, yaw and roll of each frame. Equal arguments give equal angles.

    The median of each is zero: the median orientation, to which the pipeline stabilises frames, is that of the ground
    truth. amplitude_rad: of yaw, about the middle of a long recording.
    """
    time_s = np.arange(count) / fps
    angles = np.zeros((count, 3))
    for axis, (hertz, ratio) in enumerate(zip(SWAY_HZ, (PITCH_RATIO, 1.0, ROLL_RATIO), strict=True)):
        for frequency, share in zip(hertz, SWAY_SHARES, strict=True):
            phase = 2.0 * axis + 5.0 * frequency
            angles[:, axis] += amplitude_rad * ratio * share * np.sin(2.0 * np.pi * frequency * time_s + phase)
    return angles - np.median(angles, axis=0)


def turn_picture(
    image: UInt8[np.ndarray, "h w *c"], focal_px: float, angles_rad: Float[np.ndarray, "3"]
) -> UInt8[np.ndarray, "h w *c"]:
    """Return the picture or mask of the turned camera (pitch, yaw, roll); what was not filmed is mirrored."""
    height, width = image.shape[:2]
    # OpenCV's pixel centres are whole numbers.
    to_pixels = np.array([[focal_px, 0.0, (width - 1) / 2], [0.0, focal_px, (height - 1) / 2], [0.0, 0.0, 1.0]])
    matrix = to_pixels @ cv2.Rodrigues(angles_rad)[0] @ np.linalg.inv(to_pixels)
    turned: np.ndarray = cv2.warpPerspective(
        image, matrix, (width, height), flags=cv2.INTER_CUBIC, borderMode=cv2.BORDER_REFLECT_101
    )
    return turned
