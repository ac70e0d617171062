"""The detector on real pictures (one person, two, none), and the rules about legs and crops on numbers."""

from types import SimpleNamespace

import numpy as np
import pytest

from pipeline.capture import landmarks
from pipeline.capture import person_detector as person
from pipeline.capture.video import open_frame_source, read_frames


@pytest.fixture(scope="module")
def detector() -> person.PersonDetector:
    return person.PersonDetector()


@pytest.fixture(scope="module")
def photograph(shared_data) -> np.ndarray:
    source = open_frame_source(shared_data / "real" / "dakse" / "video.mp4")
    return next(read_frames(source, lambda index: index == 0, 2000)).rgb


def test_nobody_in_an_empty_picture(detector):
    assert detector.detect(np.full((120, 160, 3), 128, np.uint8)) is None
    assert detector.count_people(np.full((120, 160, 3), 128, np.uint8)) == 0


def test_a_person_is_found_where_he_stands(detector, photograph):
    found = detector.detect(photograph)
    names = {landmark.name.lower(): found.landmarks_px[landmark] for landmark in landmarks.PoseLandmark}
    assert found.mask.shape == photograph.shape[:2]
    assert 0.12 < (found.mask > 127).mean() < 0.16
    assert names["nose"][1] < names["left_hip"][1] < names["left_ankle"][1] < 630
    assert names["right_wrist"][0] < names["right_shoulder"][0] < names["left_shoulder"][0] < names["left_wrist"][0]
    assert found.visibility.min() > 0.5
    nose_m, ankle_m = found.landmarks_world_m[[landmarks.PoseLandmark.NOSE, landmarks.PoseLandmark.LEFT_ANKLE]]
    assert 1.0 < ankle_m[1] - nose_m[1] < 2.0


def test_people_are_counted(detector, photograph):
    assert detector.count_people(photograph) == 1
    cut = photograph[:, 120:540]
    assert detector.count_people(np.concatenate([cut, cut], axis=1)) == 2


def test_legs_are_seen_when_one_ankle_is():
    landmarks = np.full((4, 33, 2), 50.0, np.float32)
    visibility = np.ones((4, 33), np.float32)
    landmarks[1, 27, 1] = 130
    landmarks[2, [27, 28], 1] = 130
    visibility[3, [27, 28]] = 0.02
    np.testing.assert_array_equal(person.is_ankle_visible(landmarks, visibility, 100), [True, True, False, False])


@pytest.mark.parametrize(("height", "width"), [(100, 100), (90, 160), (160, 90)])
def test_crops_cover_the_image_and_stay_inside(height, width):
    crops = list(person._crops(height, width))
    assert crops[0] == (0, 0, width, height)
    assert len(set(crops)) == len(crops)
    covered = np.zeros((height, width), int)
    for left, top, right, bottom in crops[1:]:
        assert 0 <= left < right <= width
        assert 0 <= top < bottom <= height
        covered[top:bottom, left:right] += 1
    assert covered.min() >= 1


def square(centre_x_px, centre_y_px, side_px, width_px=200, height_px=100, rotation=0.0):
    """MediaPipe's description of a square."""
    from mediapipe.framework.formats.rect_pb2 import NormalizedRect

    return NormalizedRect(
        x_center=centre_x_px / width_px,
        y_center=centre_y_px / height_px,
        width=side_px / width_px,
        height=side_px / height_px,
        rotation=rotation,
    )


@pytest.mark.parametrize(("right", "over"), [(69, False), (71, True)])
def test_a_person_runs_over_the_square_when_it_touches_the_border(right, over):
    mask = np.zeros((100, 200), bool)
    mask[45:55, 55:right] = True
    assert person.touches_roi_border(mask, square(60, 50, 20)) == over


def test_a_turned_square_has_turned_borders():
    mask = np.zeros((100, 200), bool)
    mask[48:52, 73:75] = True
    assert not person.touches_roi_border(mask, square(60, 50, 20))
    assert person.touches_roi_border(mask, square(60, 50, 20, rotation=np.pi / 4))


