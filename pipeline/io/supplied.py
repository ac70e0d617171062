"""What lies beside a video and wins: masks, landmarks, a camera over the detector, a split over index modulo eight.

    masks/        one image a frame, in natural order or named as the images are
    masks.npz     array `masks` (n, h, w);  masks.hdf5: the same, as PeopleSnapshot ships it
    landmarks.npz `landmarks_px` (n, 33, 2) in pixels of the original frames, optionally `landmarks_visibility` (n, 33)
                  and `landmarks_world_m` (n, 33, 3); MediaPipe's 33 points in its order
    camera.json   fx, fy, cx, cy in pixels of the original frames, optionally `distortion` (OpenCV's k1 k2 p1 p2 [k3])
                  and `world_to_camera` (4 x 4, row-major)
    split.json    lists of frame indices `train` and `heldout`, optionally `validation` (else every eighth training
                  frame, from the fifth on); the frames that stand in none are left out
    smpl_poses.npz  poses that others fitted, of any frames (`pipeline.io.smpl_poses`); they need the camera they are of

Row i of each array belongs to frame i of the recording.
"""

import json
import operator
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np
from jaxtyping import Float, Int, UInt8

from pipeline.avatar.selection import HELDOUT, SPLIT_PERIOD, TRAIN, VALIDATION, VALIDATION_PHASE
from pipeline.core.errors import UserError
from pipeline.geometry.camera import UPRIGHT_WORLD_TO_CAMERA, Camera
from pipeline.io.image import IMAGE_SUFFIXES, read_gray
from pipeline.io.npz import load_npz
from pipeline.io.smpl_poses import SMPL_POSES_NPZ, SmplPoses, load_smpl_poses
from pipeline.io.video import Source, natural_key

N_LANDMARKS = 33
_SPLITS = {"train": TRAIN, "validation": VALIDATION, "heldout": HELDOUT}


@dataclass(frozen=True)
class SuppliedCamera:
    """Intrinsics in pixels of the original frames; `world_to_camera` is None where the file does not give it."""

    fx: float
    fy: float
    cx: float
    cy: float
    distortion: tuple[float, ...] = ()
    world_to_camera: Float[np.ndarray, "4 4"] | None = None

    def at(self, scale: float, width: int, height: int) -> Camera:
        """The camera of undistorted images of this scale and size."""
        pose = UPRIGHT_WORLD_TO_CAMERA if self.world_to_camera is None else self.world_to_camera
        fx, fy, cx, cy = (scale * value for value in (self.fx, self.fy, self.cx, self.cy))
        return Camera(fx, fy, cx, cy, width, height, pose)

    def undistort(self, rgb: UInt8[np.ndarray, "h w c"], scale: float) -> UInt8[np.ndarray, "h w c"]:
        """The picture as a lens without distortion would show it; `scale` is its size relative to the original."""
        if not any(self.distortion):
            return rgb
        return cv2.undistort(rgb, self._matrix(scale, centre_px=0.0), np.array(self.distortion)).reshape(rgb.shape)

    def undistort_points(self, points_px: Float[np.ndarray, "*n 2"]) -> Float[np.ndarray, "*n 2"]:
        """Where points of the original frames lie in the undistorted ones."""
        if not any(self.distortion):
            return points_px
        matrix = self._matrix(1.0, centre_px=0.5)
        points = cv2.undistortPoints(
            points_px.reshape(-1, 1, 2).astype(np.float64), matrix, np.array(self.distortion), P=matrix
        )
        return points.reshape(points_px.shape)

    def _matrix(self, scale: float, centre_px: float) -> Float[np.ndarray, "3 3"]:
        """K for a picture of this scale whose first pixel's centre has the coordinate `centre_px` (OpenCV warps: 0)."""
        shift = centre_px - 0.5
        fx, fy = self.fx * scale, self.fy * scale
        return np.array([[fx, 0.0, self.cx * scale + shift], [0.0, fy, self.cy * scale + shift], [0.0, 0.0, 1.0]])


@dataclass(frozen=True)
class SuppliedLandmarks:
    """Landmarks for every frame of the recording, in pixels of the original frames."""

    landmarks_px: Float[np.ndarray, "n 33 2"]
    visibility: Float[np.ndarray, "n 33"]
    landmarks_world_m: Float[np.ndarray, "n 33 3"]


