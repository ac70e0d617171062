"""PeopleSnapshot folders: round trips, and errors that name inconsistent files."""

import os
import pickle

import cv2
import h5py
import numpy as np
import pytest

from data_tools.convert.people_snapshot import is_people_snapshot, read_people_snapshot
from data_tools.convert.recording import write_recording
from pipeline.capture.smpl_poses import load_smpl_poses
from pipeline.capture.user_files import load_user_files
from pipeline.capture.video import open_frame_source, read_frames
from pipeline.core.errors import UserError
from pipeline.core.progress import take_warnings
from tests.data_tools.convert import sample_data


def test_round_trip(tmp_path):
    folder, target = tmp_path / "female-9-casual", tmp_path / "out"
    camera = sample_data.people_snapshot(folder)
    assert is_people_snapshot(folder)
    write_recording(read_people_snapshot(folder), target)
    source = open_frame_source(target)
    read = np.stack([frame.rgb for frame in read_frames(source, lambda _: True, 999)])
    np.testing.assert_allclose(read.astype(int), sample_data.pictures(6), atol=3)
    user_files = load_user_files(target, source)
    for k, mask in enumerate(sample_data.masks(6)):
        np.testing.assert_array_equal(user_files.read_mask(k), 255 * mask)
    assert (user_files.camera.fx, user_files.camera.fy, user_files.camera.cx, user_files.camera.cy) == (30, 31, 8, 6)
    assert user_files.camera.distortion == tuple(camera["camera_k"])
    assert user_files.camera.world_to_camera is None
    assert user_files.split is None
    assert "no published split for female-9-casual" in take_warnings()[0]
    poses = load_smpl_poses(target / "smpl_poses.npz")
    np.testing.assert_array_equal(poses.frame_index, np.arange(6))
    pose = sample_data.numbers("pose", 6)
    np.testing.assert_array_equal(np.concatenate([poses.global_orient, poses.body_pose], axis=1), pose)
    np.testing.assert_array_equal(poses.transl, sample_data.numbers("trans", 6))
    np.testing.assert_array_equal(poses.betas, sample_data.numbers("betas", 1).repeat(6, axis=0))
    assert poses.gender == "female"
    quarter_turn = np.array([[0, -1, 0, 0.1], [1, 0, 0, 0.2], [0, 0, 1, 3.0], [0, 0, 0, 1]])
    np.testing.assert_allclose(poses.smpl_to_camera, np.tile(quarter_turn, (6, 1, 1)), atol=1e-6)


def test_a_pickle_of_python_2_with_float_scalars(tmp_path):
    sample_data.people_snapshot(tmp_path / "s")
    stored = pickle.loads((tmp_path / "s" / "camera.pkl").read_bytes())
    stored |= {"width": np.float64(sample_data.WIDTH), "height": np.array([sample_data.HEIGHT])}
    (tmp_path / "s" / "camera.pkl").write_bytes(pickle.dumps(stored, protocol=0))
    assert read_people_snapshot(tmp_path / "s").camera.fx == 30


def test_only_the_video_is_required(tmp_path):
    sample_data.people_snapshot(tmp_path / "s")
    for name in ("camera.pkl", "reconstructed_poses.hdf5"):
        (tmp_path / "s" / name).unlink()
    recording = read_people_snapshot(tmp_path / "s")
    assert (recording.camera, recording.poses) == (None, None)
    assert recording.read_mask(2).max() == 255
    (tmp_path / "s" / "masks.hdf5").unlink()
    assert not is_people_snapshot(tmp_path / "s")


