"""Damage the true masks of a synthetic capture by a known amount; they are supplied to the run as `masks/`."""

from collections.abc import Callable, Mapping

import cv2
import numpy as np
import torch
from jaxtyping import UInt8

from data_tools.evaluate.compare_body import joint_positions
from data_tools.synthetic.scene.capture import SyntheticCapture
from pipeline.geometry.camera import project

Mask = UInt8[np.ndarray, "h w"]

HOLES_PER_FRAME = 6
LOST_LIMB_PERIOD = 5
"""A limb is lost in one of so many frames: 20 %."""

_LIMBS = (
    ("LeftForeArm", "LeftHand"),
    ("RightForeArm", "RightHand"),
    ("LeftLeg", "LeftFoot"),
    ("RightLeg", "RightFoot"),
)
_LIMB_WIDTH = 0.09
"""Width of what is lost about the bone of a limb, as a fraction of the stature."""


def erode(mask: Mask, radius_px: float) -> Mask:
    """Remove a border of `radius_px` pixels (a disk); negative: add one."""
    radius = round(abs(radius_px))
    if radius == 0:
        return mask
    disk = cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (2 * radius + 1, 2 * radius + 1))
    return cv2.erode(mask, disk) if radius_px > 0 else cv2.dilate(mask, disk)


def punch_holes(mask: Mask, radius_px: float, random: np.random.Generator) -> Mask:
    """Remove `HOLES_PER_FRAME` disks with centres on the person."""
    rows, columns = np.nonzero(mask >= 128)
    holed = mask.copy()
    for index in random.integers(0, max(len(rows), 1), HOLES_PER_FRAME if len(rows) else 0):
        cv2.circle(holed, (int(columns[index]), int(rows[index])), round(radius_px), (0,), -1)
    return holed


def blur(mask: Mask, sigma_px: float) -> Mask:
    """Blur the outline by a Gaussian."""
    return cv2.GaussianBlur(mask, (0, 0), sigma_px) if sigma_px > 0 else mask


def lose_limb(mask: Mask, capture: SyntheticCapture, frame: int) -> Mask:
    """Remove one forearm or lower leg with its hand or foot, another one in each damaged frame."""
    start, end = _LIMBS[(frame // LOST_LIMB_PERIOD) % len(_LIMBS)]
    body = capture.subject.body
    first, second = joint_positions(body, capture.motion.select(np.array([frame])), [start, end])[0]
    beyond = second + 0.6 * (second - first)
    ends_px, _ = project(torch.from_numpy(np.stack([first, beyond])).float(), capture.camera)
    width_px = _LIMB_WIDTH * body.height_m() * capture.camera.fy / abs(float(capture.ground_m[2]))
    corners = ends_px.round().int().tolist()
    lost = mask.copy()
    cv2.line(lost, corners[0], corners[1], (0,), round(width_px))
    return lost


def _lose_limbs(mask: Mask, capture: SyntheticCapture, frame: int, share: float) -> Mask:
    """Lose a limb in `share` of the frames."""
    period = round(1.0 / share) if share else 0
    return lose_limb(mask, capture, frame) if period and frame % period == 0 else mask


MASK_CORRUPTIONS: Mapping[str, Callable[[Mask, SyntheticCapture, int, float], Mask]] = {
    "erode_px": lambda mask, capture, frame, radius: erode(mask, radius),
    "blur_px": lambda mask, capture, frame, sigma: blur(mask, sigma),
    "holes_px": lambda mask, capture, frame, radius: punch_holes(mask, radius, np.random.default_rng([2, frame])),
    "lost_limb": _lose_limbs,
    "black": lambda mask, capture, frame, _: np.zeros_like(mask),
}
"""Corruptions of the mask of one frame, by name; each has one number."""
