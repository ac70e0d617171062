"""Image folders: mask folders with other names, and masks in the alpha channel."""

import json

import numpy as np
import pytest

from data_tools.convert.image_folder import is_image_folder, read_image_folder
from data_tools.convert.recording import write_recording
from pipeline.capture.smpl_poses import save_smpl_poses
from pipeline.capture.user_files import load_user_files
from pipeline.capture.video import open_frame_source
from pipeline.core.errors import UserError
from pipeline.io.image import read_rgb, write_rgba
from pipeline.io.npz import save_npz
from tests.capture.test_smpl_poses import make_poses
from tests.data_tools.convert import sample_data


def check(target):
    source = open_frame_source(target)
    user_files = load_user_files(target, source)
    for k, (picture, mask) in enumerate(zip(sample_data.pictures(6), sample_data.masks(6), strict=True)):
        np.testing.assert_array_equal(read_rgb(source.files[k]), picture)
        np.testing.assert_array_equal(user_files.read_mask(k), 255 * mask)
    return user_files


@pytest.mark.parametrize("name", ["masks", "matte"])
def test_mask_folder_names(tmp_path, name):
    sample_data.write_image_folder(tmp_path / "in", name)
    assert is_image_folder(tmp_path / "in")
    (tmp_path / "in" / "camera.json").write_text(json.dumps({"fx": 9, "fy": 9, "cx": 8, "cy": 6}))
    write_recording(read_image_folder(tmp_path / "in"), tmp_path / "out")
    assert check(tmp_path / "out").camera.fx == 9


def test_all_files_in_the_format_of_the_target_are_copied(tmp_path):
    """All that a run reads from the folder, besides images and masks."""
    sample_data.write_image_folder(tmp_path / "in", "matte")
    (tmp_path / "in" / "camera.json").write_text(json.dumps({"fx": 9, "fy": 9, "cx": 8, "cy": 6}))
    (tmp_path / "in" / "split.json").write_text(json.dumps({"train": [0, 1, 2, 3, 4], "heldout": [5]}))
    save_npz(tmp_path / "in" / "landmarks.npz", {"landmarks_px": np.ones((6, 33, 2))})
    save_smpl_poses(tmp_path / "in" / "smpl_poses.npz", make_poses(2))
    write_recording(read_image_folder(tmp_path / "in"), tmp_path / "out")
    files = check(tmp_path / "out")
    assert all(found is not None for found in (files.camera, files.split, files.landmarks, files.smpl_poses))


def test_masks_in_the_alpha_channel(tmp_path):
    (tmp_path / "in").mkdir()
    for k, (picture, mask) in enumerate(zip(sample_data.pictures(6), sample_data.masks(6), strict=True)):
        write_rgba(tmp_path / "in" / f"{k}.png", np.concatenate([picture, 255 * mask[..., None]], axis=2))
    assert is_image_folder(tmp_path / "in")
    write_recording(read_image_folder(tmp_path / "in"), tmp_path / "out")
    check(tmp_path / "out")


def test_images_without_masks_need_no_conversion(tmp_path):
    sample_data.write_image_folder(tmp_path / "in", "other")
    assert not is_image_folder(tmp_path / "in")
    with pytest.raises(UserError, match="no mask folder and no alpha channel"):
        read_image_folder(tmp_path / "in")
