"""NeuMan scenes: cameras and poses against known values, inverted masks, splits by name."""

import numpy as np
import pytest

from data_tools.convert.neuman import is_neuman, read_neuman
from data_tools.convert.recording import write_recording
from pipeline.capture.smpl_poses import load_smpl_poses
from pipeline.capture.user_files import load_user_files
from pipeline.capture.video import open_frame_source
from pipeline.core.errors import UserError
from pipeline.io.image import write_gray
from tests.data_tools.convert import sample_data
from tests.data_tools.convert.joblib_writer import dump_joblib

SCALE = 0.25
PERSON = np.array([0.3, -0.2, 1.5])


def camera_pose(k: int) -> tuple[np.ndarray, np.ndarray]:
    """Rotation and translation, world to camera, of a camera that rotates about +Z by k degrees."""
    angle = np.radians(k)
    rotation = np.array([[np.cos(angle), -np.sin(angle), 0], [np.sin(angle), np.cos(angle), 0], [0, 0, 1]])
    return rotation, np.array([0.01 * k, 0.0, 0.5])


@pytest.fixture
def scene(tmp_path):
    """Six images, the fifth not registered by COLMAP; the unit of the world is four metres."""
    folder = tmp_path / "scene"
    sample_data.write_image_folder(folder, "segmentations")
    for k, mask in enumerate(sample_data.masks(6)):
        write_gray(folder / "segmentations" / f"{k:05d}.png", 255 - 255 * mask)
    (folder / "sparse").mkdir()
    (folder / "sparse" / "cameras.txt").write_text("# Camera list\n1 PINHOLE 16 12 30.5 31.5 8.25 6.5\n")
    lines = ["# Image list with two lines of data per image:"]
    for k in (3, 0, 1, 2, 5):
        half = np.radians(k) / 2
        place = " ".join(map(str, camera_pose(k)[1]))
        lines += [f"{k + 1} {np.cos(half)} 0 0 {np.sin(half)} {place} 1 {k:05d}.png", "1.5 2.5 -1" if k else ""]
    (folder / "sparse" / "images.txt").write_text("\n".join(lines) + "\n")
    rows = {"pose": list(sample_data.numbers("pose", 6)), "betas": sample_data.numbers("betas", 6)}
    dump_joblib({1: rows}, folder / "smpl_output_optimized.pkl")
    alignment = np.concatenate([SCALE * np.eye(3), SCALE * PERSON[None]])
    np.save(folder / "alignments.npy", {f"{k:05d}.png": alignment for k in range(6)}, allow_pickle=True)
    return folder


def test_round_trip(scene, tmp_path):
    assert is_neuman(scene)
    write_recording(read_neuman(scene), tmp_path / "out")
    source = open_frame_source(tmp_path / "out")
    user_files = load_user_files(tmp_path / "out", source)
    assert source.n_frames == 6
    for k, mask in enumerate(sample_data.masks(6)):
        np.testing.assert_array_equal(user_files.read_mask(k), 255 * mask)
    camera = user_files.camera
    assert (camera.fx, camera.fy, camera.cx, camera.cy, camera.distortion) == (30.5, 31.5, 8.25, 6.5, ())
    poses = load_smpl_poses(tmp_path / "out" / "smpl_poses.npz")
    registered = [0, 1, 2, 3, 5]
    np.testing.assert_array_equal(poses.frame_index, registered)
    pose = sample_data.numbers("pose", 6)[registered]
    np.testing.assert_array_equal(np.concatenate([poses.global_orient, poses.body_pose], axis=1), pose)
    np.testing.assert_array_equal(poses.betas, sample_data.numbers("betas", 6)[registered])
    assert poses.gender == "neutral"
    assert (poses.transl == 0).all()


def test_smpl_to_camera_is_in_metres(scene):
    """A point of SMPL's output, mapped step by step through the alignment and the camera pose to metres."""
    poses = read_neuman(scene).poses
    point_m = np.array([0.1, 0.9, -0.05])
    for row, k in enumerate(poses.frame_index):
        rotation, translation = camera_pose(k)
        in_world = SCALE * (point_m + PERSON)
        in_camera = (rotation @ in_world + translation) / SCALE
        found = poses.smpl_to_camera[row] @ np.append(point_m, 1.0)
        np.testing.assert_allclose(found[:3], in_camera, atol=1e-5)


def test_romp_poses_are_the_fallback(scene):
    (scene / "smpl_output_optimized.pkl").unlink()
    dump_joblib(
        {1: {"pose": 2 * sample_data.numbers("pose", 6), "betas": np.zeros((6, 10))}}, scene / "smpl_output_romp.pkl"
    )
    poses = read_neuman(scene).poses
    np.testing.assert_array_equal(poses.global_orient[1], 2 * sample_data.numbers("pose", 6)[1, :3])
    (scene / "alignments.npy").unlink()
    assert read_neuman(scene).poses is None


def test_splits_by_image_name(scene, tmp_path):
    for name, words in (("train", ["00000.png", "00002.png", "00004.png"]), ("val", ["00001.png"])):
        (scene / f"{name}_split.txt").write_text("\n".join(words) + "\n")
    assert read_neuman(scene).split is None
    (scene / "test_split.txt").write_text("00005.png\n00003.png\n")
    write_recording(read_neuman(scene), tmp_path / "out")
    split = load_user_files(tmp_path / "out", open_frame_source(tmp_path / "out")).split
    np.testing.assert_array_equal(split.split, [0, 1, 0, 2, 0, 2])
    (scene / "test_split.txt").write_text("00099.png\n")
    with pytest.raises(UserError, match="names 00099.png, which is not in images/"):
        read_neuman(scene)


def test_inconsistent_files_are_errors(scene):
    (scene / "segmentations" / "00002.png").unlink()
    with pytest.raises(UserError, match="with the names of images, but none for 00002"):
        read_neuman(scene)
    dump_joblib(
        {1: {"pose": sample_data.numbers("pose", 3), "betas": np.zeros((3, 10))}}, scene / "smpl_output_romp.pkl"
    )
    (scene / "smpl_output_optimized.pkl").unlink()
    (scene / "segmentations" / "00002.png").write_bytes((scene / "segmentations" / "00001.png").read_bytes())
    with pytest.raises(UserError, match="has poses of 3 images"):
        read_neuman(scene)
    dump_joblib({1: {}, 2: {}}, scene / "smpl_output_romp.pkl")
    with pytest.raises(UserError, match="does not hold the poses of one person"):
        read_neuman(scene)
    cameras = scene / "sparse" / "cameras.txt"
    cameras.write_text("1 PINHOLE 32 24 61 63 16.5 13\n")
    with pytest.raises(UserError, match="for images of 32x24, but those of .* are 16x12"):
        read_neuman(scene)
    cameras.write_text("2 PINHOLE 16 12 61 63 16.5 13\n")
    with pytest.raises(UserError, match="0 cameras"):
        read_neuman(scene)
