"""User-supplied inputs, which override the detector: masks, landmarks, a camera, a split, SMPL poses.

    masks/        one image per frame, with the names of the images or in natural order; cut-outs by their alpha
    masks.npz     array `masks` (n, h, w);  masks.hdf5: the same, as in PeopleSnapshot
    (none)        alpha channel of the images, if they are partly transparent
    landmarks.npz MediaPipe's 33 landmarks: `landmarks_px` (n, 33, 2) in pixels of the original frames, nan where
                  unknown; optional `landmarks_visibility` (n, 33) in [0, 1] and `landmarks_world_m` (n, 33, 3) relative
                  to the centre of the hips, camera axes (else from the detector)
    camera.json   fx, fy, cx, cy in pixels of the original frames; optional `width` and `height` of the images of the
                  calibration, `distortion` (OpenCV's k1 k2 p1 p2 [k3 [k4 k5 k6]]) and `world_to_camera` (4 x 4,
                  row-major, rotation and translation in metres; the world is +Y up)
    split.json    lists of frame indices `train` and `heldout`, optional `validation` (else every eighth training frame
                  from the fifth on); frames in no list are not used
    smpl_poses.npz  SMPL poses of any frames (`pipeline.capture.smpl_poses`); they need a camera

Masks are 0 where the person is not, and have any largest level, which counts as 255.

Row i of each array belongs to frame i of the recording; there is one row for each frame. Original frames are upright
(rotation of the container or EXIF applied), have square pixels, and include lens distortion.
"""

import operator
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np
from jaxtyping import Float, Int, Shaped, UInt8

from pipeline.capture.frame_selection import HELDOUT, SPLIT_PERIOD, TRAIN, VALIDATION, VALIDATION_PHASE
from pipeline.capture.landmarks import N_LANDMARKS
from pipeline.capture.smpl_poses import SMPL_POSES_NPZ, SmplPoses, is_rigid, load_smpl_poses
from pipeline.capture.video import FrameSource, image_size_px, images_in
from pipeline.core.errors import UserError
from pipeline.core.json_file import load_json
from pipeline.geometry.camera import DEFAULT_WORLD_TO_CAMERA, Camera
from pipeline.io.image import read_alpha, read_gray_uint16
from pipeline.io.npz import load_npz

# Maximum distance of a principal point from the centre, as a fraction of the side, if the image size of the calibration
# is unknown. A calibration for images of half the size is off by a quarter.
_MAX_PRINCIPAL_POINT_OFFSET = 0.2
# So many masks tell the largest level, and whether they show the person.
_N_MASKS_SAMPLED = 8
_OWN_ALPHA = "the images' alpha channel"
MaskReader = Callable[[int], UInt8[np.ndarray, "h w"]]
"""Returns the mask of a frame, 0 to 255, at the mask's own size."""

_SPLITS = {"train": TRAIN, "validation": VALIDATION, "heldout": HELDOUT}


