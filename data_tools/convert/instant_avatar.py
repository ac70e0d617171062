"""Read a folder of one subject as prepared by InstantAvatar's scripts (Jiang et al., CVPR 2023).

    images/                   undistorted images
    masks/                    one mask per image, .npy (0 and 1) or .png
    cameras.npz               intrinsic (3, 3), extrinsic (4, 4) world to camera, height, width
    poses/anim_nerf_train.npz, anim_nerf_test.npz
                              SMPL poses of the frames of each split (some subjects): global_orient, body_pose, transl
                              per frame, betas once
    poses_optimized.npz, poses.npz
                              poses of all frames: thetas (n, 72) or global_orient and body_pose, transl, betas

Masks and poses are optional. The frames of each split are defined in InstantAvatar's configuration, not in the folder;
see `protocol.py`. InstantAvatar casts rays through integer pixel coordinates; here the camera is interpreted as in
`people_snapshot.py`, its origin.
"""

from collections.abc import Mapping, Sequence
from pathlib import Path

import numpy as np
from jaxtyping import Float, Shaped

from data_tools.convert.protocol import published_split
from data_tools.convert.recording import Recording, mask_folder_reader, require_image_size
from data_tools.convert.smpl_arrays import gender_from_name, merge_smpl_poses, smpl_poses_from_arrays
from pipeline.capture.smpl_poses import SmplPoses
from pipeline.capture.user_files import CameraCalibration
from pipeline.capture.video import FrameSource, open_frame_source
from pipeline.core.errors import UserError
from pipeline.core.progress import warn
from pipeline.io.npz import load_npz

_CAMERA = "cameras.npz"
_POSES_BY_SPLIT = {"train": "poses/anim_nerf_train.npz", "heldout": "poses/anim_nerf_test.npz"}
_POSES_OF_ALL_FRAMES = ("poses_optimized.npz", "poses.npz")


def is_instant_avatar(folder: Path) -> bool:
    """Return whether the folder has the camera file and the image folder of this format."""
    return (folder / _CAMERA).is_file() and (folder / "images").is_dir()


def read_instant_avatar(folder: Path) -> Recording:
    """Read the folder of one subject; images and masks are read on demand.

    Raises:
        UserError: an existing file cannot be read, or does not match the images.
    """
    source = open_frame_source(folder)
    camera, world_to_camera = _read_camera(folder / _CAMERA, source)
    subject = folder.resolve().name
    split = published_split(subject, source)
    return Recording(
        source=source,
        read_mask=mask_folder_reader(folder / "masks", source) if (folder / "masks").is_dir() else None,
        camera=camera,
        split=split,
        poses=_read_poses(folder, split, source.n_frames, world_to_camera, gender_from_name(subject)),
    )


def _read_camera(path: Path, source: FrameSource) -> tuple[CameraCalibration, Float[np.ndarray, "4 4"]]:
    arrays = load_npz(path)
    for name, shape in (("intrinsic", (3, 3)), ("extrinsic", (4, 4)), ("height", ()), ("width", ())):
        found = arrays[name].shape if name in arrays else None
        if found != shape:
            raise UserError(f"{path}: `{name}` must have shape {shape}, found {found}; supply a valid cameras.npz")
    require_image_size(source, int(arrays["width"]), int(arrays["height"]), path)
    matrix = arrays["intrinsic"].astype(np.float64)
    camera = CameraCalibration(float(matrix[0, 0]), float(matrix[1, 1]), float(matrix[0, 2]), float(matrix[1, 2]))
    return camera, arrays["extrinsic"].astype(np.float64)


def _read_poses(
    folder: Path,
    split: Mapping[str, Sequence[int]] | None,
    n_frames: int,
    world_to_camera: Float[np.ndarray, "4 4"],
    gender: str,
) -> SmplPoses | None:
    """Return the poses of the two splits if their frames are known, else those of all frames."""

    def rows(name: str, frame_index: Sequence[int]) -> SmplPoses:
        arrays: dict[str, Shaped[np.ndarray, "..."]] = load_npz(folder / name)
        return smpl_poses_from_arrays(arrays, np.array(frame_index), world_to_camera, gender, folder / name)

    files_by_split = {name: file for name, file in _POSES_BY_SPLIT.items() if (folder / file).is_file()}
    if files_by_split and split is not None:
        return merge_smpl_poses([rows(file, split[name]) for name, file in files_by_split.items()])
    if files_by_split:
        warn(f"the frames of {folder / 'poses'} are unknown: these poses are ignored")
    return next((rows(name, range(n_frames)) for name in _POSES_OF_ALL_FRAMES if (folder / name).is_file()), None)
