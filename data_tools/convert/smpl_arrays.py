"""Convert SMPL parameters, stored under the array names of research code, to `SmplPoses`."""

from collections.abc import Mapping, Sequence
from pathlib import Path

import numpy as np
from jaxtyping import Float, Int, Shaped

from pipeline.capture.smpl_poses import N_BETAS, N_BODY_POSE, SmplPoses
from pipeline.core.errors import UserError

_FULL_POSE_KEYS = ("thetas", "pose")
_TRANSLATION_KEYS = ("transl", "trans")


def smpl_poses_from_arrays(
    arrays: Mapping[str, Shaped[np.ndarray, "..."]],
    frame_index: Int[np.ndarray, "n"],
    smpl_to_camera: Float[np.ndarray, "... 4 4"],
    gender: str,
    path: Path,
) -> SmplPoses:
    """Convert the arrays of n frames.

    Args:
        arrays: `thetas` or `pose` (n or more, 72), or `global_orient` (.., 3) and `body_pose` (.., 69), axis-angle in
            radians; `transl` or `trans` (.., 3), metres; `betas` (10,), (1, 10) or (.., 10). Rows after n are ignored.
        smpl_to_camera: one for all frames, or one per frame.
        path: of the file, for error messages.

    Raises:
        UserError: an array is missing, too short or has the wrong width.
    """
    n = len(frame_index)
    whole = [arrays[name] for name in _FULL_POSE_KEYS if name in arrays]
    if whole:
        pose = _require_rows(whole[0], n, 3 + N_BODY_POSE, "the pose", path)
    else:
        orient = _require_rows(arrays.get("global_orient"), n, 3, "`global_orient`", path)
        pose = np.concatenate(
            [orient, _require_rows(arrays.get("body_pose"), n, N_BODY_POSE, "`body_pose`", path)], axis=1
        )
    translation = next((arrays[name] for name in _TRANSLATION_KEYS if name in arrays), None)
    return SmplPoses(
        frame_index=frame_index.astype(np.int32),
        global_orient=pose[:, :3],
        body_pose=pose[:, 3:],
        transl=_require_rows(translation, n, 3, "the translation", path),
        betas=_require_rows(_repeat_betas(arrays.get("betas"), n), n, N_BETAS, "`betas`", path),
        smpl_to_camera=np.broadcast_to(smpl_to_camera, (n, 4, 4)).astype(np.float32),
        gender=gender,
    )


def merge_smpl_poses(parts: Sequence[SmplPoses]) -> SmplPoses:
    """Concatenate poses of different frames in ascending frame order; all must have one gender."""
    index = np.concatenate([part.frame_index for part in parts])
    order = np.argsort(index)
    rows = {
        name: np.concatenate([getattr(part, name) for part in parts])[order]
        for name in ("global_orient", "body_pose", "transl", "betas", "smpl_to_camera")
    }
    return SmplPoses(frame_index=index[order], **rows, gender=parts[0].gender)


def gender_from_name(subject: str) -> str:
    """Return the gender prefix of a PeopleSnapshot subject name, or "unknown"."""
    return next((gender for gender in ("female", "male", "neutral") if subject.startswith(gender)), "unknown")


def _repeat_betas(betas: Shaped[np.ndarray, "..."] | None, n: int) -> Shaped[np.ndarray, "..."] | None:
    """Repeat a single shape for all frames; return other arrays unchanged."""
    return np.tile(betas.reshape(1, -1), (n, 1)) if betas is not None and betas.size == N_BETAS else betas


def _require_rows(
    values: Shaped[np.ndarray, "..."] | None, n: int, width: int, name: str, path: Path
) -> Float[np.ndarray, "n w"]:
    if values is None or values.ndim != 2 or values.shape[1] != width or len(values) < n:
        found = None if values is None else values.shape
        raise UserError(
            f"{path}: {name} must have {n} rows of {width} numbers, found {found}; supply the matching file"
        )
    return values[:n].astype(np.float32)