@dataclass(frozen=True)
class CameraCalibration:
    """Intrinsics in pixels of the original frames; `world_to_camera` is None where the file does not give it."""

    fx: float
    fy: float
    cx: float
    cy: float
    distortion: tuple[float, ...] = ()
    world_to_camera: Float[np.ndarray, "4 4"] | None = None

    def to_camera(self, scale: float, width: int, height: int) -> Camera:
        """The camera of undistorted images of this scale and size."""
        pose = DEFAULT_WORLD_TO_CAMERA if self.world_to_camera is None else self.world_to_camera
        fx, fy, cx, cy = (scale * value for value in (self.fx, self.fy, self.cx, self.cy))
        return Camera(fx, fy, cx, cy, width, height, pose)

    def undistort(self, rgb: UInt8[np.ndarray, "h w c"], scale: float) -> UInt8[np.ndarray, "h w c"]:
        """The picture as a lens without distortion would show it; `scale` is its size relative to the original."""
        if not any(self.distortion):
            return rgb
        return cv2.undistort(
            rgb, self._intrinsic_matrix(scale, first_pixel_centre_px=0.0), np.array(self.distortion)
        ).reshape(rgb.shape)

    def undistort_points(self, points_px: Float[np.ndarray, "*n 2"]) -> Float[np.ndarray, "*n 2"]:
        """Where points of the original frames lie in the undistorted ones."""
        if not any(self.distortion):
            return points_px
        matrix = self._intrinsic_matrix(1.0, first_pixel_centre_px=0.5)
        points = cv2.undistortPoints(
            points_px.reshape(-1, 1, 2).astype(np.float64), matrix, np.array(self.distortion), P=matrix
        )
        return points.reshape(points_px.shape)

    def _intrinsic_matrix(self, scale: float, first_pixel_centre_px: float) -> Float[np.ndarray, "3 3"]:
        """K for a picture of this scale whose first pixel's centre has the coordinate `first_pixel_centre_px` (OpenCV
        warps: 0).
        """
        shift = first_pixel_centre_px - 0.5
        fx, fy = self.fx * scale, self.fy * scale
        return np.array([[fx, 0.0, self.cx * scale + shift], [0.0, fy, self.cy * scale + shift], [0.0, 0.0, 1.0]])


@dataclass(frozen=True)
class UserLandmarks:
    """Landmarks for every frame of the recording, in pixels of the original frames; nan where unknown.

    landmarks_world_m: None where the file does not give them.
    """

    landmarks_px: Float[np.ndarray, "n 33 2"]
    visibility: Float[np.ndarray, "n 33"]
    landmarks_world_m: Float[np.ndarray, "n 33 3"] | None


@dataclass(frozen=True)
class UserSplit:
    """The frames to use, in increasing order, with their split (as `Capture.split`)."""

    frame_index: Int[np.ndarray, "m"]
    split: UInt8[np.ndarray, "m"]

    def for_frames(self, frame_index: Int[np.ndarray, "n"]) -> UInt8[np.ndarray, "n"]:
        """Return the split of these frames; all of them must be listed."""
        return self.split[np.searchsorted(self.frame_index, frame_index)]


@dataclass(frozen=True)
class UserFiles:
    """The inputs that were found; None for the others."""

    read_mask: MaskReader | None
    mask_source: str
    landmarks: UserLandmarks | None
    camera: CameraCalibration | None
    split: UserSplit | None = None
    smpl_poses: SmplPoses | None = None

    @property
    def masks_are_own_alpha(self) -> bool:
        """Whether the masks are the images' own alpha, with which their colours are usually straight."""
        return self.mask_source == _OWN_ALPHA


def load_user_files(path: Path, source: FrameSource) -> UserFiles:
    """Read the user-supplied inputs in the video folder; a video file has none.

    Raises:
        UserError: a file does not fit the recording.
    """
    if not path.is_dir():
        return UserFiles(None, "", None, None)
    read_mask, mask_source = _find_masks(path, source)
    landmarks_path, camera_path, split_path, poses_path = (
        path / name for name in ("landmarks.npz", "camera.json", "split.json", SMPL_POSES_NPZ)
    )
    return UserFiles(
        read_mask,
        mask_source,
        _read_landmarks(landmarks_path, source) if landmarks_path.is_file() else None,
        _read_camera(camera_path, source) if camera_path.is_file() else None,
        _read_split(split_path, source) if split_path.is_file() else None,
        _read_smpl_poses(poses_path, source) if poses_path.is_file() else None,
    )