def test_code_in_camera_pkl_is_not_executed(tmp_path):
    sample_data.people_snapshot(tmp_path / "s")

    class Malice:
        def __reduce__(self):
            return os.system, (f"touch {tmp_path / 'marker'}",)

    (tmp_path / "s" / "camera.pkl").write_bytes(pickle.dumps({"camera_f": Malice()}, protocol=2))
    with pytest.raises(UserError, match=r"camera\.pkl is refused"):
        read_people_snapshot(tmp_path / "s")
    assert not (tmp_path / "marker").exists()


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"camera_f": np.zeros(3)}, "no `camera_f` of 2 numbers"),
        ({"camera_k": None}, "no `camera_k` of 5 numbers"),
        ({"width": 1080, "height": 1080}, "for images of 1080x1080, but those of .* are 16x12"),
    ],
)
def test_invalid_camera_is_an_error(tmp_path, change, message):
    camera = sample_data.people_snapshot(tmp_path / "s")
    (tmp_path / "s" / "camera.pkl").write_bytes(pickle.dumps(camera | change))
    with pytest.raises(UserError, match=message):
        read_people_snapshot(tmp_path / "s")
    (tmp_path / "s" / "camera.pkl").write_bytes(pickle.dumps([1, 2]))
    with pytest.raises(UserError, match="no `camera_f`"):
        read_people_snapshot(tmp_path / "s")


def test_invalid_masks_and_poses_are_errors(tmp_path):
    sample_data.people_snapshot(tmp_path / "s")
    with h5py.File(tmp_path / "s" / "masks.hdf5", "w") as file:
        file["masks"] = sample_data.masks(5)
    with pytest.raises(UserError, match=r"masks.hdf5: `masks` has shape \(5, 12, 16\) for the 6 frames"):
        read_people_snapshot(tmp_path / "s")
    with h5py.File(tmp_path / "s" / "masks.hdf5", "w") as file:
        file["mask"] = sample_data.masks(6)
    with pytest.raises(UserError, match="data set `masks`"):
        read_people_snapshot(tmp_path / "s")
    (tmp_path / "s" / "masks.hdf5").unlink()
    with h5py.File(tmp_path / "s" / "reconstructed_poses.hdf5", "a") as file:
        del file["trans"]
        file["trans"] = np.zeros((2, 3))
    with pytest.raises(UserError, match=r"the translation must have 6 rows of 3 numbers, found \(2, 3\)"):
        read_people_snapshot(tmp_path / "s")


def test_one_scale_holds_for_all_masks(tmp_path):
    """Noise of one level is not the person where the person has left the picture."""
    sample_data.people_snapshot(tmp_path / "s")
    masks = 255 * sample_data.masks(6)
    masks[4], masks[4, ::3, ::2] = 0, 1
    with h5py.File(tmp_path / "s" / "masks.hdf5", "w") as file:
        file["masks"] = masks
    read = read_people_snapshot(tmp_path / "s").read_mask
    np.testing.assert_array_equal([read(k) for k in range(6)], masks)


def test_poses_of_a_longer_video_are_an_error(tmp_path):
    sample_data.people_snapshot(tmp_path / "s")
    with h5py.File(tmp_path / "s" / "reconstructed_poses.hdf5", "a") as file:
        for name in ("pose", "trans"):
            del file[name]
            file[name] = sample_data.numbers(name, 9)
    with pytest.raises(UserError, match="has 6 frames, but its SMPL poses extend to frame 8"):
        write_recording(read_people_snapshot(tmp_path / "s"), tmp_path / "out")
    assert not (tmp_path / "out").exists()


def test_the_real_folder(shared_data):
    """A re-encoded subject without camera and poses: its masks cover the person."""
    recording = read_people_snapshot(shared_data / "real" / "dakse")
    frame = next(read_frames(recording.source, lambda index: index == 100, 999))
    mask = recording.read_mask(100)
    assert mask.shape == frame.rgb.shape[:2]
    green = frame.rgb[..., 1].astype(int) - frame.rgb[..., ::2].max(axis=-1)
    inside = cv2.erode(mask, np.ones((9, 9), np.uint8)) > 0
    assert (green[inside] < 14).mean() > 0.97
    assert (green[cv2.dilate(mask, np.ones((9, 9), np.uint8)) == 0] >= 14).mean() > 0.97
