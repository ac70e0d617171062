"""Each recording that must be refused, and each that may pass with a warning, as numbers."""

import dataclasses
from pathlib import Path

import numpy as np
import pytest

from pipeline.capture.detection import Detections
from pipeline.capture.face_detector import undetected_face
from pipeline.capture.hand_detector import undetected_hands
from pipeline.capture.input_checks import assess_input, check_frames_that_differ, check_input, lacks_head_or_feet
from pipeline.capture.landmarks import PoseLandmark
from pipeline.core.errors import UserError
from pipeline.core.progress import take_warnings

PATH = Path("clip.mp4")


def make_detections(n: int) -> Detections:
    return Detections(
        frame_index=np.arange(n, dtype=np.int32),
        time_s=np.arange(n) / 30,
        found=np.ones(n, bool),
        n_people=np.where(np.arange(n) % 4 == 0, 1, -1).astype(np.int32),
        gray_thumbnails=np.full((n, 20, 20), 100, np.uint8),
        person_masks=np.ones((n, 20, 20), bool),
        landmarks_px=np.full((n, 33, 2), 50, np.float32),
        landmarks_visibility=np.ones((n, 33), np.float32),
        landmarks_world_m=np.zeros((n, 33, 3), np.float32),
        hands=undetected_hands(n),
        faces_px=undetected_face(n),
        masks_png=(b"",) * n,
        width=100,
        height=100,
        scale=1.0,
    )


@pytest.fixture
def good() -> Detections:
    return make_detections(20)


def changed(good: Detections, name: str, where, value) -> Detections:
    array = getattr(good, name).copy()
    array[where] = value
    return dataclasses.replace(good, **{name: array})


def test_a_person_without_head_or_feet_lacks_head_or_feet(good):
    """Columns of the mask are 5 px wide, the nose is at x = 50; the feet end at y = 50 of 100."""
    masks = good.person_masks.copy()
    masks[:, 0] = False
    masks[1, 0, 10] = masks[2, 0, 3] = masks[3, 5:9, -1] = True  # over the nose; a raised hand; a hand at the side
    frames = changed(changed(good, "person_masks", slice(None), masks), "landmarks_px", (4, 31, 1), 101.0)
    frames = changed(frames, "landmarks_px", (5, PoseLandmark.NOSE, 1), -1.0)
    frames = changed(frames, "landmarks_px", 6, np.nan)
    np.testing.assert_array_equal(np.flatnonzero(lacks_head_or_feet(frames)), [1, 4, 5])


def test_good_recording_passes_without_warning(good):
    check_input(good, PATH, 16)
    assess_input(good, 0.5, PATH)
    assert take_warnings() == []


@pytest.mark.parametrize(
    ("name", "where", "value", "message"),
    [
        ("gray_thumbnails", slice(None), 3, "all frames of clip.mp4 are black"),
        ("n_people", [4, 8], 3, r"several people \(for example in frame 4\)"),
        ("found", slice(None), False, "no person was found"),
        ("found", slice(5, None), False, "only 5 of 20 frames .*; film the whole body at half of the image"),
        ("landmarks_px", (slice(0, 11), [27, 28], 1), 120.0, "cut off above the feet in 11 of 20 frames"),
        ("landmarks_visibility", (slice(3, 20), [27, 28]), 0.01, "cut off .* in 17 of 20 frames .frame 3 first"),
        ("landmarks_px", (slice(15, 20), 23), np.nan, "known, .* in only 15 of the 20 frames .* landmarks.npz"),
        ("landmarks_px", (slice(0, 11), [23, 24], 0), 90.0, "is not upright"),
        ("landmarks_px", (slice(0, 11), [23, 24], 1), 10.0, "is not upright"),
        ("landmarks_world_m", (slice(5, 20), 11, 2), np.nan, "known, in pixels and in 3D, in only 5 of the 20"),
    ],
)
def test_unusable_recording_is_refused(good, name, where, value, message):
    with pytest.raises(UserError, match=message):
        check_input(changed(good, name, where, value), PATH, 16)


@pytest.mark.parametrize(
    ("name", "where", "value"),
    [
        ("n_people", 4, 2),
        ("landmarks_px", (slice(None), [23, 24]), (65.0, 80.0)),
        ("landmarks_px", (slice(0, 9), [23, 24], 0), 90.0),
        ("found", slice(17, None), False),
        ("landmarks_px", (slice(0, 9), [27, 28], 1), 120.0),
        ("landmarks_px", (slice(None), 27, 1), 120.0),
        ("landmarks_px", (slice(None), [27, 28]), np.nan),
        ("landmarks_px", (slice(None), slice(25, 33)), np.nan),
        ("landmarks_px", (slice(16, 20), 23), np.nan),
        ("gray_thumbnails", slice(0, 19), 0),
    ],
)
def test_tolerable_defects_pass(good, name, where, value):
    check_input(changed(good, name, where, value), PATH, 16)


def test_feet_are_cut_off_whatever_is_unknown_of_them(good):
    """The other foot's points are nan in frames 2 and 3; in frame 9, where all are, nothing is known."""
    points = good.landmarks_px.copy()
    points[2:4, 31, 1], points[2:4, 30], points[9, 29:33] = 101.0, np.nan, np.nan
    assess_input(dataclasses.replace(good, landmarks_px=points), 0.5, PATH)
    assert [warning.endswith("less sharp: 2-3") for warning in take_warnings()] == [True]


