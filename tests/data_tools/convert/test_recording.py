"""Masks of a recording: matched by image name, else in order; equal to those that the frames stage reads."""

from pathlib import Path

import numpy as np
import pytest

from data_tools.convert.recording import mask_folder_reader
from data_tools.synthetic.scene.movie import write_video
from pipeline.capture.user_files import load_user_files
from pipeline.capture.video import FrameSource, open_frame_source
from pipeline.core.errors import UserError
from pipeline.io.image import write_gray, write_rgba
from tests.data_tools.convert import sample_data


@pytest.fixture
def source(tmp_path: Path) -> FrameSource:
    """Six images with an empty folder of masks."""
    sample_data.write_image_folder(tmp_path, "masks")
    for path in (tmp_path / "masks").iterdir():
        path.unlink()
    return open_frame_source(tmp_path)


def test_masks_of_a_video_are_in_order(tmp_path: Path) -> None:
    """Frames of a video have no names."""
    write_video(tmp_path / "walk.mp4", sample_data.pictures(6), 25.0)
    (tmp_path / "masks").mkdir()
    for k, mask in enumerate(sample_data.masks(6)):
        write_gray(tmp_path / "masks" / f"{k}.png", 255 * mask)
        (tmp_path / "masks" / f"._{k}.png").touch()  # metadata of macOS
    source = open_frame_source(tmp_path / "walk.mp4")
    read = mask_folder_reader(tmp_path / "masks", source)
    for k, mask in enumerate(sample_data.masks(6)):
        np.testing.assert_array_equal(read(k), 255 * mask)
    (tmp_path / "masks" / "5.png").unlink()
    with pytest.raises(UserError, match="5 entries for 6 frames"):
        mask_folder_reader(tmp_path / "masks", source)


def require_masks_of_the_frames_stage(folder: Path, source: FrameSource) -> list[np.ndarray]:
    read, expected = mask_folder_reader(folder / "masks", source), load_user_files(folder, source).read_mask
    assert expected is not None
    found = [read(k) for k in range(source.n_frames)]
    for k, mask in enumerate(found):
        np.testing.assert_array_equal(mask, expected(k))
    return found


def test_cut_outs_are_read_by_their_alpha(tmp_path: Path, source: FrameSource) -> None:
    """A white shirt and dark trousers before transparent black."""
    for k, mask in enumerate(sample_data.masks(6)):
        colours = mask * np.where(np.arange(sample_data.HEIGHT) < 6, 230, 40).astype(np.uint8)[:, None]
        write_rgba(tmp_path / "masks" / f"{k:05d}.png", np.dstack([colours] * 3 + [255 * mask]))
    found = require_masks_of_the_frames_stage(tmp_path, source)
    np.testing.assert_array_equal(found, 255 * sample_data.masks(6))


@pytest.mark.parametrize("highest", [1, 200, 65535])
def test_labels_of_16_bits_are_brought_to_255(tmp_path: Path, source: FrameSource, highest: int) -> None:
    for k, mask in enumerate(sample_data.masks(6)):
        write_gray(tmp_path / "masks" / f"{k:05d}.png", mask.astype(np.uint16) * np.uint16(highest))
    found = require_masks_of_the_frames_stage(tmp_path, source)
    np.testing.assert_array_equal(found, 255 * sample_data.masks(6))


@pytest.mark.parametrize("is_array", [False, True])
def test_one_scale_holds_for_all_masks(tmp_path: Path, source: FrameSource, is_array: bool) -> None:
    """Noise of one level is not the person where the person has left the picture."""
    masks = 255 * sample_data.masks(6)
    masks[4], masks[4, ::3, ::2] = 0, 1
    for k, mask in enumerate(masks):
        if is_array:
            np.save(tmp_path / "masks" / f"{k:05d}.npy", mask)
        else:
            write_gray(tmp_path / "masks" / f"{k:05d}.png", mask)
    read = mask_folder_reader(tmp_path / "masks", source)
    np.testing.assert_array_equal([read(k) for k in range(6)], masks)


@pytest.mark.parametrize("dtype", [bool, np.uint8, np.float32])
def test_arrays_of_zeros_and_ones_are_brought_to_255(tmp_path: Path, source: FrameSource, dtype: type) -> None:
    """Floats overshoot where they were resized."""
    for k, mask in enumerate(sample_data.masks(6)):
        array = mask.astype(dtype)
        np.save(
            tmp_path / "masks" / f"{k:05d}.npy",
            array - np.float32(0.01) * (mask == 0) if dtype == np.float32 else array,
        )
    read = mask_folder_reader(tmp_path / "masks", source)
    np.testing.assert_array_equal([read(k) for k in range(6)], 255 * sample_data.masks(6))


@pytest.mark.parametrize("suffix", ["png", "npy"])
def test_masks_for_some_of_the_images_are_refused(tmp_path: Path, source: FrameSource, suffix: str) -> None:
    """As many as there are images: in natural order those after the missing one would be of other frames."""
    for k, mask in zip((0, 1, 3, 4, 5, 6), sample_data.masks(6), strict=True):
        path = tmp_path / "masks" / f"{k:05d}.{suffix}"
        write_gray(path, 255 * mask) if suffix == "png" else np.save(path, mask)
    with pytest.raises(UserError, match="masks with the names of images, but none for 00002"):
        mask_folder_reader(tmp_path / "masks", source)


def test_masks_with_a_dark_person(tmp_path: Path, source: FrameSource) -> None:
    for k, mask in enumerate(sample_data.masks(6)):
        write_gray(tmp_path / "masks" / f"{k:05d}.png", 200 - 200 * mask)
    read = mask_folder_reader(tmp_path / "masks", source, person_is_dark=True)
    np.testing.assert_array_equal([read(k) for k in range(6)], 255 * sample_data.masks(6))
    for k in range(6):
        write_gray(tmp_path / "masks" / f"{k:05d}.png", 255 * np.pad(np.ones((6, 6), np.uint8), 3))
    with pytest.raises(UserError, match="are black in all four corners, masks are black where the person is; invert"):
        mask_folder_reader(tmp_path / "masks", source, person_is_dark=True)
