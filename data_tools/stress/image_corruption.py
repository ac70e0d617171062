"""Damage the images of a synthetic capture by a known amount; the ground truth stays as it is.

Exposure, noise and blur act on linear light, as in a camera, and are rounded to 8 bits afterwards.
"""

from collections.abc import Callable
from dataclasses import replace

import cv2
import numpy as np
import torch
from jaxtyping import Float, UInt8

from data_tools.synthetic.person.person import make_person
from data_tools.synthetic.scene.capture import SyntheticCapture
from data_tools.synthetic.scene.hand_held import hand_held_angles_rad, turn_picture
from data_tools.synthetic.scene.motion import turn_in_a_pose
from data_tools.synthetic.scene.renderer import pose_vertices, render_subject
from pipeline.body.body import Motion, canonical_to_world
from pipeline.geometry.colour import linear_to_srgb, srgb_to_linear
from pipeline.geometry.rotation import slerp
from pipeline.io.image import to_float, to_uint8

Images = list[UInt8[np.ndarray, "_ _ 3"]]

READ_NOISE, SHOT_NOISE = 0.004, 0.03
"""Standard deviation of the noise of a small sensor in linear light: read noise, and shot noise at white."""

SHUTTER_SAMPLES = 5
PASSER_BY_SEED, PASSER_BY_DISTANCE_M = 7, 1.1
BOX_COLOUR = (150, 112, 74)


def flicker_gains(count: int, amplitude: float) -> Float[np.ndarray, "n"]:
    """Return the linear gain of each frame: 1 plus or minus at most `amplitude`, uniform; equal for equal arguments."""
    return 1.0 + amplitude * np.random.default_rng(0).uniform(-1.0, 1.0, count)


def expose(image: UInt8[np.ndarray, "h w 3"], gain: float) -> UInt8[np.ndarray, "h w 3"]:
    """Multiply the linear light of an sRGB image by a gain and clip at white."""
    return _to_srgb(gain * _to_linear(image))


def add_sensor_noise(
    image: UInt8[np.ndarray, "h w 3"], gain: float, random: np.random.Generator
) -> UInt8[np.ndarray, "h w 3"]:
    """Expose by `gain` and add the noise of the sensor, which does not become smaller with the light."""
    linear = gain * _to_linear(image)
    std = np.sqrt(READ_NOISE**2 + SHOT_NOISE**2 * np.clip(linear, 0.0, 1.0))
    return _to_srgb(linear + std * random.standard_normal(linear.shape))


def _flicker(images: Images, capture: SyntheticCapture, amplitude: float) -> Images:
    return [expose(image, gain) for image, gain in zip(images, flicker_gains(len(images), amplitude), strict=True)]


def _gain(images: Images, capture: SyntheticCapture, gain: float) -> Images:
    return [expose(image, gain) for image in images]


def _low_light(images: Images, capture: SyntheticCapture, gain: float) -> Images:
    random = np.random.default_rng(1)
    return [add_sensor_noise(image, gain, random) for image in images]


def _hand_held(images: Images, capture: SyntheticCapture, amplitude_px: float) -> Images:
    focal_px = capture.camera.fx
    angles_rad = hand_held_angles_rad(len(images), capture.fps, float(np.arctan(amplitude_px / focal_px)))
    return [turn_picture(image, focal_px, angles) for image, angles in zip(images, angles_rad, strict=True)]


def _cut_bottom(images: Images, capture: SyntheticCapture, share: float) -> Images:
    """Cut rows at the bottom of all images; share: of the height."""
    rows = 2 * round(0.5 * (1.0 - share) * images[0].shape[0])
    return [np.ascontiguousarray(image[:rows]) for image in images]