@dataclass(frozen=True)
class SuppliedSplit:
    """Which frames of the recording are to be used, in rising order, and what for (as `Capture.split`)."""

    frame_index: Int[np.ndarray, "m"]
    split: UInt8[np.ndarray, "m"]

    def of(self, frame_index: Int[np.ndarray, "n"]) -> UInt8[np.ndarray, "n"]:
        """What these frames, all of them listed, are for."""
        return self.split[np.searchsorted(self.frame_index, frame_index)]


@dataclass(frozen=True)
class Supplied:
    """What was found; None for what was not. `read_mask(index)` gives uint8 [0, 255] at its own size."""

    read_mask: Callable[[int], UInt8[np.ndarray, "h w"]] | None
    mask_source: str
    landmarks: SuppliedLandmarks | None
    camera: SuppliedCamera | None
    split: SuppliedSplit | None = None
    smpl_poses: SmplPoses | None = None


def find_supplied(path: Path, source: Source) -> Supplied:
    """Look in the user's folder (nothing is looked for when a video file alone was given).

    Raises UserError when a file that is there does not fit the recording.
    """
    if not path.is_dir():
        return Supplied(None, "", None, None)
    read_mask, mask_source = _find_masks(path, source)
    landmarks_path, camera_path, split_path, poses_path = (
        path / name for name in ("landmarks.npz", "camera.json", "split.json", SMPL_POSES_NPZ)
    )
    return Supplied(
        read_mask,
        mask_source,
        _read_landmarks(landmarks_path, source) if landmarks_path.is_file() else None,
        _read_camera(camera_path) if camera_path.is_file() else None,
        _read_split(split_path, source) if split_path.is_file() else None,
        _read_smpl_poses(poses_path, source) if poses_path.is_file() else None,
    )


def _find_masks(path: Path, source: Source) -> tuple[Callable[[int], np.ndarray] | None, str]:
    if (path / "masks").is_dir():
        return _mask_folder(path / "masks", source), "masks/"
    if (path / "masks.npz").is_file():
        arrays = load_npz(path / "masks.npz")
        if "masks" not in arrays:
            raise UserError(f"{path / 'masks.npz'} has no array `masks`; store it as (frames, height, width)")
        return _mask_array(arrays["masks"], path / "masks.npz", source), "masks.npz"
    if (path / "masks.hdf5").is_file():
        return _mask_array(_read_hdf5(path / "masks.hdf5"), path / "masks.hdf5", source), "masks.hdf5"
    return None, ""


def _mask_folder(folder: Path, source: Source) -> Callable[[int], np.ndarray]:
    files = sorted((p for p in folder.iterdir() if p.suffix.lower() in IMAGE_SUFFIXES), key=natural_key)
    by_stem = {p.stem: p for p in files}
    if source.files and all(image.stem in by_stem for image in source.files):
        files = [by_stem[image.stem] for image in source.files]
    _check_count(folder, len(files), source)
    return lambda index: read_gray(files[index])


def _mask_array(masks: np.ndarray, path: Path, source: Source) -> Callable[[int], np.ndarray]:
    if masks.ndim != 3:
        raise UserError(f"{path}: the masks have shape {masks.shape}; store them as (frames, height, width)")
    _check_count(path, len(masks), source)
    highest = float(masks.max())
    return lambda index: np.rint(masks[index].astype(np.float32) * (255.0 / max(highest, 1e-6))).astype(np.uint8)


def _read_hdf5(path: Path) -> np.ndarray:
    import h5py  # here, because no other input needs it

    try:
        with h5py.File(path, "r") as file:
            return np.asarray(file["masks"])
    except (OSError, KeyError) as error:
        raise UserError(
            f"{path} cannot be read as HDF5 with a data set `masks` ({error}); remove or replace it"
        ) from None


