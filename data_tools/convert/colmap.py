"""Read cameras and image poses of a COLMAP model from text or binary files; 3D points are not read.

Reference: https://colmap.github.io/format.html. Pixel centres are at +0.5, as in this project.
"""

import struct
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch
from jaxtyping import Float

from pipeline.capture.user_files import CameraCalibration
from pipeline.core.errors import UserError
from pipeline.geometry.rotation import quaternion_to_matrix

# Model id in binary files, number of parameters, and indices of fx, fy, cx, cy; lens distortion follows them.
_CAMERA_MODELS = {
    "SIMPLE_PINHOLE": (0, 3, (0, 0, 1, 2)),
    "PINHOLE": (1, 4, (0, 1, 2, 3)),
    "SIMPLE_RADIAL": (2, 4, (0, 0, 1, 2)),
    "RADIAL": (3, 5, (0, 0, 1, 2)),
    "OPENCV": (4, 8, (0, 1, 2, 3)),
    "FULL_OPENCV": (6, 12, (0, 1, 2, 3)),
}


@dataclass(frozen=True)
class ColmapCamera:
    """One camera of the model, with its image size in pixels."""

    camera: CameraCalibration
    width: int
    height: int


@dataclass(frozen=True)
class ColmapModel:
    """A model in its own unit of length.

    Attributes:
        cameras: by camera id.
        camera_id_of: by image name.
        world_to_camera: by image name.
    """

    cameras: Mapping[int, ColmapCamera]
    camera_id_of: Mapping[str, int]
    world_to_camera: Mapping[str, Float[np.ndarray, "4 4"]]


def find_colmap_model(folder: Path) -> Path | None:
    """Return the folder `sparse` or `sparse/0` of `folder` that holds a model; None if there is none."""
    candidates = (
        path / f"cameras.{end}" for path in (folder / "sparse", folder / "sparse" / "0") for end in ("txt", "bin")
    )
    return next((candidate.parent for candidate in candidates if candidate.is_file()), None)


def read_colmap_model(folder: Path) -> ColmapModel:
    """Read `cameras` and `images`; `.txt` files have precedence over `.bin` files.

    Raises:
        UserError: a file is missing or damaged, or a camera is not a pinhole camera with OpenCV distortion.
    """
    is_text = (folder / "cameras.txt").is_file()
    ending, cameras_of, images_of = (
        ("txt", _text_cameras, _text_images) if is_text else ("bin", _binary_cameras, _binary_images)
    )
    cameras, camera_id_of, world_to_camera = {}, {}, {}
    path = folder / f"cameras.{ending}"
    try:
        for camera_id, model, width, height, parameters in cameras_of(path):
            cameras[camera_id] = ColmapCamera(_camera(model, parameters, path), width, height)
        path = folder / f"images.{ending}"
        for name, camera_id, pose in images_of(path):
            camera_id_of[name] = camera_id
            world_to_camera[name] = _pose_to_matrix(pose)
    except FileNotFoundError:
        raise UserError(f"{path} does not exist; supply the complete COLMAP model") from None
    except (ValueError, IndexError, OverflowError, struct.error) as error:
        raise UserError(f"{path} is not a valid COLMAP file ({error}); export the model again") from None
    return ColmapModel(cameras, camera_id_of, world_to_camera)


_CameraRow = tuple[int, str, int, int, tuple[float, ...]]
_ImageRow = tuple[str, int, tuple[float, ...]]


def _text_cameras(path: Path) -> Iterator[_CameraRow]:
    for line in _data_lines(path):
        if line:
            camera_id, model, width, height, *parameters = line.split()
            yield int(camera_id), model, int(width), int(height), tuple(float(value) for value in parameters)


def _text_images(path: Path) -> Iterator[_ImageRow]:
    # Two lines per image; the second lists its points and may be empty.
    for line in _data_lines(path)[::2]:
        if line:
            _, *pose, camera_id, name = line.split(maxsplit=9)
            yield name, int(camera_id), tuple(float(value) for value in pose)


def _data_lines(path: Path) -> list[str]:
    lines = path.read_text(encoding="utf-8").splitlines()
    return [line.strip() for line in lines if not line.startswith("#")]


def _binary_cameras(path: Path) -> Iterator[_CameraRow]:
    model_by_id = {model_id: (model, size) for model, (model_id, size, _) in _CAMERA_MODELS.items()}
    data = path.read_bytes()
    (count,), offset = struct.unpack_from("<Q", data), 8
    for _ in range(count):
        camera_id, model_id, width, height = struct.unpack_from("<iiQQ", data, offset)
        model, size = model_by_id.get(model_id, (f"number {model_id}", 0))
        yield camera_id, model, width, height, struct.unpack_from(f"<{size}d", data, offset + 24)
        offset += 24 + 8 * size


def _binary_images(path: Path) -> Iterator[_ImageRow]:
    data = path.read_bytes()
    (count,), offset = struct.unpack_from("<Q", data), 8
    for _ in range(count):
        _, *pose, camera_id = struct.unpack_from("<i7di", data, offset)
        end = data.index(b"\0", offset + 64)
        yield data[offset + 64 : end].decode("utf-8"), camera_id, tuple(pose)
        (n_points,) = struct.unpack_from("<Q", data, end + 1)
        offset = end + 9 + 24 * n_points


def _camera(model: str, parameters: tuple[float, ...], path: Path) -> CameraCalibration:
    if model not in _CAMERA_MODELS:
        raise UserError(
            f"{path}: camera model {model} is not supported, only {', '.join(_CAMERA_MODELS)}; undistort the images "
            "with COLMAP"
        )
    _, size, parameter_indices = _CAMERA_MODELS[model]
    if len(parameters) != size:
        raise ValueError(f"{model} has {size} parameters, found {len(parameters)}")
    fx, fy, cx, cy = (parameters[index] for index in parameter_indices)
    distortion = parameters[max(parameter_indices) + 1 :]
    # OpenCV needs at least k1 k2 p1 p2.
    return CameraCalibration(fx, fy, cx, cy, distortion + (0.0,) * (4 - len(distortion)) if any(distortion) else ())


def _pose_to_matrix(pose: tuple[float, ...]) -> Float[np.ndarray, "4 4"]:
    """Convert (qw, qx, qy, qz, tx, ty, tz) to world_to_camera."""
    matrix = np.eye(4)
    matrix[:3, :3] = quaternion_to_matrix(torch.tensor(pose[:4], dtype=torch.float64)).numpy()
    matrix[:3, 3] = pose[4:]
    return matrix