def test_a_border_outside_of_the_image_is_not_touched():
    assert not person.touches_roi_border(np.ones((100, 200), bool), square(100, 50, 300))


def estimate(square, next_square, mask):
    """A look at a square; what it says about landmarks does not matter."""
    return person._RoiEstimate(np.zeros((33, 3), np.float32), np.zeros((33, 3), np.float32), mask, square, next_square)


@pytest.mark.parametrize(("next_side", "too_small"), [(21, False), (23, True)])
def test_roi_is_too_small_when_next_roi_is_much_larger(next_side, too_small):
    mask = np.zeros((100, 200), np.float32)
    mask[45:55, 55:65] = 1.0
    assert person.is_roi_too_small(estimate(square(60, 50, 20), square(60, 50, next_side), mask)) == too_small


def test_a_square_is_too_small_when_the_person_runs_over_it():
    assert person.is_roi_too_small(estimate(square(60, 50, 20), square(60, 50, 20), np.ones((100, 200), np.float32)))


def with_first_guess(guess):
    """A detector whose first model says what it is told."""
    detector = person.PersonDetector()
    detector._roi_graph = SimpleNamespace(process=lambda _: SimpleNamespace(square=guess))
    return detector


def test_a_square_that_cuts_off_the_feet_is_left_for_a_larger_one(photograph):
    """The first model's guess is replaced by one that ends above the ankles."""
    whole = person.PersonDetector().detect(photograph).mask
    detector = with_first_guess(square(315, 270, 430, *photograph.shape[1::-1]))
    cut = detector._estimate_in_roi(photograph, detector._roi_graph.process(photograph).square)
    corrected = detector.detect(photograph).mask
    lowest_px = [np.flatnonzero(mask.any(axis=1))[-1] for mask in (cut.mask > 0.5, corrected > 127, whole > 127)]
    assert lowest_px[0] < lowest_px[2] - 60
    assert abs(lowest_px[1] - lowest_px[2]) < 15


def test_a_square_in_which_legs_look_complete_is_enlarged_first(photograph):
    """In the guess itself, and in the next three squares, the second model sees a person without feet."""
    whole = person.PersonDetector().detect(photograph).mask
    found = with_first_guess(square(315, 200, 390, *photograph.shape[1::-1])).detect(photograph).mask
    lowest_px = [np.flatnonzero(mask.any(axis=1))[-1] for mask in (found > 127, whole > 127)]
    assert abs(lowest_px[0] - lowest_px[1]) < 15


def test_two_looks_are_averaged(photograph):
    detector = with_first_guess(square(315, 315, 512, *photograph.shape[1::-1]))
    first = detector._estimate_in_roi(photograph, square(315, 315, 640, *photograph.shape[1::-1]))
    second = detector._estimate_in_roi(photograph, first.next_square)
    found = detector.detect(photograph)
    assert np.abs(first.landmarks - second.landmarks).max() > 1.0
    np.testing.assert_allclose(found.landmarks_px, 0.5 * (first.landmarks + second.landmarks)[:, :2], atol=1e-3)
    np.testing.assert_allclose(found.mask, 127.5 * (first.mask + second.mask), atol=0.51)


def test_detection_is_independent_of_previous_frames(detector, photograph):
    """MediaPipe's whole graph smooths its squares in time, even when it is told not to."""
    shrunk = np.full_like(photograph, 128)
    shrunk[100:415, 20:335] = photograph[::2, ::2]
    for _ in range(3):
        detector.detect(shrunk)
    after_others, fresh = detector.detect(photograph), person.PersonDetector().detect(photograph)
    np.testing.assert_array_equal(after_others.mask, fresh.mask)
    np.testing.assert_array_equal(after_others.landmarks_px, fresh.landmarks_px)
