"""Artifacts of the body stage: body, motion, frame scores, camera; one writer and one reader each."""

from dataclasses import dataclass, fields
from pathlib import Path

import numpy as np
from jaxtyping import Bool, Float, Int

from pipeline.body.body import Body, Motion
from pipeline.core.command import rerun_command
from pipeline.core.errors import UserError
from pipeline.geometry.camera import Camera
from pipeline.io.npz import load_npz, save_npz


def save_body(path: Path, body: Body) -> None:
    """Write the body of one person; `load_body` is the inverse."""
    arrays = {
        "joint_names": np.array(body.joint_names),
        "parents": body.parents,
        "joints_m": body.joints_m,
        "vertices": body.vertices,
        "faces": body.faces,
        "skin_weights": body.skin_weights,
        "shape_names": np.array(list(body.shape), dtype=str),
        "shape_values": np.array(list(body.shape.values()), dtype=np.float64),
    }
    save_npz(path, arrays if body.hem_m is None else {**arrays, "hem_m": np.array(body.hem_m)})


def load_body(path: Path) -> Body:
    """Read a body written by `save_body`.

    Raises:
        UserError: the file is missing or not a readable npz.
    """
    arrays = load_npz(path)
    names = [str(name) for name in arrays["shape_names"]]
    return Body(
        joint_names=tuple(str(name) for name in arrays["joint_names"]),
        parents=arrays["parents"],
        joints_m=arrays["joints_m"],
        vertices=arrays["vertices"],
        faces=arrays["faces"],
        skin_weights=arrays["skin_weights"],
        shape=dict(zip(names, arrays["shape_values"].tolist(), strict=True)),
        hem_m=float(arrays["hem_m"]) if "hem_m" in arrays else None,
    )


def save_motion(path: Path, motion: Motion) -> None:
    """Write the pose of every frame; `load_motion` is the inverse."""
    save_npz(
        path,
        {
            "frame_index": motion.frame_index,
            "time_s": motion.time_s,
            "rotations_wxyz": motion.rotations_wxyz,
            "root_translation_m": motion.root_translation_m,
        },
    )


def load_motion(path: Path) -> Motion:
    """Read a motion written by `save_motion`.

    Raises:
        UserError: the file is missing or not a readable npz, or a pose is not finite.
    """
    arrays = load_npz(path)
    motion = Motion(arrays["frame_index"], arrays["time_s"], arrays["rotations_wxyz"], arrays["root_translation_m"])
    is_finite = np.isfinite(motion.rotations_wxyz).all((1, 2)) & np.isfinite(motion.root_translation_m).all(1)
    if not is_finite.all():
        frames = ", ".join(map(str, motion.frame_index[~is_finite]))
        raise UserError(f"{path}: the poses of frames {frames} are not finite; run the stage that wrote it again")
    return motion


@dataclass(frozen=True)
class FrameScores:
    """Quality of the fit in each frame.

    silhouette_iou: of the body with its clothes and the mask, 0 to 1; nan without a mask.
    landmark_error_px: median reprojection error; nan without landmarks.
    left_right_swapped: whether swapped landmarks of any body part were corrected.
    residual_blob_share: fraction of the mask in its largest part away from the body; nan without a mask.
    usable: whether later stages may train on the frame.
    """

    frame_index: Int[np.ndarray, "n"]
    silhouette_iou: Float[np.ndarray, "n"]
    landmark_error_px: Float[np.ndarray, "n"]
    left_right_swapped: Bool[np.ndarray, "n"]
    residual_blob_share: Float[np.ndarray, "n"]
    usable: Bool[np.ndarray, "n"]


def save_scores(path: Path, scores: FrameScores) -> None:
    """Write the scores of the frames; `load_scores` is the inverse."""
    save_npz(path, {field.name: getattr(scores, field.name) for field in fields(scores)})


def load_scores(path: Path) -> FrameScores:
    """Read scores written by `save_scores`.

    Raises:
        UserError: the file is missing or not a readable npz, or an older version wrote it.
    """
    arrays = load_npz(path)
    missing = [field.name for field in fields(FrameScores) if field.name not in arrays]
    if missing:
        again = rerun_command("body", path.parent)
        raise UserError(f"{path} has no array {missing[0]!r}: an older version wrote it; run {again}")
    return FrameScores(**{field.name: arrays[field.name] for field in fields(FrameScores)})


def save_camera(path: Path, camera: Camera) -> None:
    """Write a camera; `load_camera` is the inverse."""
    save_npz(path, camera.to_arrays())


def load_camera(path: Path) -> Camera:
    """Read a camera written by `save_camera`.

    Raises:
        UserError: the file is missing or not a readable npz.
    """
    return Camera.from_arrays(load_npz(path))