def _find_masks(path: Path, source: FrameSource) -> tuple[MaskReader | None, str]:
    if (path / "masks").is_dir():
        return masks_from_folder(path / "masks", source), "masks/"
    if (path / "masks.npz").is_file():
        arrays = load_npz(path / "masks.npz")
        if "masks" not in arrays:
            raise UserError(f"{path / 'masks.npz'} has no array `masks`; store it as (frames, height, width)")
        return _masks_from_array(arrays["masks"], path / "masks.npz", source), "masks.npz"
    if (path / "masks.hdf5").is_file():
        return _masks_from_array(_read_hdf5_masks(path / "masks.hdf5"), path / "masks.hdf5", source), "masks.hdf5"
    if source.files and (read_mask := _masks_from_alpha(path, source.files)) is not None:
        return read_mask, _OWN_ALPHA
    return None, ""


def _masks_from_alpha(path: Path, files: Sequence[Path]) -> MaskReader | None:
    """Return None where no sampled image has transparency."""
    sampled = {k: read_alpha(files[k]) for k in _sampled(len(files))}
    opaque = [k for k, alpha in sampled.items() if alpha.min() == 255]
    if len(opaque) == len(sampled):
        return None
    if opaque:
        other = next(k for k in sampled if k not in opaque)
        raise UserError(
            f"image {files[opaque[0]]} has no transparency, {files[other].name} has; make the background of all images "
            "transparent, or of none"
        )
    _check_masks(f"the alpha channel of the images in {path}", list(sampled.values()))
    return lambda index: read_alpha(files[index])


def _sampled(n_masks: int) -> list[int]:
    return sorted({int(k) for k in np.linspace(0, n_masks - 1, _N_MASKS_SAMPLED)})


def _check_masks(name: str, sampled: Sequence[np.ndarray], *, person_is_dark: bool = False) -> float:
    """Return the largest level of the sampled masks. Raise UserError where they are empty or inverted."""
    highest = max(float(mask.max()) for mask in sampled)
    shade, masks = ("black", [highest - mask for mask in sampled]) if person_is_dark else ("white", sampled)
    if max(float(mask.max()) for mask in masks) <= 0:
        raise UserError(f"{name}: all {len(masks)} masks looked at are empty; masks are {shade} where the person is")
    n_inverted = sum(bool((mask[[0, 0, -1, -1], [0, -1, 0, -1]] > highest / 2).all()) for mask in masks)
    if 2 * n_inverted >= len(masks):
        raise UserError(
            f"{name}: {n_inverted} of {len(masks)} masks looked at are {shade} in all four corners, masks are {shade} "
            "where the person is; invert them"
        )
    return highest


def masks_from_folder(folder: Path, source: FrameSource, *, person_is_dark: bool = False) -> MaskReader:
    """Return a reader of the masks in a folder of images; see `match_masks` and `scale_masks`. Cut-outs: their alpha.

    Raises:
        UserError: as `match_masks` and `scale_masks`, or some of the images are transparent and others are not.
    """
    files = match_masks(images_in(folder), folder, source)
    if (read_mask := _masks_from_alpha(folder, files)) is not None:
        return read_mask
    return scale_masks(
        lambda index: read_gray_uint16(files[index]), len(files), f"{folder}/", person_is_dark=person_is_dark
    )


def match_masks(files: Sequence[Path], folder: Path, source: FrameSource) -> Sequence[Path]:
    """Return the file of each frame: that with the name of its image, or all `files` in their order if none has one.

    Raises:
        UserError: some images have a file of their name and others have none, or the numbers differ.
    """
    by_stem = {p.stem: p for p in files}
    names = [image.stem for image in source.files]
    if any(name in by_stem for name in names):
        if missing := next((name for name in names if name not in by_stem), None):
            raise UserError(
                f"{folder} has masks with the names of images, but none for {missing}; add it, or rename all masks to "
                "numbers"
            )
        files = [by_stem[name] for name in names]
    _check_frame_count(folder, len(files), source)
    return files


