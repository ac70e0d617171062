"""The two walks through a recording, without the detector: masks and landmarks lie beside the images."""

import numpy as np
import pytest

from pipeline.capture import detection as sightings
from pipeline.capture.capture import image_path, mask_path
from pipeline.capture.detection import detect_in_frames
from pipeline.capture.face_detector import undetected_face
from pipeline.capture.frame_writing import _temporal_windows, write_frames
from pipeline.capture.hand_detector import undetected_hands
from pipeline.capture.person_detector import PersonDetection
from pipeline.capture.user_files import load_user_files
from pipeline.capture.video import Frame, open_frame_source
from pipeline.capture.worker_pool import start_worker_pool
from pipeline.core.errors import UserError
from pipeline.io.image import read_gray, read_rgb, write_gray, write_rgb, write_rgba
from pipeline.io.npz import load_npz, save_npz


@pytest.fixture
def folder(tmp_path):
    """Twelve images of a bar that walks to the right; frame 5 is empty and its landmarks are unknown."""
    (tmp_path / "in" / "masks").mkdir(parents=True)
    landmarks = np.zeros((12, 33, 2))
    for k in range(12):
        mask = np.zeros((40, 60), np.uint8)
        if k != 5:
            mask[5:35, 4 * k : 4 * k + 10] = 255
        write_rgb(
            tmp_path / "in" / f"{k}.png", np.where(mask[..., None] > 0, np.uint8(200), np.uint8(k + 10)).repeat(3, 2)
        )
        write_gray(tmp_path / "in" / "masks" / f"{k}.png", mask)
        landmarks[k] = np.nan if k == 5 else (4 * k + 5, 20)
    world = np.where(np.isnan(landmarks[..., :1]), np.nan, np.ones(3))
    save_npz(tmp_path / "in" / "landmarks.npz", {"landmarks_px": landmarks, "landmarks_world_m": world})
    return tmp_path


class FakeDetector:
    """In the place of both detectors: the same finding in every frame but those that show nobody."""

    landmarks_px = np.full((33, 2), 7.0, np.float32)
    landmarks_world_m = np.arange(99, dtype=np.float32).reshape(33, 3)

    def detect(self, rgb):
        if rgb.max() < 100:
            return None
        mask = np.where(rgb[..., 0] > 100, np.uint8(255), np.uint8(0))
        return PersonDetection(self.landmarks_px, np.full(33, 0.5, np.float32), self.landmarks_world_m, mask)

    def track(self, images):
        return [self.detect(rgb) for rgb in images]

    def count_people(self, rgb):
        return 1

    def detect_hands(self, rgb, *pose):
        return undetected_hands()

    def detect_face_of_person(self, rgb, *pose):
        return undetected_face()


class FakeDetectors(sightings._Detectors):
    person = hand = face = FakeDetector()


@pytest.fixture
def detector(monkeypatch):
    monkeypatch.setattr(sightings, "_Detectors", FakeDetectors)
    return FakeDetector


def change_landmarks(folder, **changes):
    """Rewrite `landmarks.npz`: arrays that are replaced, or left out when None."""
    path = folder / "in" / "landmarks.npz"
    save_npz(path, {name: array for name, array in (load_npz(path) | changes).items() if array is not None})


def detect_recording(folder, stride=1, max_side_px=60):
    source = open_frame_source(folder / "in")
    user_files = load_user_files(folder / "in", source)
    with start_worker_pool(1) as workers:
        frame_indices = range(0, source.n_frames, stride)
        return source, user_files, detect_in_frames(source, user_files, frame_indices, 2, max_side_px, workers)


def test_all_frames_are_seen_and_an_empty_one_is_not_found(folder):
    _, _, seen = detect_recording(folder)
    np.testing.assert_array_equal(seen.frame_index, np.arange(12))
    np.testing.assert_array_equal(np.flatnonzero(~seen.found), [5])
    np.testing.assert_array_equal(seen.landmarks_px[3, 0], [17, 20])
    assert seen.person_masks[3].sum() == 300
    assert (seen.n_people == -1).all()
    assert (seen.width, seen.height, seen.scale) == (60, 40, 1.0)


def test_one_landmark_that_is_unknown_drops_no_frame(folder):
    points = load_npz(folder / "in" / "landmarks.npz")["landmarks_px"]
    points[8, 13] = np.nan
    change_landmarks(folder, landmarks_px=points)
    _, _, seen = detect_recording(folder)
    np.testing.assert_array_equal(np.flatnonzero(~seen.found), [5])
    assert np.argwhere(np.isnan(seen.landmarks_px[8]).any(axis=1)).tolist() == [[13]]
    np.testing.assert_array_equal(seen.landmarks_visibility[8], np.where(np.arange(33) == 13, np.nan, 1.0))


def test_a_supplied_mask_shows_a_person_whom_the_detector_misses(folder, detector):
    """Frame 3 is black, so that nothing is detected there, but its mask lies beside it."""
    (folder / "in" / "landmarks.npz").unlink()
    write_rgb(folder / "in" / "3.png", np.zeros((40, 60, 3), np.uint8))
    _, _, seen = detect_recording(folder)
    np.testing.assert_array_equal(np.flatnonzero(~seen.found), [5])
    np.testing.assert_array_equal(np.flatnonzero(np.isnan(seen.landmarks_px).all(axis=(1, 2))), [3, 5])
    assert seen.person_masks[3].sum() == 300


