"""Damage of images against closed forms: known gains, noise, shifts and shutters."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from data_tools.evaluate.truth import load_ground_truth
from data_tools.stress.captures import BITRATE, h264_at, make_capture, option_arguments, true_view_deg
from data_tools.stress.image_corruption import (
    IMAGE_CORRUPTIONS,
    READ_NOISE,
    SHOT_NOISE,
    add_sensor_noise,
    expose,
    flicker_gains,
    interpolate_pose,
)
from data_tools.synthetic.scene.capture import SyntheticCapture
from data_tools.synthetic.scene.movie import LOSSLESS, write_video
from pipeline.capture.video import open_frame_source, read_frames
from pipeline.geometry.colour import srgb_to_linear
from pipeline.io.image import to_float


@pytest.fixture(scope="module")
def capture(sample: Path) -> SyntheticCapture:
    return load_ground_truth(sample)


def linear(level: int) -> float:
    """Return the linear light of a level of sRGB."""
    return float(srgb_to_linear(np.array([level / 255.0]))[0])


def grey(level: int, count: int = 1) -> list[np.ndarray]:
    return [np.full((32, 48, 3), level, np.uint8) for _ in range(count)]


def test_exposure_multiplies_linear_light() -> None:
    (image,) = grey(100)
    exposed = srgb_to_linear(to_float(expose(image, 0.5)).astype(np.float64))
    assert np.allclose(exposed, 0.5 * linear(100), atol=2e-3)
    assert (expose(image, 100.0) == 255).all()
    assert (expose(image, 1.0) == image).all()


def test_flicker_has_the_gains_that_it_tells(capture: SyntheticCapture) -> None:
    gains = flicker_gains(20, 0.3)
    assert np.abs(gains - 1.0).max() <= 0.3
    assert np.ptp(gains) > 0.3
    flickered = IMAGE_CORRUPTIONS["flicker"](grey(110, 20), capture, 0.3)
    found = [linear(int(image[0, 0, 0])) / linear(110) for image in flickered]
    assert np.allclose(found, gains, rtol=0.02)


def test_noise_of_a_sensor_has_the_standard_deviation_of_its_light() -> None:
    image = np.full((200, 200, 3), 120, np.uint8)
    gain = 0.25
    noisy = srgb_to_linear(to_float(add_sensor_noise(image, gain, np.random.default_rng(0))).astype(np.float64))
    light = gain * linear(120)
    assert noisy.mean() == pytest.approx(light, rel=0.01)
    assert noisy.std() == pytest.approx(np.sqrt(READ_NOISE**2 + SHOT_NOISE**2 * light), rel=0.05)


def test_a_cut_removes_rows_at_the_bottom(capture: SyntheticCapture) -> None:
    image = np.arange(32, dtype=np.uint8)[:, None, None].repeat(48, 1).repeat(3, 2)
    (cut,) = IMAGE_CORRUPTIONS["cut_bottom"]([image], capture, 0.25)
    assert cut.shape == (24, 48, 3)
    assert (cut == image[:24]).all()


def test_a_box_is_in_the_middle_frames_only(capture: SyntheticCapture) -> None:
    boxed = IMAGE_CORRUPTIONS["box"](grey(10, 8), capture, 0.5)
    assert [bool((image != 10).any()) for image in boxed] == [False, False, True, True, True, True, False, False]


@pytest.mark.slow
def test_a_passer_by_crosses_the_picture(capture: SyntheticCapture) -> None:
    side_px = capture.camera.height
    images = [np.full((side_px, side_px, 3), 10, np.uint8) for _ in range(9)]
    passed = IMAGE_CORRUPTIONS["pedestrian"](images, capture, 1.0)
    columns = [np.flatnonzero((image != 10).any(axis=(0, 2))) for image in passed]
    middles = [found.mean() for found in columns if len(found)]
    assert len(middles) >= 3
    assert (np.diff(middles) > 0).all()


def test_an_open_shutter_blurs_motion_and_nothing_else(capture: SyntheticCapture) -> None:
    frame = capture.render_frame(0)[0]
    still = replace(capture, motion=capture.motion.select(np.zeros(2, np.int64)))
    (same, _) = IMAGE_CORRUPTIONS["shutter_deg"]([frame, frame], still, 180.0)
    assert np.abs(same.astype(int) - frame).max() <= 1
    moving = replace(capture, motion=capture.motion.select(np.array([0, 1])))
    (blurred, _) = IMAGE_CORRUPTIONS["shutter_deg"]([frame, frame], moving, 180.0)
    assert np.abs(blurred.astype(int) - frame).max() > 20


def test_poses_between_frames(capture: SyntheticCapture) -> None:
    motion = capture.motion
    for row in (0, 2):
        same = interpolate_pose(motion, float(row))
        assert np.allclose(same.root_translation_m, motion.root_translation_m[row], atol=1e-6)
        dots = np.abs((same.rotations_wxyz[0] * motion.rotations_wxyz[row]).sum(axis=1))
        assert np.allclose(dots, 1.0, atol=1e-6)
    between = interpolate_pose(motion, 0.5)
    ends = [np.abs((between.rotations_wxyz[0] * motion.rotations_wxyz[row]).sum(axis=1)) for row in (0, 1)]
    assert np.allclose(*ends, atol=1e-5)


def test_compression_costs_quality_with_the_rate(tmp_path: Path) -> None:
    random = np.random.default_rng(0)
    frames = [np.kron(random.integers(0, 255, (16, 16, 3)), np.ones((8, 8, 1))).astype(np.uint8) for _ in range(12)]
    sizes, errors = [], []
    for name, encoding in (("lossless", LOSSLESS), ("high", h264_at(2.0)), ("low", h264_at(0.1))):
        path = tmp_path / f"{name}.mp4"
        write_video(path, frames, 24.0, encoding)
        decoded = [frame.rgb for frame in read_frames(open_frame_source(path), lambda _: True, 512)]
        sizes.append(path.stat().st_size)
        errors.append(float(np.mean([(a.astype(float) - b) ** 2 for a, b in zip(decoded, frames, strict=True)])))
    assert sizes[0] > sizes[1] > sizes[2]
    assert errors[0] < errors[1] < errors[2]


def test_captures_are_made_once_and_share_their_truth(tmp_path: Path) -> None:
    options = {"frames": 3, "size": 64, "texture": 64, "novel_views": 0, "novel_poses": 0}
    damage = {"gain": 0.5, "erode_px": 1, BITRATE: 1}
    clean = make_capture(tmp_path, options, {})
    damaged = make_capture(tmp_path, options, damage)
    assert (damaged / "truth").resolve() == (clean / "truth").resolve()
    assert len(list((damaged / "video" / "masks").iterdir())) == 3
    times = [path.stat().st_mtime_ns for path in (clean, damaged)]
    assert make_capture(tmp_path, options, damage) == damaged
    assert [path.stat().st_mtime_ns for path in (clean, damaged)] == times
    assert 20.0 < true_view_deg(damaged) < 60.0


def test_options_become_arguments() -> None:
    options = {"frames": 8, "hand_on_hip": True, "ball": False, "light": "flat"}
    assert option_arguments(options) == ["--frames", "8", "--hand-on-hip", "--light", "flat"]