def scale_masks(
    read_levels: Callable[[int], Shaped[np.ndarray, "h w"]], count: int, name: str, *, person_is_dark: bool = False
) -> MaskReader:
    """Return a reader of masks with one scale: the largest level of some of them becomes 255.

    read_levels: returns one of `count` masks of numbers or truth values. name: of all masks, for messages.
    person_is_dark: masks are 0 where the person is, and have their largest level elsewhere.

    Raises:
        UserError: the masks are empty or inverted.
    """
    sampled = [read_levels(k) for k in _sampled(count)]
    highest = _check_masks(name, sampled, person_is_dark=person_is_dark)
    if person_is_dark:
        return lambda index: 255 - _to_255(read_levels(index), highest)
    return lambda index: _to_255(read_levels(index), highest)


def _masks_from_array(masks: np.ndarray, path: Path, source: FrameSource) -> MaskReader:
    if masks.ndim != 3 or masks.size == 0:
        raise UserError(f"{path}: the masks have shape {masks.shape}; store them as (frames, height, width)")
    _check_frame_count(path, len(masks), source)
    _check_masks(str(path), [masks[k] for k in _sampled(len(masks))])
    highest = float(masks.max())
    return lambda index: _to_255(masks[index], highest)


def _to_255(mask: np.ndarray, highest: float) -> UInt8[np.ndarray, "h w"]:
    """Return a mask whose level `highest` becomes 255, as do those above it; those below 0 become 0."""
    return np.rint(np.clip(mask.astype(np.float32) * 255.0 / highest, 0.0, 255.0)).astype(np.uint8)


def _read_hdf5_masks(path: Path) -> np.ndarray:
    from pipeline.io.hdf5 import read_dataset, read_whole  # here, because no other input needs h5py

    return read_dataset(path, "masks", read_whole)


def _read_landmarks(path: Path, source: FrameSource) -> UserLandmarks:
    arrays = load_npz(path)
    points = arrays.get("landmarks_px")
    if points is None or points.ndim != 3 or points.shape[1:] != (N_LANDMARKS, 2):
        shape = None if points is None else points.shape
        raise UserError(f"{path}: `landmarks_px` must have shape (frames, {N_LANDMARKS}, 2), found {shape}")
    _check_frame_count(path, len(points), source)
    visibility = arrays.get("landmarks_visibility", np.isfinite(points).all(-1))
    world = arrays.get("landmarks_world_m")
    if visibility.shape != points.shape[:2] or (world is not None and world.shape != (*points.shape[:2], 3)):
        raise UserError(
            f"{path}: `landmarks_visibility` or `landmarks_world_m` does not fit `landmarks_px`; correct its shape"
        )
    if (outside := ((visibility < 0) | (visibility > 1)).any(axis=1)).any():
        raise UserError(f"{path}: `landmarks_visibility` of frame {outside.argmax()} is outside [0, 1]; scale it")
    return UserLandmarks(
        points.astype(np.float32),
        visibility.astype(np.float32),
        None if world is None else world.astype(np.float32),
    )


def _read_camera(path: Path, source: FrameSource) -> CameraCalibration:
    try:
        values = load_json(path)
        fx, fy, cx, cy = (float(values[key]) for key in ("fx", "fy", "cx", "cy"))
        size_px = (int(values["width"]), int(values["height"])) if {"width", "height"} & set(values) else None
        distortion = tuple(float(value) for value in values.get("distortion") or ())
        pose = values.get("world_to_camera")
        world_to_camera = None if pose is None else np.array(pose, dtype=np.float32).reshape(4, 4)
    except (ValueError, KeyError, TypeError, AttributeError, OverflowError) as error:
        raise UserError(f"{path} is not a camera ({error}); it needs numbers fx, fy, cx, cy in pixels") from None
    if min(fx, fy) <= 0 or not np.isfinite([fx, fy, cx, cy, *distortion]).all():
        raise UserError(
            f"{path}: fx and fy must be above 0 pixels and all numbers finite, found fx {fx}, fy {fy}, cx {cx}, "
            f"cy {cy}, distortion {list(distortion)}; correct them"
        )
    if len(distortion) not in (0, 4, 5, 8):
        raise UserError(f"{path}: distortion needs 4, 5 or 8 numbers (k1 k2 p1 p2 ...), found {len(distortion)}")
    if world_to_camera is not None and not is_rigid(world_to_camera):
        raise UserError(
            f"{path}: `world_to_camera` must be a rotation and a translation in metres, with 0 0 0 1 in its last row; "
            "divide its scale out, or remove it"
        )
    _check_image_size(path, cx, cy, size_px, source)
    return CameraCalibration(fx, fy, cx, cy, distortion, world_to_camera)


