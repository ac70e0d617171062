"""Files beside a video: what is read from each layout, and the sentence for each that does not fit."""

import json

import h5py
import numpy as np
import pytest

from pipeline.core.errors import UserError
from pipeline.io.image import write_gray
from pipeline.io.npz import save_npz
from pipeline.io.smpl_poses import save_smpl_poses
from pipeline.io.supplied import SuppliedCamera, find_supplied
from pipeline.io.video import Source
from tests.io.test_smpl_poses import make_poses

CAMERA = {"fx": 500.0, "fy": 510.0, "cx": 64.0, "cy": 48.0}


@pytest.fixture
def source(tmp_path) -> Source:
    return Source(tmp_path, tuple(tmp_path / f"{name}.jpg" for name in ("x1", "x2", "x10")), 3, 30.0)


def masks() -> np.ndarray:
    return np.arange(3, dtype=np.uint8)[:, None, None] * np.ones((1, 4, 6), np.uint8)


def test_nothing_beside_the_video(tmp_path, source):
    supplied = find_supplied(tmp_path, source)
    assert (supplied.read_mask, supplied.mask_source, supplied.landmarks, supplied.camera) == (None, "", None, None)
    assert find_supplied(tmp_path / "video.mp4", source).camera is None


def test_mask_folder_by_name_and_by_order(tmp_path, source):
    (tmp_path / "masks").mkdir()
    for name, level in (("x1", 10), ("x2", 20), ("x10", 30), ("other", 99)):
        write_gray(tmp_path / "masks" / f"{name}.png", np.full((4, 6), level, np.uint8))
    by_name = find_supplied(tmp_path, source)
    assert [int(by_name.read_mask(i).mean()) for i in range(3)] == [10, 20, 30]
    by_order = find_supplied(tmp_path, Source(tmp_path, (), 3, 25.0))
    assert [int(by_order.read_mask(i).mean()) for i in range(3)] == [99, 10, 20]


def test_mask_arrays_are_brought_to_255(tmp_path, source):
    save_npz(tmp_path / "masks.npz", {"masks": masks() > 1})
    assert find_supplied(tmp_path, source).read_mask(2).max() == 255
    (tmp_path / "masks.npz").unlink()
    with h5py.File(tmp_path / "masks.hdf5", "w") as file:
        file["masks"] = masks() // 2
    supplied = find_supplied(tmp_path, source)
    assert supplied.mask_source == "masks.hdf5"
    assert [int(supplied.read_mask(i).max()) for i in range(3)] == [0, 0, 255]


def test_poses_of_frames_that_there_are(tmp_path, source):
    save_smpl_poses(tmp_path / "smpl_poses.npz", make_poses(1))
    assert find_supplied(tmp_path, source).smpl_poses.gender == "female"
    save_smpl_poses(tmp_path / "smpl_poses.npz", make_poses(2))
    with pytest.raises(UserError, match="has poses of frames 0 to 4, .* has 0 to 2"):
        find_supplied(tmp_path, source)


def test_landmarks_with_and_without_the_rest(tmp_path, source):
    points = np.random.default_rng(0).uniform(0, 50, (3, 33, 2))
    save_npz(tmp_path / "landmarks.npz", {"landmarks_px": points})
    landmarks = find_supplied(tmp_path, source).landmarks
    np.testing.assert_allclose(landmarks.landmarks_px, points, rtol=1e-6)
    assert (landmarks.visibility == 1).all()
    assert np.isnan(landmarks.landmarks_world_m).all()


def test_camera_for_smaller_images(tmp_path, source):
    pose = np.eye(4)
    pose[2, 3] = 3
    (tmp_path / "camera.json").write_text(json.dumps(CAMERA | {"world_to_camera": pose.tolist()}))
    camera = find_supplied(tmp_path, source).camera.at(0.5, 64, 48)
    assert (camera.fx, camera.fy, camera.cx, camera.cy) == (250, 255, 32, 24)
    np.testing.assert_array_equal(camera.world_to_camera, pose)


def test_a_split_says_what_each_listed_frame_is_for(tmp_path):
    recording = Source(tmp_path, (), 30, 25.0)
    (tmp_path / "split.json").write_text('{"train": [12, 3, 4], "validation": [8], "heldout": [29, 0]}')
    split = find_supplied(tmp_path, recording).split
    np.testing.assert_array_equal(split.frame_index, [0, 3, 4, 8, 12, 29])
    np.testing.assert_array_equal(split.split, [2, 0, 0, 1, 0, 2])
    np.testing.assert_array_equal(split.of(np.array([29, 8, 3])), [2, 1, 0])


