"""User-supplied SMPL poses of a recording, in one layout for all sources.

The body stage uses them together with an SMPL model file.

`smpl_poses.npz` in the video folder has one row for each of n frames (not necessarily all frames of the recording):

    frame_index     (n,) index of the frame in the recording, increasing
    global_orient   (n, 3) axis-angle of the root, radians
    body_pose       (n, 69) axis-angle of SMPL's 23 other joints in SMPL's order, radians
    transl          (n, 3) added to SMPL's vertices, metres
    betas           (n, 10) shape, as the source has it for each frame
    smpl_to_camera  (n, 4, 4) from the space of SMPL's output (with `transl`) to the camera's axes (x right, y down,
                    z forward), metres, column vectors
    gender          male, female, neutral or unknown: the SMPL model of these parameters
"""

from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from jaxtyping import Float, Int

from pipeline.core.errors import UserError
from pipeline.io.npz import load_npz, save_npz

SMPL_POSES_NPZ = "smpl_poses.npz"
N_BODY_POSE, N_BETAS = 69, 10
RIGID_TOLERANCE = 1e-3
"""Maximum deviation of a user-supplied rotation matrix from orthonormality."""

GENDERS = ("male", "female", "neutral", "unknown")
_ROW_SHAPES = {
    "frame_index": (),
    "global_orient": (3,),
    "body_pose": (N_BODY_POSE,),
    "transl": (3,),
    "betas": (N_BETAS,),
    "smpl_to_camera": (4, 4),
}


@dataclass(frozen=True)
class SmplPoses:
    """Content of the file; see the module."""

    frame_index: Int[np.ndarray, "n"]
    global_orient: Float[np.ndarray, "n 3"]
    body_pose: Float[np.ndarray, "n 69"]
    transl: Float[np.ndarray, "n 3"]
    betas: Float[np.ndarray, "n 10"]
    smpl_to_camera: Float[np.ndarray, "n 4 4"]
    gender: str

    def for_frames(self, frame_index: Int[np.ndarray, "m"]) -> "SmplPoses":
        """Return the rows of these frames; frames without a row are skipped."""
        rows = np.flatnonzero(np.isin(self.frame_index, frame_index))
        return replace(self, **{name: getattr(self, name)[rows] for name in _ROW_SHAPES})


def is_rigid(transforms: Float[np.ndarray, "*n 4 4"]) -> bool:
    """Return whether all matrices are rotations with translation: finite, no scale, no mirror, last row 0 0 0 1."""
    rotation = transforms[..., :3, :3]
    return bool(
        np.isfinite(transforms).all()
        and (np.abs(rotation @ np.swapaxes(rotation, -1, -2) - np.eye(3)) <= RIGID_TOLERANCE).all()
        and (np.linalg.det(rotation) > 0).all()
        and (np.abs(transforms[..., 3, :] - np.eye(4)[3]) <= RIGID_TOLERANCE).all()
    )


def save_smpl_poses(path: Path, poses: SmplPoses) -> None:
    """Write the poses; inverse of `load_smpl_poses`."""
    arrays = {name: getattr(poses, name).astype(np.float32) for name in _ROW_SHAPES}
    arrays["frame_index"] = poses.frame_index.astype(np.int32)
    save_npz(path, {**arrays, "gender": np.array(poses.gender)})


def load_smpl_poses(path: Path) -> SmplPoses:
    """Read a file of `save_smpl_poses`, or of a user who follows the description of the module.

    Raises:
        UserError: the file cannot be read; an array is missing, has another shape or is not finite; frame indices do
            not increase; or `smpl_to_camera` is not rigid.
    """
    arrays = load_npz(path)
    n = len(np.atleast_1d(arrays.get("frame_index", np.zeros(0))))
    for name, shape in _ROW_SHAPES.items():
        found = arrays[name].shape if name in arrays else None
        if found != (n, *shape):
            raise UserError(f"{path}: `{name}` must have shape {(n, *shape)}, found {found}; change its shape")
    if (np.diff(arrays["frame_index"]) <= 0).any():
        raise UserError(f"{path}: `frame_index` does not increase; sort the rows, one per frame")
    gender = str(arrays["gender"].item()) if "gender" in arrays else "unknown"
    if gender not in GENDERS:
        raise UserError(f"{path}: gender is {gender}; write one of {', '.join(GENDERS)}")
    floats = {name: arrays[name].astype(np.float32) for name in _ROW_SHAPES if name != "frame_index"}
    if broken := next((name for name, values in floats.items() if not np.isfinite(values).all()), None):
        raise UserError(f"{path}: `{broken}` holds a value that is not finite; leave out frames without a pose")
    if not is_rigid(floats["smpl_to_camera"]):
        raise UserError(f"{path}: `smpl_to_camera` must be a rotation with translation; divide its scale out")
    return SmplPoses(frame_index=arrays["frame_index"].astype(np.int32), **floats, gender=gender)
