"""COLMAP models: equal content of text and binary files, and OpenCV distortion."""

import struct

import numpy as np
import pytest

from data_tools.convert.colmap import find_colmap_model, read_colmap_model
from pipeline.core.errors import UserError

NUMBERS = {"SIMPLE_PINHOLE": 0, "PINHOLE": 1, "SIMPLE_RADIAL": 2, "RADIAL": 3, "OPENCV": 4, "FULL_OPENCV": 6}
PARAMETERS = {
    "SIMPLE_PINHOLE": ((50, 8, 6), (50, 50, 8, 6), ()),
    "PINHOLE": ((50, 51, 8, 6), (50, 51, 8, 6), ()),
    "SIMPLE_RADIAL": ((50, 8, 6, 0.1), (50, 50, 8, 6), (0.1, 0, 0, 0)),
    "RADIAL": ((50, 8, 6, 0.1, 0.2), (50, 50, 8, 6), (0.1, 0.2, 0, 0)),
    "OPENCV": ((50, 51, 8, 6, 0.1, 0.2, 0.3, 0.4), (50, 51, 8, 6), (0.1, 0.2, 0.3, 0.4)),
    "FULL_OPENCV": (
        (50, 51, 8, 6, 0.1, 0.2, 0.3, 0.4, 0.5, 0.6, 0.7, 0.8),
        (50, 51, 8, 6),
        (0.1, 0.2, 0.3, 0.4, 0.5, 0.6, 0.7, 0.8),
    ),
}
# A third of a turn about (1, 1, 1), which carries x to y, y to z and z to x.
THIRD_TURN = (0.5, 0.5, 0.5, 0.5)
IMAGES = {"a b.png": (THIRD_TURN, (1.0, 2.0, 3.0), 2), "c.png": ((1.0, 0.0, 0.0, 0.0), (0.0, 0.0, 5.0), 0)}


def write_text(folder, model, parameters):
    folder.mkdir(parents=True)
    numbers = " ".join(map(str, parameters))
    (folder / "cameras.txt").write_text(f"# Camera list\n# Number of cameras: 1\n7 {model} 16 12 {numbers}\n")
    lines = ["# Image list"]
    for k, (name, (turn, place, n_points)) in enumerate(IMAGES.items()):
        lines.append(f"{k} {' '.join(map(str, (*turn, *place)))} 7 {name}")
        lines.append(" ".join(["1.5 2.5 -1"] * n_points))
    (folder / "images.txt").write_text("\n".join(lines) + "\n")


def write_binary(folder, model, parameters):
    folder.mkdir(parents=True)
    header = struct.pack("<QiiQQ", 1, 7, NUMBERS[model], 16, 12)
    (folder / "cameras.bin").write_bytes(header + struct.pack(f"<{len(parameters)}d", *parameters))
    data = struct.pack("<Q", len(IMAGES))
    for k, (name, (turn, place, n_points)) in enumerate(IMAGES.items()):
        data += struct.pack("<i7di", k, *turn, *place, 7) + name.encode() + b"\0"
        data += struct.pack("<Q", n_points) + struct.pack("<ddq", 1.5, 2.5, -1) * n_points
    (folder / "images.bin").write_bytes(data)


@pytest.mark.parametrize("write", [write_text, write_binary])
@pytest.mark.parametrize("model", sorted(PARAMETERS))
def test_cameras_and_poses(tmp_path, write, model):
    parameters, pinhole, distortion = PARAMETERS[model]
    write(tmp_path / "sparse" / "0", model, parameters)
    assert find_colmap_model(tmp_path) == tmp_path / "sparse" / "0"
    read = read_colmap_model(tmp_path / "sparse" / "0")
    one = read.cameras[7]
    assert (one.width, one.height) == (16, 12)
    assert (one.camera.fx, one.camera.fy, one.camera.cx, one.camera.cy) == pinhole
    assert one.camera.distortion == distortion
    assert read.camera_id_of == dict.fromkeys(IMAGES, 7)
    expected = np.array([[0, 0, 1, 1], [1, 0, 0, 2], [0, 1, 0, 3], [0, 0, 0, 1]])
    np.testing.assert_allclose(read.world_to_camera["a b.png"], expected, atol=1e-12)
    np.testing.assert_allclose(read.world_to_camera["c.png"][:, 3], [0, 0, 5, 1])


def test_zero_distortion_is_empty(tmp_path):
    write_text(tmp_path / "m", "RADIAL", (50, 8, 6, 0, 0))
    assert read_colmap_model(tmp_path / "m").cameras[7].camera.distortion == ()


@pytest.mark.parametrize("write", [write_text, write_binary])
def test_unsupported_camera_model_is_an_error(tmp_path, write, monkeypatch):
    monkeypatch.setitem(NUMBERS, "OPENCV_FISHEYE", 5)
    write(tmp_path / "m", "OPENCV_FISHEYE", (50, 51, 8, 6, 0.1, 0.2, 0.3, 0.4))
    with pytest.raises(UserError, match="camera model (OPENCV_FISHEYE|number 5) is not supported"):
        read_colmap_model(tmp_path / "m")


def test_damaged_and_missing_files_are_errors(tmp_path):
    assert find_colmap_model(tmp_path) is None
    write_text(tmp_path / "m", "PINHOLE", (50, 51, 8))
    with pytest.raises(UserError, match="PINHOLE has 4 parameters, found 3"):
        read_colmap_model(tmp_path / "m")
    write_text(tmp_path / "n", "PINHOLE", (50, 51, 8, 6))
    (tmp_path / "n" / "images.txt").unlink()
    with pytest.raises(UserError, match=r"images\.txt does not exist"):
        read_colmap_model(tmp_path / "n")
    write_binary(tmp_path / "b", "PINHOLE", (50, 51, 8, 6))
    whole = (tmp_path / "b" / "images.bin").read_bytes()
    for length in (4, 40, 75, len(whole) // 2):
        (tmp_path / "b" / "images.bin").write_bytes(whole[:length])
        with pytest.raises(UserError, match=r"images\.bin is not a valid COLMAP file"):
            read_colmap_model(tmp_path / "b")
