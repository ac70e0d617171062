"""What every reader hands over, and the folder that is written from it.

    TARGET/images/ or one video    the pictures, as they are
    TARGET/masks/                  one image a frame, the person bright
    TARGET/camera.json             intrinsics without a pose: the pipeline's world is the camera's
    TARGET/split.json              which frames are used and what for
    TARGET/smpl_poses.npz          see `pipeline.capture.smpl_poses`
    TARGET/...                     what the source has in this form already

`pipeline.capture.user_files` says how the frames stage reads them.
"""

import json
import shutil
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from jaxtyping import Shaped, UInt8

from data_tools.folder import atomic_folder
from pipeline.capture.smpl_poses import SMPL_POSES_NPZ, SmplPoses, save_smpl_poses
from pipeline.capture.user_files import CameraCalibration
from pipeline.capture.video import FrameSource, image_size_px, natural_sort_key
from pipeline.core.errors import UserError
from pipeline.core.progress import track
from pipeline.io.image import IMAGE_SUFFIXES, read_gray, write_gray
from pipeline.io.safe_pickle import load_npy


@dataclass(frozen=True)
class Recording:
    """A recording with what lies beside it; None for what does not.

    read_mask: the mask of a frame by its index, uint8 [0, 255]. split: lists of frame indices, as in `split.json`.
    ready: files that have the form of the target already.
    """

    source: FrameSource
    read_mask: Callable[[int], UInt8[np.ndarray, "h w"]] | None = None
    camera: CameraCalibration | None = None
    split: Mapping[str, Sequence[int]] | None = None
    poses: SmplPoses | None = None
    files_to_copy: tuple[Path, ...] = ()

    def summary(self) -> str:
        """What there is, in a few words."""
        words = [f"{self.source.n_frames} frames"]
        words += ["masks"] * (self.read_mask is not None) + ["camera"] * (self.camera is not None)
        if self.split is not None:
            words.append("split (" + ", ".join(f"{len(index)} {name}" for name, index in self.split.items()) + ")")
        if self.poses is not None:
            words.append(f"SMPL poses of {len(self.poses.frame_index)} frames")
        words += [file.name for file in self.files_to_copy]
        return ", ".join(words)


def write_recording(recording: Recording, target: Path) -> None:
    """Write the folder, whole or not at all.

    Raises:
        UserError: `target` exists, or something in the source cannot be read.
    """
    source, poses = recording.source, recording.poses
    if poses is not None and len(poses.frame_index) and poses.frame_index[-1] >= source.n_frames:
        raise UserError(
            f"{source.path} has {source.n_frames} frames, its SMPL poses go to frame {poses.frame_index[-1]}; "
            "give the pictures that belong to them"
        )
    with atomic_folder(target) as part:
        _copy_images(source, part)
        if recording.read_mask is not None:
            (part / "masks").mkdir()
            for index in track(range(source.n_frames), "writing masks"):
                stem = source.files[index].stem if source.files else f"{index:06d}"
                write_gray(part / "masks" / f"{stem}.png", recording.read_mask(index))
        if recording.camera is not None:
            _write_json(part / "camera.json", _camera_values(recording.camera))
        if recording.split is not None:
            _write_json(part / "split.json", {name: [int(k) for k in index] for name, index in recording.split.items()})
        if poses is not None:
            save_smpl_poses(part / SMPL_POSES_NPZ, poses)
        for file in recording.files_to_copy:
            shutil.copyfile(file, part / file.name)


def mask_folder_reader(folder: Path, source: FrameSource) -> Callable[[int], UInt8[np.ndarray, "h w"]]:
    """Reads the masks of a folder, images or `.npy`: those named as the pictures are, or else all in natural order.

    Raises:
        UserError: there is not one for each picture.
    """
    found = (path for path in folder.iterdir() if path.suffix.lower() in (".npy", *IMAGE_SUFFIXES))
    files = sorted(found, key=natural_sort_key)
    by_stem = {path.stem: path for path in files}
    if source.files and all(image.stem in by_stem for image in source.files):
        files = [by_stem[image.stem] for image in source.files]
    if len(files) != source.n_frames:
        raise UserError(f"{folder} has {len(files)} masks for {source.n_frames} pictures; give one for each")

    def read(index: int) -> UInt8[np.ndarray, "h w"]:
        path = files[index]
        return mask_to_uint8(load_npy(path) if path.suffix == ".npy" else read_gray(path), path)

    return read


def mask_to_uint8(mask: Shaped[np.ndarray, "..."], path: Path) -> UInt8[np.ndarray, "h w"]:
    """A stored mask as uint8 [0, 255]: what never rises above 1 is a share, everything else is levels already.

    Raises:
        UserError: the mask is no single picture of numbers.
    """
    if mask.ndim != 2 or not np.issubdtype(mask.dtype, np.number) and mask.dtype != bool:
        raise UserError(f"{path}: a mask has shape {mask.shape} and type {mask.dtype}; store (height, width) numbers")
    values = mask.astype(np.float32)
    return np.clip(np.rint(values * (255.0 if values.max(initial=0.0) <= 1.0 else 1.0)), 0, 255).astype(np.uint8)


def require_image_size(source: FrameSource, width_px: int, height_px: int, path: Path) -> None:
    """Raise UserError when the pictures are not of the size that the camera in `path` was calibrated for."""
    width, height = image_size_px(source)
    if (width, height) != (width_px, height_px):
        raise UserError(
            f"{path} is for pictures of {width_px}x{height_px}, those of {source.path} are {width}x{height}; "
            "give the original pictures"
        )


def _copy_images(source: FrameSource, folder: Path) -> None:
    """Contents only: the copies must be writable and new, whatever the originals are."""
    if not source.files:
        shutil.copyfile(source.path, folder / source.path.name)
        return
    (folder / "images").mkdir()
    for file in track(source.files, "copying images"):
        shutil.copyfile(file, folder / "images" / file.name)


def _camera_values(camera: CameraCalibration) -> dict[str, object]:
    values: dict[str, object] = {"fx": camera.fx, "fy": camera.fy, "cx": camera.cx, "cy": camera.cy}
    return values | ({"distortion": list(camera.distortion)} if any(camera.distortion) else {})


def _write_json(path: Path, values: Mapping[str, object]) -> None:
    path.write_text(json.dumps(values) + "\n", encoding="utf-8")