def make_moving_scene(shifts_px: list[int], levels: list[int]) -> Detections:
    """A person as a bright bar that walks before a wall of patches, which the camera's shift and the light change."""
    wall = np.random.default_rng(0).integers(60, 180, (16, 40), dtype=np.uint8).repeat(8, axis=0).repeat(8, axis=1)
    n = len(shifts_px)
    person_masks = np.zeros((n, 128, 320), bool)
    for k in range(n):
        person_masks[k, 20:120, 20 + 10 * k : 60 + 10 * k] = True
    scenes = np.stack([np.roll(wall, shift, axis=1) + level for shift, level in zip(shifts_px, levels, strict=True)])
    noise = np.random.default_rng(1).integers(-3, 4, scenes.shape)
    # A shadow falls on the wall beside the person, whose mask misses a hem of two pixels.
    shadows = np.roll(person_masks, 30, axis=2) & ~person_masks
    gray_thumbnails = np.where(person_masks, 240, np.where(shadows, 0.6 * scenes, scenes) + noise).astype(np.uint8)
    masks = person_masks & np.roll(person_masks, 2, axis=2)
    return dataclasses.replace(make_detections(n), gray_thumbnails=gray_thumbnails, person_masks=masks)


@pytest.mark.parametrize(
    ("shifts_px", "levels", "expected_text"),
    [
        ([0] * 20, [0] * 20, None),
        ([0] * 19 + [6], [0] * 20, None),
        ([0] * 15 + [6] * 5, [0] * 20, "changes in clip.mp4 (frames 15-19): the camera or the light seems to change"),
        ([0, 2, 4, 6, 5, 3, 1, -1, -3, -5] * 2, [0] * 20, "the camera or the light seems to change"),
        ([0] * 20, [0] * 16 + [30] * 4, "if the video shows two scenes, cut it there"),
    ],
    ids=["still", "one jolt", "pushed", "in the hand", "brighter"],
)
def test_moving_camera_is_reported(shifts_px, levels, expected_text):
    metrics = assess_input(make_moving_scene(shifts_px, levels), 0.5, PATH)
    assert (metrics["scene_change_share"] >= 0.2) == (expected_text is not None)
    warnings = take_warnings()
    assert [expected_text in warning for warning in warnings] == ([True] if expected_text else []), warnings


@pytest.mark.parametrize(
    ("shifts_px", "levels", "first"),
    [
        ([0] * 15 + [6] * 5, [0] * 20, 15),
        ([6] * 4 + [0] * 16, [0] * 20, 4),
        ([0] * 8 + [6] * 5 + [0] * 7, [0] * 20, None),
    ],
    ids=["late cut", "early cut", "twice"],
)
def test_a_scene_that_changes_once_is_a_place_to_cut(shifts_px, levels, first):
    assess_input(make_moving_scene(shifts_px, levels), 0.5, PATH)
    (message,) = take_warnings()
    advice = f"; from frame {first} on the scene is another one: if the video shows two scenes, cut it there"
    assert message.endswith("locked exposure" if first is None else advice)


def test_recordings_that_repeat_their_frames_are_refused():
    check_frames_that_differ(16, 200, PATH, 16)
    with pytest.raises(UserError, match="clip.mp4 has only 15 frames that differ .* 200 .* film a slow full turn"):
        check_frames_that_differ(15, 200, PATH, 16)


@pytest.mark.parametrize(
    ("name", "where", "value", "unseen_arc_rad", "message"),
    [
        ("found", [2, 3, 9], False, 0.5, "3 of 20 frames of clip.mp4 show no person and are dropped: 2-3, 9"),
        ("landmarks_px", (slice(0, 4), 31, 1), 101.0, 0.5, "feet are cut off in 4 frames of clip.mp4; the avatar"),
        ("landmarks_px", (slice(7, 9), 31, 1), 101.0, 0.5, "feet will be less sharp: 7-8"),
        ("found", [], False, np.pi, "never seen from 180 degrees"),
    ],
)
def test_missing_data_is_reported(good, name, where, value, unseen_arc_rad, message):
    metrics = assess_input(changed(good, name, where, value), unseen_arc_rad, PATH)
    assert metrics["cut_feet_share"] == (len(range(*where[0].indices(20))) / 20 if name == "landmarks_px" else 0.0)
    assert [message in warning for warning in take_warnings()] == [True]


def test_small_person_in_large_image_is_reported(good):
    """3840 x 2160 was shrunk to 1280 x 720, half of whose height the person fills; 640 px need a side of 2276."""
    person_masks = np.zeros((20, 18, 32), bool)
    person_masks[:, 4:13, 14:18] = True
    small = dataclasses.replace(
        good,
        person_masks=person_masks,
        gray_thumbnails=np.full((20, 18, 32), 100, np.uint8),
        width=1280,
        height=720,
        scale=1 / 3,
    )
    assert assess_input(small, 0.5, PATH)["person_px"] == pytest.approx(360.0)
    (message,) = take_warnings()
    assert "1080 px tall in clip.mp4 and 360 px" in message
    assert "frames.max_side_px=2276" in message
    assess_input(dataclasses.replace(small, scale=1.0), 0.5, PATH)
    assess_input(dataclasses.replace(small, width=2560, height=1440), 0.5, PATH)
    assert take_warnings() == []