def test_specks_of_a_mask_show_nobody(folder):
    speck = np.zeros((40, 60), np.uint8)
    speck[3:5, 7:9] = 255
    write_gray(folder / "in" / "masks" / "5.png", speck)
    _, _, seen = detect_recording(folder)
    np.testing.assert_array_equal(np.flatnonzero(~seen.found), [5])


def test_landmarks_without_depth_get_it_from_the_detector(folder, detector):
    change_landmarks(folder, landmarks_world_m=None)
    _, _, seen = detect_recording(folder)
    np.testing.assert_array_equal(seen.landmarks_px[3, 0], [17, 20])
    assert (seen.landmarks_visibility[3] == 1).all()
    np.testing.assert_array_equal(seen.landmarks_world_m[3], detector.landmarks_world_m)
    assert np.isnan(seen.landmarks_world_m[5]).all()


def test_landmarks_with_depth_need_no_detector(folder, monkeypatch):
    for name in ("person", "hand", "face"):
        monkeypatch.setattr(FakeDetectors, name, None)
    monkeypatch.setattr(sightings, "_Detectors", FakeDetectors)
    _, _, seen = detect_recording(folder)
    assert (seen.landmarks_world_m[3] == 1).all()


def test_a_stride_keeps_indices_and_a_smaller_size_scales_landmarks(folder):
    _, _, seen = detect_recording(folder, stride=3, max_side_px=30)
    np.testing.assert_array_equal(seen.frame_index, [0, 3, 6, 9])
    np.testing.assert_allclose(seen.time_s, np.array([0, 3, 6, 9]) / 30)
    np.testing.assert_allclose(seen.landmarks_px[1, 0], [8.5, 10])
    assert (seen.width, seen.height, seen.scale) == (30, 20, 0.5)


def test_selected_frames_are_written_with_supplied_masks(folder):
    source, user_files, seen = detect_recording(folder)
    out = folder / "out"
    out.mkdir()
    with start_worker_pool(1) as workers:
        write_frames(source, user_files, seen, [0, 4, 11], out, 60, 1.0, workers)
    assert sorted(path.name for path in (out / "images").iterdir()) == ["000000.png", "000004.png", "000011.png"]
    for k in (0, 4, 11):
        np.testing.assert_array_equal(read_rgb(image_path(out, k)), read_rgb(folder / "in" / f"{k}.png"))
        np.testing.assert_array_equal(read_gray(mask_path(out, k)), read_gray(folder / "in" / "masks" / f"{k}.png"))


def test_where_a_mask_is_soft_the_picture_holds_the_persons_colour(folder):
    mask = read_gray(folder / "in" / "masks" / "4.png")
    mask[4, 16:26], mask[35, 16:26] = 128, 64
    image = np.where(mask[..., None] == 128, np.uint8(107), read_rgb(folder / "in" / "4.png"))
    write_rgb(folder / "in" / "4.png", np.where(mask[..., None] == 64, np.uint8(60), image))
    write_gray(folder / "in" / "masks" / "4.png", mask)
    source, user_files, seen = detect_recording(folder)
    out = folder / "out"
    out.mkdir()
    with start_worker_pool(1) as workers:
        write_frames(source, user_files, seen, [4], out, 60, 1.0, workers)
    written = read_rgb(image_path(out, 4))
    np.testing.assert_allclose(written[4:36, 16:26], 200, atol=1)
    np.testing.assert_array_equal(written[[3, 36], 16:26], 14)
    np.testing.assert_array_equal(read_gray(mask_path(out, 4)), mask)


def test_images_with_straight_alpha_keep_their_colours(tmp_path, detector):
    """A grey bar with a soft rim before transparent black; a soft pixel is as grey as the others."""
    (tmp_path / "in").mkdir()
    alpha = np.zeros((40, 60), np.uint8)
    alpha[4:36, 16:26] = 128
    alpha[6:34, 18:24] = 255
    rgb = np.where(alpha[..., None] > 0, np.uint8(100), np.uint8(0)).repeat(3, 2)
    for k in range(3):
        write_rgba(tmp_path / "in" / f"{k}.png", np.dstack([rgb, alpha]))
    source, user_files, seen = detect_recording(tmp_path)
    (tmp_path / "out").mkdir()
    with start_worker_pool(1) as workers:
        write_frames(source, user_files, seen, [1], tmp_path / "out", 60, 1.0, workers)
    np.testing.assert_array_equal(read_rgb(image_path(tmp_path / "out", 1)), rgb)
    np.testing.assert_array_equal(read_gray(mask_path(tmp_path / "out", 1)), alpha)


def test_a_mask_of_another_shape_is_named(folder):
    write_gray(folder / "in" / "masks" / "7.png", np.zeros((60, 40), np.uint8))
    with pytest.raises(UserError, match="mask of frame 7"):
        detect_recording(folder)


def test_windows_hold_each_wanted_frame_with_its_neighbours(folder):
    _, _, seen = detect_recording(folder)
    frames = [Frame(k, k / 30, np.zeros((1, 1, 3), np.uint8), 1.0) for k in range(12)]
    windows = [
        (position, [frame.index for frame in near])
        for position, near in _temporal_windows(frames, seen, {0, 4, 6, 7, 11})
    ]
    assert windows == [(0, [0, 1]), (4, [3, 4]), (6, [6, 7]), (7, [6, 7, 8]), (11, [10, 11])]
