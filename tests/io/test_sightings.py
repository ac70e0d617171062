"""The two walks through a recording, without the detector: masks and landmarks lie beside the images."""

import numpy as np
import pytest

from pipeline.core.errors import UserError
from pipeline.io.capture import image_path, mask_path
from pipeline.io.image import read_gray, read_rgb, write_gray, write_rgb
from pipeline.io.npz import save_npz
from pipeline.io.sightings import _windows, look_at_all, write_frames
from pipeline.io.supplied import find_supplied
from pipeline.io.video import Frame, open_source
from pipeline.io.workers import start_workers


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
    save_npz(tmp_path / "in" / "landmarks.npz", {"landmarks_px": landmarks})
    return tmp_path


def look(folder, stride=1, max_side_px=60):
    source = open_source(folder / "in")
    supplied = find_supplied(folder / "in", source)
    with start_workers(1) as workers:
        looked_at = range(0, source.n_frames, stride)
        return source, supplied, look_at_all(source, supplied, looked_at, 2, max_side_px, workers)


def test_all_frames_are_seen_and_an_empty_one_is_not_found(folder):
    _, _, seen = look(folder)
    np.testing.assert_array_equal(seen.frame_index, np.arange(12))
    np.testing.assert_array_equal(np.flatnonzero(~seen.found), [5])
    np.testing.assert_array_equal(seen.landmarks_px[3, 0], [17, 20])
    assert seen.persons[3].sum() == 300
    assert (seen.n_people == -1).all()
    assert (seen.width, seen.height, seen.scale) == (60, 40, 1.0)


def test_a_stride_keeps_indices_and_a_smaller_size_scales_landmarks(folder):
    _, _, seen = look(folder, stride=3, max_side_px=30)
    np.testing.assert_array_equal(seen.frame_index, [0, 3, 6, 9])
    np.testing.assert_allclose(seen.time_s, np.array([0, 3, 6, 9]) / 30)
    np.testing.assert_allclose(seen.landmarks_px[1, 0], [8.5, 10])
    assert (seen.width, seen.height, seen.scale) == (30, 20, 0.5)


def test_chosen_frames_are_written_with_their_masks_as_given(folder):
    source, supplied, seen = look(folder)
    out = folder / "out"
    out.mkdir()
    with start_workers(1) as workers:
        write_frames(source, supplied, seen, [0, 4, 11], out, 60, 1.0, workers)
    assert sorted(path.name for path in (out / "images").iterdir()) == ["000000.png", "000004.png", "000011.png"]
    for k in (0, 4, 11):
        np.testing.assert_array_equal(read_rgb(image_path(out, k)), read_rgb(folder / "in" / f"{k}.png"))
        np.testing.assert_array_equal(read_gray(mask_path(out, k)), read_gray(folder / "in" / "masks" / f"{k}.png"))


def test_a_mask_of_another_shape_is_named(folder):
    write_gray(folder / "in" / "masks" / "7.png", np.zeros((60, 40), np.uint8))
    with pytest.raises(UserError, match="mask of frame 7"):
        look(folder)


def test_windows_hold_each_wanted_frame_with_its_neighbours(folder):
    _, _, seen = look(folder)
    frames = [Frame(k, k / 30, np.zeros((1, 1, 3), np.uint8), 1.0) for k in range(12)]
    windows = [
        (position, [frame.index for frame in near]) for position, near in _windows(frames, seen, {0, 4, 6, 7, 11})
    ]
    assert windows == [(0, [0, 1]), (4, [3, 4]), (6, [6, 7]), (7, [6, 7, 8]), (11, [10, 11])]
