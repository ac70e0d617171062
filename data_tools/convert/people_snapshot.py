"""Read the folder of one subject of PeopleSnapshot (Alldieck et al., CVPR 2018) as distributed.

    SUBJECT.mp4               video
    camera.pkl                camera_f, camera_c (pixels), camera_k (OpenCV's five), camera_rt (axis-angle), camera_t,
                              width, height
    masks.hdf5                `masks` (n, h, w), 0 and 1
    reconstructed_poses.hdf5  `pose` (n, 72), `trans` (n, 3), `betas` (10,)
    keypoints.hdf5            18 OpenPose joints per frame; not used, the body fit needs 33 BlazePose landmarks

Only the video is required. The principal point is used unchanged: it is half of the image size, which is the image
centre for pixel centres at +0.5.
"""

from pathlib import Path

import cv2
import numpy as np
from jaxtyping import Float, Shaped

from data_tools.convert.protocol import published_split
from data_tools.convert.recording import Recording, require_image_size, require_mask
from data_tools.convert.smpl_arrays import gender_from_name, smpl_poses_from_arrays
from pipeline.capture.smpl_poses import SmplPoses
from pipeline.capture.user_files import CameraCalibration, MaskReader, scale_masks
from pipeline.capture.video import FrameSource, open_frame_source
from pipeline.core.errors import UserError
from pipeline.io.hdf5 import read_dataset, read_whole
from pipeline.io.safe_pickle import load_pickle

_CAMERA, _MASKS, _POSES = "camera.pkl", "masks.hdf5", "reconstructed_poses.hdf5"
_CAMERA_SIZES = {"camera_f": 2, "camera_c": 2, "camera_k": 5, "camera_rt": 3, "camera_t": 3, "width": 1, "height": 1}


def is_people_snapshot(folder: Path) -> bool:
    """Return whether the folder has a file that is specific to this format."""
    return any((folder / name).is_file() for name in (_CAMERA, _MASKS, _POSES))


def read_people_snapshot(folder: Path) -> Recording:
    """Read the folder of one subject; images and masks are read on demand.

    Raises:
        UserError: an existing file cannot be read, or does not match the video.
    """
    source = open_frame_source(folder)
    subject, camera, poses, world_to_camera = folder.resolve().name, None, None, np.eye(4)
    if (folder / _CAMERA).is_file():
        camera, world_to_camera = _read_camera(folder / _CAMERA, source)
    if (folder / _POSES).is_file():
        poses = _read_poses(folder / _POSES, world_to_camera, gender_from_name(subject))
    return Recording(
        source=source,
        read_mask=_mask_reader(folder / _MASKS, source) if (folder / _MASKS).is_file() else None,
        camera=camera,
        split=published_split(subject, source),
        poses=poses,
    )


def _read_camera(path: Path, source: FrameSource) -> tuple[CameraCalibration, Float[np.ndarray, "4 4"]]:
    """Return intrinsics with distortion, and world_to_camera."""
    stored = load_pickle(path)
    values = {}
    for name, size in _CAMERA_SIZES.items():
        value = stored.get(name) if isinstance(stored, dict) else None
        # Lists are not accepted: nested ones that share their parts have more numbers than fit into memory.
        number = np.asarray(value if isinstance(value, np.ndarray | np.number | int | float) else None)
        if number.size != size or number.dtype.kind not in "iuf" or not np.isfinite(number).all():
            raise UserError(f"{path} has no `{name}` of {size} numbers; supply the camera.pkl of PeopleSnapshot")
        values[name] = number.astype(np.float64).reshape(-1)
    require_image_size(source, int(values["width"][0]), int(values["height"][0]), path)
    world_to_camera = np.eye(4)
    world_to_camera[:3, :3] = cv2.Rodrigues(values["camera_rt"])[0]
    world_to_camera[:3, 3] = values["camera_t"]
    (fx, fy), (cx, cy), distortion = (values[f"camera_{letter}"].tolist() for letter in "fck")
    return CameraCalibration(fx, fy, cx, cy, tuple(distortion)), world_to_camera


def _mask_reader(path: Path, source: FrameSource) -> MaskReader:
    """Return a function that reads one mask; all masks together would not fit into memory."""
    shape = read_dataset(path, "masks", lambda masks: masks.shape)
    if len(shape) != 3 or shape[0] < source.n_frames:
        raise UserError(
            f"{path}: `masks` has shape {shape} for the {source.n_frames} frames of {source.path}; "
            "supply (frames, height, width) masks of this video"
        )

    def read_levels(index: int) -> Shaped[np.ndarray, "h w"]:
        return require_mask(read_dataset(path, "masks", lambda masks: masks[index]), path)

    return scale_masks(read_levels, source.n_frames, str(path))


def _read_poses(path: Path, world_to_camera: Float[np.ndarray, "4 4"], gender: str) -> SmplPoses:
    arrays = {name: read_dataset(path, name, read_whole) for name in ("pose", "trans", "betas")}
    return smpl_poses_from_arrays(arrays, np.arange(len(arrays["pose"])), world_to_camera, gender, path)
