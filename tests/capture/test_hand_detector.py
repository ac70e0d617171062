"""The hand model on a real picture, and what is not looked at."""

from types import SimpleNamespace

import numpy as np
import pytest

from pipeline.capture.hand_detector import HandDetector, image_scale_px_per_m, stack_hands, undetected_hands
from pipeline.capture.landmarks import PoseLandmark
from pipeline.capture.person_detector import PersonDetection, PersonDetector
from pipeline.capture.video import open_frame_source, read_frames


@pytest.fixture(scope="module")
def detector() -> HandDetector:
    return HandDetector()


@pytest.fixture(scope="module")
def photograph(shared_data) -> np.ndarray:
    source = open_frame_source(shared_data / "real" / "dakse" / "video.mp4")
    return next(read_frames(source, lambda index: index == 185, 2000)).rgb


@pytest.fixture(scope="module")
def person(photograph) -> PersonDetection:
    found = PersonDetector().detect(photograph)
    assert found is not None
    return found


def test_a_hand_seen_from_its_back_is_found_and_the_hidden_one_is_not(detector, photograph, person):
    hands = detector.detect_hands(photograph, person.landmarks_px, person.visibility, person.landmarks_world_m)
    assert hands.handedness_score[0] > 0.9
    assert hands.handedness_score[1] == 0.0  # behind the back
    assert np.isnan(hands.landmarks_px[1]).all()
    wrist_px = person.landmarks_px[PoseLandmark.LEFT_WRIST]
    points_px = hands.landmarks_px[0]
    assert np.linalg.norm(points_px[0] - wrist_px) < 12
    assert (points_px[[8, 12, 16, 20], 1] > points_px[0, 1] + 25).all()  # fingers hang
    assert points_px[4, 0] < points_px[20, 0]  # thumb towards the body, which stands left of it
    from_wrist_m = hands.landmarks_m[0] - hands.landmarks_m[0, 0]
    assert (from_wrist_m[[8, 12, 16, 20], 1] > 0.06).all()
    assert from_wrist_m[4, 0] < from_wrist_m[20, 0]
    assert 0.05 < np.linalg.norm(hands.landmarks_m[0, 9] - hands.landmarks_m[0, 0]) < 0.12


def test_the_other_hand_is_known_as_such(detector, photograph, person):
    """In a mirrored picture the left hand is a right one."""
    mirrored = np.ascontiguousarray(photograph[:, ::-1])
    pose_px = person.landmarks_px * [-1, 1] + [photograph.shape[1], 0]
    hands = detector.detect_hands(mirrored, pose_px.astype(np.float32), person.visibility, person.landmarks_world_m)
    assert 0.0 < hands.handedness_score[0] < 0.1


def test_a_small_hand_is_not_looked_at(detector, photograph, person):
    small = np.ascontiguousarray(photograph[::4, ::4])
    hands = detector.detect_hands(small, person.landmarks_px / 4, person.visibility, person.landmarks_world_m)
    assert (hands.handedness_score == 0.0).all()


def test_a_hand_that_the_pose_calls_hidden_is_not_looked_at(detector, photograph, person):
    visibility = person.visibility.copy()
    visibility[PoseLandmark.LEFT_WRIST] = 0.2
    hands = detector.detect_hands(photograph, person.landmarks_px, visibility, person.landmarks_world_m)
    assert hands.handedness_score[0] == 0.0


def test_wrist_pinky_and_index_show_where_a_hand_is(detector, monkeypatch):
    """In this order MediaPipe's graph takes them, as shares of the picture's sides."""
    process_inputs = []

    def process(inputs):
        process_inputs.append([(point.x, point.y) for point in inputs["wrist_and_knuckles"].landmark])
        return SimpleNamespace(landmarks=None)

    monkeypatch.setattr(detector, "_graph", SimpleNamespace(process=process))
    pose_px = np.stack([10.0 * np.arange(33), 300.0 - np.arange(33)], axis=1)
    rgb = np.zeros((300, 400, 3), np.uint8)
    detector.detect_hands(rgb, pose_px, np.ones(33), np.random.default_rng(0).normal(size=(33, 3)) * 0.01)
    for side, points in zip(("LEFT", "RIGHT"), process_inputs, strict=True):
        rows = [PoseLandmark[f"{side}_{name}"] for name in ("WRIST", "PINKY", "INDEX")]
        np.testing.assert_allclose(points, pose_px[rows] / (400, 300), atol=1e-6)


def test_hands_are_stacked_and_taken_apart():
    one, other = undetected_hands(), undetected_hands()
    other.handedness_score[1] = 0.75
    both = stack_hands([one, other])
    assert both.landmarks_px.shape == (2, 2, 21, 2)
    np.testing.assert_array_equal(both.rows([1, 0]).handedness_score, [[0, 0.75], [0, 0]])


def test_scale_is_independent_of_place():
    points_m = np.random.default_rng(0).normal(size=(5, 9, 3))
    points_px = 250.0 * points_m[..., :2] + np.arange(5)[:, None, None]
    np.testing.assert_allclose(image_scale_px_per_m(points_px, points_m), np.full(5, 250.0))
