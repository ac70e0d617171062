"""The face mesh on a real picture of a whole person, and what is not looked at."""

import numpy as np
import pytest

from pipeline.capture.face_detector import FaceDetector
from pipeline.capture.landmarks import PoseLandmark
from pipeline.capture.person_detector import PersonDetector
from pipeline.capture.video import open_frame_source, read_frames


@pytest.fixture(scope="module")
def detector() -> FaceDetector:
    return FaceDetector()


def person_in_frame(shared_data, index: int):
    source = open_frame_source(shared_data / "real" / "dakse" / "video.mp4")
    rgb = next(read_frames(source, lambda frame: frame == index, 2000)).rgb
    person = PersonDetector().detect(rgb)
    assert person is not None
    return rgb, person


def test_the_face_of_a_whole_person_is_found_where_it_is(shared_data, detector):
    rgb, person = person_in_frame(shared_data, 0)
    face_px = detector.detect_face_of_person(rgb, person.landmarks_px, person.landmarks_world_m)
    left_px, right_px, mouth_px, chin_px = face_px[263], face_px[33], face_px[[61, 291]].mean(axis=0), face_px[152]
    assert left_px[0] > right_px[0] + 10  # the person's left is on the right of the picture
    assert (left_px + right_px)[1] / 2 < mouth_px[1] < chin_px[1]
    assert np.linalg.norm(face_px[4, :2] - person.landmarks_px[PoseLandmark.NOSE]) < 6
    assert face_px[4, 2] < min(left_px[2], right_px[2]) - 3  # the nose is nearest
    shifted = np.roll(rgb, (25, 40), axis=(0, 1))
    moved_px = detector.detect_face_of_person(shifted, person.landmarks_px + [40, 25], person.landmarks_world_m)
    np.testing.assert_allclose(moved_px[:, :2] - face_px[:, :2], [[40, 25]] * 478, atol=0.6)


def test_a_head_from_behind_has_no_face(shared_data, detector):
    rgb, person = person_in_frame(shared_data, 120)
    assert np.isnan(detector.detect_face_of_person(rgb, person.landmarks_px, person.landmarks_world_m)).all()


def test_nothing_is_looked_for_in_a_tiny_window_or_outside_of_the_picture(detector):
    rgb = np.zeros((200, 200, 3), dtype=np.uint8)
    world_m = np.zeros((33, 3))
    world_m[11:, 1] = np.linspace(-0.5, 0.9, 22)
    for size_px, place_px in ((50.0, 100.0), (400.0, 5000.0)):
        pose_px = world_m[:, :2] * size_px + place_px
        assert np.isnan(detector.detect_face_of_person(rgb, pose_px, world_m)).all()
    nowhere = np.full((33, 2), np.nan)
    assert np.isnan(detector.detect_face_of_person(rgb, nowhere, world_m)).all()