def test_a_split_without_validation_takes_every_eighth_training_frame(tmp_path):
    recording = Source(tmp_path, (), 60, 25.0)
    (tmp_path / "split.json").write_text(json.dumps({"train": list(range(0, 40, 2)), "heldout": [41]}))
    split = find_supplied(tmp_path, recording).split
    np.testing.assert_array_equal(split.frame_index[split.split == 1], [8, 24])
    assert (split.split == 0).sum() == 18


def test_lens_distortion_is_taken_out_of_pictures_and_points():
    """A bright dot drawn where the distorted lens sees it must land where the ideal pinhole projects it."""
    k1, focal, centre = -0.25, 100.0, 64.0
    camera = SuppliedCamera(focal, focal, centre, centre, (k1, 0.0, 0.0, 0.0))
    ideal = np.array([0.4, 0.3])
    bent = ideal * (1 + k1 * (ideal**2).sum())
    seen_px, expected_px = centre + focal * bent, centre + focal * ideal
    rows, columns = np.mgrid[:128, :128] + 0.5
    dot = 250 * np.exp(-((columns - seen_px[0]) ** 2 + (rows - seen_px[1]) ** 2) / 8)
    picture = camera.undistort(np.repeat(dot[..., None], 3, axis=2).astype(np.uint8), 1.0)[..., 0].astype(float)
    found = np.array([(picture * columns).sum(), (picture * rows).sum()]) / picture.sum()
    np.testing.assert_allclose(found, expected_px, atol=0.15)
    np.testing.assert_allclose(camera.undistort_points(seen_px[None])[0], expected_px, atol=1e-2)


def test_without_distortion_nothing_is_resampled():
    picture = np.random.default_rng(0).integers(0, 255, (8, 8, 3), dtype=np.uint8)
    camera = SuppliedCamera(10.0, 10.0, 4.0, 4.0, (0.0, 0.0, 0.0, 0.0))
    assert camera.undistort(picture, 1.0) is picture
    points = np.zeros((2, 2))
    assert camera.undistort_points(points) is points


@pytest.mark.parametrize(
    ("name", "content", "message"),
    [
        ("camera.json", "{", "is no camera"),
        ("camera.json", json.dumps({"fx": 1}), "is no camera"),
        ("camera.json", json.dumps([1, 2]), "is no camera"),
        ("camera.json", json.dumps(CAMERA | {"fx": -1}), "above 0"),
        ("camera.json", json.dumps(CAMERA | {"distortion": [0.1]}), "distortion needs"),
        ("camera.json", json.dumps(CAMERA | {"world_to_camera": [1, 2]}), "is no camera"),
        ("split.json", "[0, 1]", "is no split"),
        ("split.json", '{"train": 3, "heldout": [1]}', "is no split"),
        ("split.json", '{"train": [0.5], "heldout": [1]}', "is no split"),
        ("split.json", '{"train": [0], "test": [1]}', "unknown list test; there are train, validation, heldout"),
        ("split.json", '{"train": [0], "heldout": [1]}', "no frame for validation"),
        ("split.json", '{"train": [0], "validation": [1], "heldout": []}', "no frame for heldout"),
        ("split.json", '{"train": [0], "validation": [1], "heldout": [0]}', "a frame twice"),
        ("split.json", '{"train": [0], "validation": [1], "heldout": [3]}', "up to 3, .* has 0 to 2"),
        ("masks.npz", "x", "masks.npz"),
        ("masks.hdf5", "x", "masks.hdf5"),
        ("landmarks.npz", "x", "landmarks.npz"),
    ],
)
def test_a_file_that_does_not_fit_is_named(tmp_path, source, name, content, message):
    (tmp_path / name).write_text(content)
    with pytest.raises(UserError, match=message):
        find_supplied(tmp_path, source)


@pytest.mark.parametrize(
    ("name", "arrays", "message"),
    [
        ("masks.npz", {"mask": masks()}, "no array `masks`"),
        ("masks.npz", {"masks": masks()[0]}, "frames, height, width"),
        ("masks.npz", {"masks": masks()[:2]}, "2 entries for 3 frames"),
        ("landmarks.npz", {"landmarks_px": np.zeros((3, 17, 2))}, "must have shape"),
        ("landmarks.npz", {"landmarks_px": np.zeros((2, 33, 2))}, "2 entries for 3 frames"),
        (
            "landmarks.npz",
            {"landmarks_px": np.zeros((3, 33, 2)), "landmarks_visibility": np.zeros(3)},
            "mend its shape",
        ),
    ],
)
def test_arrays_that_do_not_fit_are_named(tmp_path, source, name, arrays, message):
    save_npz(tmp_path / name, arrays)
    with pytest.raises(UserError, match=message):
        find_supplied(tmp_path, source)
