"""Arrays, bodies, motions and cameras survive the disk, byte for byte."""

import numpy as np
import pytest

from pipeline.body.body import Motion, load_anny
from pipeline.core.errors import UserError
from pipeline.geometry.camera import Camera
from pipeline.io import npz


def test_same_arrays_give_the_same_bytes_and_come_back(tmp_path) -> None:
    arrays = {"b": np.arange(6.0).reshape(2, 3), "a": np.array(["x", "yy"])}
    npz.save_npz(tmp_path / "one.npz", arrays)
    npz.save_npz(tmp_path / "two.npz", dict(reversed(arrays.items())))
    assert (tmp_path / "one.npz").read_bytes() == (tmp_path / "two.npz").read_bytes()
    again = npz.load_npz(tmp_path / "one.npz")
    np.testing.assert_array_equal(again["b"], arrays["b"])
    assert again["a"].tolist() == ["x", "yy"]


def test_a_single_number_stays_one(tmp_path) -> None:
    arrays = {"number": np.array(2.5), "word": np.array("x"), "row": np.zeros(1), "turned": np.eye(3, 2).T}
    npz.save_npz(tmp_path / "one.npz", arrays)
    shapes = {name: array.shape for name, array in npz.load_npz(tmp_path / "one.npz").items()}
    assert shapes == {name: array.shape for name, array in arrays.items()}


def test_pickles_and_rubbish_are_refused(tmp_path) -> None:
    np.savez(tmp_path / "pickled.npz", a=np.array([{}], dtype=object))
    (tmp_path / "rubbish.npz").write_bytes(b"no zip")
    for name in ("pickled.npz", "rubbish.npz", "missing.npz"):
        with pytest.raises(UserError, match=name):
            npz.load_npz(tmp_path / name)


def test_body_round_trip(tmp_path) -> None:
    parametric = load_anny()
    body = parametric.body(parametric.shape_defaults)
    npz.save_body(tmp_path / "body.npz", body)
    again = npz.load_body(tmp_path / "body.npz")
    assert again.joint_names == body.joint_names
    assert again.shape == body.shape
    for name in ("parents", "joints_m", "vertices", "faces", "skin_weights"):
        np.testing.assert_array_equal(getattr(again, name), getattr(body, name))


def test_camera_round_trip(tmp_path) -> None:
    camera = Camera(1.5, 2.5, 3.0, 4.0, 50, 60)
    npz.save_camera(tmp_path / "camera.npz", camera)
    again = npz.load_camera(tmp_path / "camera.npz")
    assert again.fx == 1.5
    assert again.height == 60


@pytest.mark.parametrize("place", ["rotations_wxyz", "root_translation_m"])
def test_a_pose_that_is_not_finite_is_refused_with_its_frames(tmp_path, place) -> None:
    turns = np.tile(np.float32([1, 0, 0, 0]), (5, 3, 1))
    motion = Motion(np.arange(10, 60, 10), np.arange(5.0), turns, np.zeros((5, 3), np.float32))
    npz.save_motion(tmp_path / "motion.npz", motion)
    np.testing.assert_array_equal(npz.load_motion(tmp_path / "motion.npz").rotations_wxyz, turns)
    values = getattr(motion, place)
    values[1, -1], values[4, 0] = np.nan, np.inf
    npz.save_motion(tmp_path / "motion.npz", motion)
    with pytest.raises(UserError, match=r"motion.npz: the poses of frames 20, 50 are not finite"):
        npz.load_motion(tmp_path / "motion.npz")