def _read_landmarks(path: Path, source: Source) -> SuppliedLandmarks:
    arrays = load_npz(path)
    points = arrays.get("landmarks_px")
    if points is None or points.ndim != 3 or points.shape[1:] != (N_LANDMARKS, 2):
        shape = None if points is None else points.shape
        raise UserError(f"{path}: `landmarks_px` must have shape (frames, {N_LANDMARKS}, 2), found {shape}")
    _check_count(path, len(points), source)
    visibility = arrays.get("landmarks_visibility", np.isfinite(points).all(-1))
    world = arrays.get("landmarks_world_m", np.full((*points.shape[:2], 3), np.nan))
    if visibility.shape != points.shape[:2] or world.shape != (*points.shape[:2], 3):
        raise UserError(
            f"{path}: `landmarks_visibility` or `landmarks_world_m` does not fit `landmarks_px`; mend its shape"
        )
    return SuppliedLandmarks(points.astype(np.float32), visibility.astype(np.float32), world.astype(np.float32))


def _read_camera(path: Path) -> SuppliedCamera:
    try:
        values = json.loads(path.read_text(encoding="utf-8"))
        fx, fy, cx, cy = (float(values[key]) for key in ("fx", "fy", "cx", "cy"))
        distortion = tuple(float(value) for value in values.get("distortion") or ())
        pose = values.get("world_to_camera")
        world_to_camera = None if pose is None else np.array(pose, dtype=np.float32).reshape(4, 4)
    except (ValueError, KeyError, TypeError, AttributeError) as error:
        raise UserError(f"{path} is no camera ({error}); it needs numbers fx, fy, cx, cy in pixels") from None
    if min(fx, fy) <= 0 or not np.isfinite([fx, fy, cx, cy]).all():
        raise UserError(f"{path}: fx and fy must be above 0 pixels, found {fx} and {fy}")
    if len(distortion) not in (0, 4, 5, 8):
        raise UserError(f"{path}: distortion needs 4, 5 or 8 numbers (k1 k2 p1 p2 ...), found {len(distortion)}")
    return SuppliedCamera(fx, fy, cx, cy, distortion, world_to_camera)


def _read_split(path: Path, source: Source) -> SuppliedSplit:
    try:
        values = json.loads(path.read_text(encoding="utf-8"))
        lists = {name: [operator.index(value) for value in indices] for name, indices in values.items()}
    except (ValueError, TypeError, AttributeError) as error:
        raise UserError(f"{path} is no split ({error}); it needs lists of frame indices, train and heldout") from None
    if unknown := set(lists) - set(_SPLITS):
        raise UserError(f"{path}: unknown list {sorted(unknown)[0]}; there are {', '.join(_SPLITS)}")
    if "validation" not in lists:
        train = sorted(lists.get("train", []))
        lists["validation"] = train[VALIDATION_PHASE::SPLIT_PERIOD]
        lists["train"] = sorted(set(train) - set(lists["validation"]))
    for name in _SPLITS:
        if not lists.get(name):
            raise UserError(f"{path} lists no frame for {name}; list some of each kind, and 5 training ones or more")
    indices = np.concatenate([lists[name] for name in _SPLITS])
    if len(np.unique(indices)) != len(indices):
        raise UserError(f"{path} lists a frame twice; give each frame one use")
    if indices.min() < 0 or indices.max() >= source.n_frames:
        raise UserError(f"{path} lists frames up to {indices.max()}, {source.path} has 0 to {source.n_frames - 1}")
    kinds = np.concatenate([np.full(len(lists[name]), kind, np.uint8) for name, kind in _SPLITS.items()])
    order = np.argsort(indices)
    return SuppliedSplit(indices[order], kinds[order])


def _read_smpl_poses(path: Path, source: Source) -> SmplPoses:
    poses = load_smpl_poses(path)
    if len(poses.frame_index) and not 0 <= poses.frame_index[0] <= poses.frame_index[-1] < source.n_frames:
        raise UserError(
            f"{path} has poses of frames {poses.frame_index[0]} to {poses.frame_index[-1]}, {source.path} has 0 to "
            f"{source.n_frames - 1}; give the recording that belongs to them"
        )
    return poses


def _check_count(path: Path, count: int, source: Source) -> None:
    if count < source.n_frames:
        raise UserError(
            f"{path} has {count} entries for {source.n_frames} frames of {source.path}; "
            "give one for each frame, or remove it and the detector will be used"
        )
