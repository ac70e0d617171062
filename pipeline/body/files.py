"""The artifacts of the body stage: body, motion and camera as npz files, one writer and one reader each."""

from pathlib import Path

import numpy as np

from pipeline.body.body import Body, Motion
from pipeline.core.errors import UserError
from pipeline.geometry.camera import Camera
from pipeline.io.npz import load_npz, save_npz


def save_body(path: Path, body: Body) -> None:
    """Write one person's body; `load_body` is the inverse."""
    save_npz(
        path,
        {
            "joint_names": np.array(body.joint_names),
            "parents": body.parents,
            "joints_m": body.joints_m,
            "vertices": body.vertices,
            "faces": body.faces,
            "skin_weights": body.skin_weights,
            "shape_names": np.array(list(body.shape), dtype=str),
            "shape_values": np.array(list(body.shape.values()), dtype=np.float64),
        },
    )


def load_body(path: Path) -> Body:
    """Read what `save_body` wrote."""
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
    """Read what `save_motion` wrote.

    Raises:
        UserError: no readable npz, or a frame whose pose holds a number that is not finite.
    """
    arrays = load_npz(path)
    motion = Motion(arrays["frame_index"], arrays["time_s"], arrays["rotations_wxyz"], arrays["root_translation_m"])
    is_finite = np.isfinite(motion.rotations_wxyz).all((1, 2)) & np.isfinite(motion.root_translation_m).all(1)
    if not is_finite.all():
        frames = ", ".join(map(str, motion.frame_index[~is_finite]))
        raise UserError(f"{path}: the poses of frames {frames} are not finite; run the stage that writes it again")
    return motion


def save_camera(path: Path, camera: Camera) -> None:
    """Write a camera; `load_camera` is the inverse."""
    save_npz(path, camera.to_arrays())


def load_camera(path: Path) -> Camera:
    """Read what `save_camera` wrote."""
    return Camera.from_arrays(load_npz(path))