def _box(images: Images, capture: SyntheticCapture, share: float) -> Images:
    """Stand a box in front of the left half of the person, up to the hip, in the middle `share` of the frames."""
    height, width = images[0].shape[:2]
    first = round(0.5 * (1.0 - share) * len(images))
    boxed = []
    for index, image in enumerate(images):
        if first <= index < len(images) - first:
            image = image.copy()
            corner = (int(0.30 * width), int(0.55 * height))
            cv2.rectangle(image, corner, (int(0.49 * width), int(0.93 * height)), BOX_COLOUR, -1)
            cv2.rectangle(image, corner, (int(0.49 * width), int(0.60 * height)), (120, 88, 55), -1)
        boxed.append(image)
    return boxed


def _pedestrian(images: Images, capture: SyntheticCapture, share: float) -> Images:
    """Let another person walk past between camera and person, in the middle `share` of the frames."""
    subject, _ = make_person(PASSER_BY_SEED, texture_px=512)
    count = max(2, round(share * len(images)))
    ground_m = capture.ground_m + [0.0, 0.0, PASSER_BY_DISTANCE_M]
    motion = turn_in_a_pose(subject.body, 2, 1.0, ground_m, PASSER_BY_SEED)
    vertices = pose_vertices(subject, canonical_to_world(subject.body, motion)[0])
    half_width_m = 0.5 * capture.camera.width / capture.camera.fx * abs(float(ground_m[2])) + 0.6
    first = (len(images) - count) // 2
    passed = list(images)
    for index, offset_m in enumerate(np.linspace(-half_width_m, half_width_m, count)):
        moved = vertices + torch.tensor([offset_m, 0.0, 0.0])
        person = render_subject(subject, moved.float(), capture.camera, capture.light, capture.samples)
        image = person[..., :3] + (1.0 - person[..., 3:]) * to_float(images[first + index])
        passed[first + index] = to_uint8(np.clip(image, 0.0, 1.0))
    return passed


def _shutter(images: Images, capture: SyntheticCapture, shutter_deg: float) -> Images:
    """Render each frame as the mean, in linear light, of poses while the shutter is open; 360 is a whole interval."""
    if shutter_deg == 0.0:
        return images
    offsets = (np.arange(SHUTTER_SAMPLES) / (SHUTTER_SAMPLES - 1) - 0.5) * shutter_deg / 360.0
    blurred = []
    for index in range(len(images)):
        total = np.zeros(images[index].shape)
        for offset in offsets:
            position = float(np.clip(index + offset, 0.0, len(images) - 1.0))
            moment = replace(capture, motion=interpolate_pose(capture.motion, position))
            total += _to_linear(moment.render_frame(0)[0])
        blurred.append(_to_srgb(total / SHUTTER_SAMPLES))
    return blurred


def interpolate_pose(motion: Motion, position: float) -> Motion:
    """Return the pose between two frames as a motion of one frame; position: row of the motion, may be fractional."""
    row = min(int(position), len(motion.frame_index) - 2)
    share = position - row
    rotations = torch.from_numpy(motion.rotations_wxyz[[row, row + 1]]).double()
    rotation = slerp(rotations[0], rotations[1], torch.full((rotations.shape[1], 1), share, dtype=torch.float64))
    root = (1.0 - share) * motion.root_translation_m[row] + share * motion.root_translation_m[row + 1]
    one = motion.select(np.array([row]))
    return one.with_pose(rotation[None].float().numpy(), root[None].astype(np.float32))


IMAGE_CORRUPTIONS: dict[str, Callable[[Images, SyntheticCapture, float], Images]] = {
    "flicker": _flicker,
    "gain": _gain,
    "low_light": _low_light,
    "hand_held_px": _hand_held,
    "cut_bottom": _cut_bottom,
    "box": _box,
    "pedestrian": _pedestrian,
    "shutter_deg": _shutter,
}
"""Corruptions of all images of a capture, by name; each has one number."""


def _to_linear(image: UInt8[np.ndarray, "h w 3"]) -> Float[np.ndarray, "h w 3"]:
    return srgb_to_linear(to_float(image).astype(np.float64))


def _to_srgb(linear: Float[np.ndarray, "h w 3"]) -> UInt8[np.ndarray, "h w 3"]:
    return to_uint8(linear_to_srgb(np.clip(linear, 0.0, 1.0)))