def _check_image_size(path: Path, cx: float, cy: float, size_px: tuple[int, int] | None, source: FrameSource) -> None:
    """Raise UserError for a calibration of images of another size, which would bias the fit without any other sign."""
    width, height = image_size_px(source)
    if size_px is not None and size_px != (width, height):
        raise UserError(
            f"{path} is for images of {size_px[0]}x{size_px[1]}, those of {source.path} are {width}x{height}; "
            "supply the camera of these images, or the original images"
        )
    if size_px is None and max(abs(cx / width - 0.5), abs(cy / height - 0.5)) > _MAX_PRINCIPAL_POINT_OFFSET:
        raise UserError(
            f"{path}: cx {cx:g}, cy {cy:g} are far from the centre of the images of {source.path}, which are "
            f"{width}x{height}; supply the camera of these images, or, for cropped images, confirm it with "
            f'"width": {width}, "height": {height} in that file'
        )


def _read_split(path: Path, source: FrameSource) -> UserSplit:
    try:
        values = load_json(path)
        lists = {name: [operator.index(value) for value in indices] for name, indices in values.items()}
    except (ValueError, TypeError, AttributeError) as error:
        raise UserError(
            f"{path} is not a split ({error}); it needs lists of frame indices, train and heldout"
        ) from None
    if unknown := set(lists) - set(_SPLITS):
        raise UserError(f"{path}: unknown list {sorted(unknown)[0]}; there are {', '.join(_SPLITS)}")
    if "validation" not in lists:
        train = sorted(lists.get("train", []))
        lists["validation"] = train[VALIDATION_PHASE::SPLIT_PERIOD]
        lists["train"] = sorted(set(train) - set(lists["validation"]))
    for name in _SPLITS:
        if not lists.get(name):
            raise UserError(f"{path} lists no frame for {name}; list some for each, and at least 5 training frames")
    indices = np.concatenate([lists[name] for name in _SPLITS])
    if len(np.unique(indices)) != len(indices):
        raise UserError(f"{path} lists a frame twice; remove one of them")
    if indices.min() < 0 or indices.max() >= source.n_frames:
        raise UserError(f"{path} lists frames up to {indices.max()}, {source.path} has 0 to {source.n_frames - 1}")
    kinds = np.concatenate([np.full(len(lists[name]), kind, np.uint8) for name, kind in _SPLITS.items()])
    order = np.argsort(indices)
    return UserSplit(indices[order], kinds[order])


def _read_smpl_poses(path: Path, source: FrameSource) -> SmplPoses:
    poses = load_smpl_poses(path)
    if len(poses.frame_index) and not 0 <= poses.frame_index[0] <= poses.frame_index[-1] < source.n_frames:
        raise UserError(
            f"{path} has poses of frames {poses.frame_index[0]} to {poses.frame_index[-1]}, {source.path} has 0 to "
            f"{source.n_frames - 1}; supply the recording of these poses"
        )
    return poses


def _check_frame_count(path: Path, count: int, source: FrameSource) -> None:
    """Raise UserError for too few entries, and for too many: their frames are unknown."""
    if count != source.n_frames:
        raise UserError(
            f"{path} has {count} entries for {source.n_frames} frames of {source.path}; "
            "supply one for each frame, or remove it to use the detector"
        )
