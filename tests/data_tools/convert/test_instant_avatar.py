"""InstantAvatar folders: round trips, splits, and the real pose files."""

import shutil

import numpy as np
import pytest

from data_tools.convert.instant_avatar import is_instant_avatar, read_instant_avatar
from data_tools.convert.protocol import _SPLITS
from data_tools.convert.recording import write_recording
from pipeline.capture.smpl_poses import load_smpl_poses
from pipeline.capture.user_files import load_user_files
from pipeline.capture.video import open_frame_source
from pipeline.core.errors import UserError
from pipeline.core.progress import take_warnings
from pipeline.io.image import read_rgb, write_gray
from tests.data_tools.convert import sample_data

SUBJECT = "male-3-casual"
TRAIN, HELDOUT = list(range(0, 456, 4)), list(range(456, 676, 4))


@pytest.fixture
def folder(tmp_path):
    """An unknown subject of six frames."""
    sample_data.instant_avatar(tmp_path / "somebody")
    return tmp_path / "somebody"


@pytest.fixture(scope="module")
def subject(tmp_path_factory):
    """A known subject of 673 frames, the minimum for its split, without poses of the splits."""
    folder = tmp_path_factory.mktemp("known") / SUBJECT
    sample_data.instant_avatar(folder, HELDOUT[-1] + 1)
    return folder


def test_round_trip(folder, tmp_path):
    assert is_instant_avatar(folder)
    write_recording(read_instant_avatar(folder), tmp_path / "out")
    source = open_frame_source(tmp_path / "out")
    user_files = load_user_files(tmp_path / "out", source)
    for k, (picture, mask) in enumerate(zip(sample_data.pictures(6), sample_data.masks(6), strict=True)):
        np.testing.assert_array_equal(read_rgb(source.files[k]), picture)
        np.testing.assert_array_equal(user_files.read_mask(k), 255 * mask)
    assert (user_files.camera.fx, user_files.camera.fy, user_files.camera.cx, user_files.camera.cy) == (30, 31, 8, 6)
    assert user_files.camera.distortion == ()
    assert user_files.split is None
    poses = load_smpl_poses(tmp_path / "out" / "smpl_poses.npz")
    pose = sample_data.numbers("pose", 6)
    np.testing.assert_array_equal(np.concatenate([poses.global_orient, poses.body_pose], axis=1), pose)
    np.testing.assert_array_equal(poses.transl, sample_data.numbers("transl", 6))
    assert poses.gender == "unknown"
    assert (poses.smpl_to_camera[:, 2, 3] == 1).all()


def test_known_subject_has_its_split_and_poses(subject, tmp_path):
    train, test = sample_data.poses_of_set(len(TRAIN), 5), sample_data.poses_of_set(len(HELDOUT), 6)
    shutil.copytree(subject, tmp_path / SUBJECT)
    np.savez(tmp_path / SUBJECT / "poses" / "anim_nerf_train.npz", **train)
    np.savez(tmp_path / SUBJECT / "poses" / "anim_nerf_test.npz", **test)
    write_recording(read_instant_avatar(tmp_path / SUBJECT), tmp_path / "out")
    split = load_user_files(tmp_path / "out", open_frame_source(tmp_path / "out")).split
    np.testing.assert_array_equal(split.frame_index, TRAIN + HELDOUT)
    np.testing.assert_array_equal(split.frame_index[split.split == 2], HELDOUT)
    np.testing.assert_array_equal(split.frame_index[split.split == 1], TRAIN[4::8])
    poses = load_smpl_poses(tmp_path / "out" / "smpl_poses.npz")
    np.testing.assert_array_equal(poses.frame_index, TRAIN + HELDOUT)
    for name in ("global_orient", "body_pose", "transl"):
        np.testing.assert_array_equal(getattr(poses, name), np.concatenate([train[name], test[name]]))
    np.testing.assert_array_equal(poses.betas[[0, -1]], np.concatenate([train["betas"], test["betas"]]))
    assert poses.gender == "male"
    assert take_warnings() == []


def test_real_pose_files_match_the_split(subject, shared_data, tmp_path):
    """The lengths of the splits match the numbers of poses in InstantAvatar's files."""
    shutil.copytree(subject, tmp_path / SUBJECT)
    stored = {}
    for name in ("train", "test"):
        path = shared_data / "formats" / f"{SUBJECT}_{name}.npz"
        shutil.copyfile(path, tmp_path / SUBJECT / "poses" / f"anim_nerf_{name}.npz")
        stored[name] = np.load(path)
    assert [len(stored[name]["transl"]) for name in stored] == [len(TRAIN), len(HELDOUT)]
    poses = read_instant_avatar(tmp_path / SUBJECT).poses
    np.testing.assert_array_equal(poses.transl[0], stored["train"]["transl"][0])
    np.testing.assert_array_equal(poses.body_pose[-1], stored["test"]["body_pose"][-1])
    assert (poses.transl[:, 2] > 5).all()


@pytest.mark.parametrize("name", sorted(_SPLITS))
def test_splits_are_disjoint(name):
    train, heldout = _SPLITS[name]
    assert not set(train) & set(heldout)


def test_short_video_of_a_known_subject_has_no_split(tmp_path):
    sample_data.instant_avatar(tmp_path / SUBJECT)
    np.savez(tmp_path / SUBJECT / "poses" / "anim_nerf_train.npz", **sample_data.poses_of_set(3, 5))
    recording = read_instant_avatar(tmp_path / SUBJECT)
    assert recording.split is None
    assert len(recording.poses.frame_index) == 6
    warnings = take_warnings()
    assert "needs 673" in warnings[0]
    assert "these poses are ignored" in warnings[1]


def test_image_masks_without_poses(folder):
    for k, mask in enumerate(sample_data.masks(6)):
        (folder / "masks" / f"mask_{k:04d}.npy").unlink()
        write_gray(folder / "masks" / f"{k}.png", 200 * mask)
    (folder / "poses.npz").unlink()
    recording = read_instant_avatar(folder)
    np.testing.assert_array_equal(recording.read_mask(3), 255 * sample_data.masks(6)[3])
    assert recording.poses is None


def test_inconsistent_files_are_errors(folder):
    np.savez(folder / "poses.npz", thetas=np.zeros((6, 69)), transl=np.zeros((6, 3)), betas=np.zeros(10))
    with pytest.raises(UserError, match=r"poses.npz: the pose must have 6 rows of 72 numbers, found \(6, 69\)"):
        read_instant_avatar(folder)
    np.savez(folder / "poses.npz", thetas=np.zeros((6, 72)), betas=np.zeros(10))
    with pytest.raises(UserError, match="the translation must have 6 rows of 3 numbers, found None"):
        read_instant_avatar(folder)
    (folder / "masks" / "mask_0003.npy").unlink()
    with pytest.raises(UserError, match="masks has 5 entries for 6 frames"):
        read_instant_avatar(folder)
    np.savez(folder / "cameras.npz", intrinsic=np.eye(3), extrinsic=np.eye(4), height=540, width=540)
    with pytest.raises(UserError, match="for images of 540x540, but those of .* are 16x12"):
        read_instant_avatar(folder)
    np.savez(folder / "cameras.npz", intrinsic=np.eye(4))
    with pytest.raises(UserError, match="`intrinsic` must have shape"):
        read_instant_avatar(folder)


def test_colour_mask_is_an_error(folder):
    np.save(folder / "masks" / "mask_0002.npy", np.zeros((4, 4, 3)))
    with pytest.raises(UserError, match=r"mask_0002.npy: a mask has shape \(4, 4, 3\)"):
        read_instant_avatar(folder).read_mask(2)
