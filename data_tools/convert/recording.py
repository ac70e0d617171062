"""The recording that each format reader returns, and the video folder that is written from it.

    TARGET/images/ or one video    unchanged copies of the images
    TARGET/masks/                  one image per frame, the person bright
    TARGET/camera.json             intrinsics; there is no pose, because the world is the camera frame
    TARGET/split.json              training, validation and held-out frames
    TARGET/smpl_poses.npz          see `pipeline.capture.smpl_poses`
    TARGET/...                     files that the source already has in this format

`pipeline.capture.user_files` documents how the frames stage reads them.
"""

import json
import shutil
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from jaxtyping import Shaped

from data_tools.folder import atomic_folder
from pipeline.capture.smpl_poses import SMPL_POSES_NPZ, SmplPoses, save_smpl_poses
from pipeline.capture.user_files import CameraCalibration, MaskReader, masks_from_folder, match_masks, scale_masks
from pipeline.capture.video import FrameSource, image_size_px, natural_sort_key
from pipeline.core.errors import UserError
from pipeline.core.progress import track
from pipeline.io.image import write_gray
from pipeline.io.safe_pickle import load_npy


@dataclass(frozen=True)
class Recording:
    """Images and their annotations; None for an annotation that does not exist.

    Attributes:
        read_mask: returns the mask of a frame index, 0 to 255.
        split: lists of frame indices, as in `split.json`.
        files_to_copy: files that already have the format of the target.
    """

    source: FrameSource
    read_mask: MaskReader | None = None
    camera: CameraCalibration | None = None
    split: Mapping[str, Sequence[int]] | None = None
    poses: SmplPoses | None = None
    files_to_copy: tuple[Path, ...] = ()

    def summary(self) -> str:
        """Return a one-line description."""
        parts = [f"{self.source.n_frames} frames"]
        parts += ["masks"] * (self.read_mask is not None) + ["camera"] * (self.camera is not None)
        if self.split is not None:
            parts.append("split (" + ", ".join(f"{len(index)} {name}" for name, index in self.split.items()) + ")")
        if self.poses is not None:
            parts.append(f"SMPL poses of {len(self.poses.frame_index)} frames")
        parts += [file.name for file in self.files_to_copy]
        return ", ".join(parts)


def write_recording(recording: Recording, target: Path) -> None:
    """Write the video folder atomically.

    Raises:
        UserError: `target` exists, or a file of the source cannot be read.
    """
    source, poses = recording.source, recording.poses
    if poses is not None and len(poses.frame_index) and poses.frame_index[-1] >= source.n_frames:
        raise UserError(
            f"{source.path} has {source.n_frames} frames, but its SMPL poses extend to frame {poses.frame_index[-1]}; "
            "supply the matching images"
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


def mask_folder_reader(folder: Path, source: FrameSource, *, person_is_dark: bool = False) -> MaskReader:
    """Return a reader of the masks in a folder: of its `.npy` files, or else of its images, as the frames stage does.

    person_is_dark: masks are 0 where the person is.

    Raises:
        UserError: the masks do not fit the images, are empty or inverted, or an array is no mask.
    """
    visible = (path for path in folder.iterdir() if not path.name.startswith("."))
    arrays = sorted((path for path in visible if path.suffix.lower() == ".npy"), key=natural_sort_key)
    if not arrays:
        return masks_from_folder(folder, source, person_is_dark=person_is_dark)
    files = match_masks(arrays, folder, source)
    return scale_masks(
        lambda index: require_mask(load_npy(files[index]), files[index]),
        len(files),
        f"{folder}/",
        person_is_dark=person_is_dark,
    )


def require_mask(mask: Shaped[np.ndarray, "..."], path: Path) -> Shaped[np.ndarray, "h w"]:
    """Return the mask unchanged. UserError if it is no (height, width) array of numbers or truth values."""
    if mask.ndim != 2 or not mask.size or not np.issubdtype(mask.dtype, np.number) and mask.dtype != bool:
        raise UserError(f"{path}: a mask has shape {mask.shape} and type {mask.dtype}; store (height, width) numbers")
    return mask


def require_image_size(source: FrameSource, width_px: int, height_px: int, path: Path) -> None:
    """Raise UserError if the images do not have the size for which the camera in `path` was calibrated."""
    width, height = image_size_px(source)
    if (width, height) != (width_px, height_px):
        raise UserError(
            f"{path} is calibrated for images of {width_px}x{height_px}, but those of {source.path} are "
            f"{width}x{height}; supply the original images"
        )


def _copy_images(source: FrameSource, folder: Path) -> None:
    """Copy contents without permissions and times, so that the copies are writable."""
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
