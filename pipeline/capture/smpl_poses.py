"""SMPL poses that others have fitted to a recording: one layout for whatever file they came in.

The body stage takes them when it gets an SMPL model file.

`smpl_poses.npz` beside the video, one row for each of n frames (not necessarily all frames of the recording):

    frame_index     (n,) index of the frame in the recording, rising
    global_orient   (n, 3) axis-angle of the root, radians
    body_pose       (n, 69) axis-angle of SMPL's 23 other joints in SMPL's order, radians
    transl          (n, 3) added to SMPL's vertices, metres
    betas           (n, 10) shape, as the source gives it for each frame
    smpl_to_camera  (n, 4, 4) from the space of SMPL's output (with `transl`) to the camera's axes (x right, y down,
                    z forward), metres, column vectors
    gender          male, female, neutral or unknown: whose SMPL model the numbers belong to
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
"""How far a rotation that somebody supplies may be from one."""

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
    """What the file holds; see the module."""

    frame_index: Int[np.ndarray, "n"]
    global_orient: Float[np.ndarray, "n 3"]
    body_pose: Float[np.ndarray, "n 69"]
    transl: Float[np.ndarray, "n 3"]
    betas: Float[np.ndarray, "n 10"]
    smpl_to_camera: Float[np.ndarray, "n 4 4"]
    gender: str

    def for_frames(self, frame_index: Int[np.ndarray, "m"]) -> "SmplPoses":
        """The rows of those of these frames that there are."""
        rows = np.flatnonzero(np.isin(self.frame_index, frame_index))
        return replace(self, **{name: getattr(self, name)[rows] for name in _ROW_SHAPES})


def is_rigid(transforms: Float[np.ndarray, "*n 4 4"]) -> bool:
    """Whether each is a rotation and a shift on column vectors: finite, no scale, no mirror, last row 0 0 0 1."""
    rotation = transforms[..., :3, :3]
    return bool(
        np.isfinite(transforms).all()
        and (np.abs(rotation @ np.swapaxes(rotation, -1, -2) - np.eye(3)) <= RIGID_TOLERANCE).all()
        and (np.linalg.det(rotation) > 0).all()
        and (np.abs(transforms[..., 3, :] - np.eye(4)[3]) <= RIGID_TOLERANCE).all()
    )


def save_smpl_poses(path: Path, poses: SmplPoses) -> None:
    """Write the poses; `load_smpl_poses` is the inverse."""
    arrays = {name: getattr(poses, name).astype(np.float32) for name in _ROW_SHAPES}
    arrays["frame_index"] = poses.frame_index.astype(np.int32)
    save_npz(path, {**arrays, "gender": np.array(poses.gender)})


def load_smpl_poses(path: Path) -> SmplPoses:
    """Read what `save_smpl_poses`, or a user after the module's description, wrote.

    Raises:
        UserError: the file cannot be read, an array is missing, of another shape or not finite, frames do not rise, or
            `smpl_to_camera` is no rotation and shift.
    """
    arrays = load_npz(path)
    n = len(np.atleast_1d(arrays.get("frame_index", np.zeros(0))))
    for name, shape in _ROW_SHAPES.items():
        found = arrays[name].shape if name in arrays else None
        if found != (n, *shape):
            raise UserError(f"{path}: `{name}` must have shape {(n, *shape)}, found {found}; write it so")
    if (np.diff(arrays["frame_index"]) <= 0).any():
        raise UserError(f"{path}: `frame_index` does not rise; sort the rows, one for each frame")
    gender = str(arrays["gender"].item()) if "gender" in arrays else "unknown"
    if gender not in GENDERS:
        raise UserError(f"{path}: gender is {gender}; write one of {', '.join(GENDERS)}")
    floats = {name: arrays[name].astype(np.float32) for name in _ROW_SHAPES if name != "frame_index"}
    if broken := next((name for name, values in floats.items() if not np.isfinite(values).all()), None):
        raise UserError(f"{path}: `{broken}` holds a number that is not finite; leave out frames without a pose")
    if not is_rigid(floats["smpl_to_camera"]):
        raise UserError(f"{path}: `smpl_to_camera` must be a rotation and a shift; divide its scale out")
    return SmplPoses(frame_index=arrays["frame_index"].astype(np.int32), **floats, gender=gender)
