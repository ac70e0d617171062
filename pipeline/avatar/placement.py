"""Place the avatar in its scene: origin on the floor, at the median position of the root; times of its motion."""

from dataclasses import replace

import numpy as np
import torch
from jaxtyping import Float

from pipeline.body.body import Motion
from pipeline.geometry.camera import Camera
from pipeline.geometry.rotation import slerp

FLOOR_PERCENTILE = 10.0


def world_to_scene_translation_m(motion: Motion, lowest_vertex_y_m: Float[np.ndarray, "n"]) -> Float[np.ndarray, "3"]:
    """Return the translation (m) from the world to the scene of the exported file.

    The floor (y = 0) is the `FLOOR_PERCENTILE` of the lowest point per frame: robust to jumps, which raise it, and to
    single wrong poses, which lower it. x = z = 0 is the median position of the root, so that a viewer that frames the
    rest pose also shows the moving person. There is no rotation or scale.

    lowest_vertex_y_m: height of the lowest vertex of the posed mesh in each frame, world.
    """
    median_root_m = np.median(motion.root_translation_m, axis=0)
    floor_m = np.percentile(lowest_vertex_y_m, FLOOR_PERCENTILE)
    return -np.array([median_root_m[0], floor_m, median_root_m[2]], dtype=np.float32)


def translate_motion(motion: Motion, offset_m: Float[np.ndarray, "3"]) -> Motion:
    """Return the motion in a world translated by `offset_m`."""
    return motion.with_pose(motion.rotations_wxyz, motion.root_translation_m + offset_m)


def translate_camera(camera: Camera, offset_m: Float[np.ndarray, "3"]) -> Camera:
    """Return the camera in a world translated by `offset_m`; its images do not change."""
    world_to_camera = camera.world_to_camera.copy()
    world_to_camera[:3, 3] -= world_to_camera[:3, :3] @ offset_m
    return replace(camera, world_to_camera=world_to_camera)


def pad_motion_to_video(motion: Motion, frame_rate: float, video_frame_count: int) -> Motion:
    """Extend the motion to the first and last frame of the video by repeating its first and last pose.

    Existing frames keep their times, whose steps vary in videos of variable frame rate. An added first frame is at 0 s;
    an added last frame follows at the mean frame rate.

    frame_rate: mean of the video, frames per second.
    """
    rows, frames, time_s = np.arange(len(motion.frame_index)), motion.frame_index, motion.time_s
    if frames[0] > 0:
        rows, frames, time_s = np.r_[rows[0], rows], np.r_[0, frames], np.r_[0.0, time_s]
    missing_frame_count = video_frame_count - 1 - frames[-1]
    if missing_frame_count > 0:
        rows, frames = np.r_[rows, rows[-1]], np.r_[frames, video_frame_count - 1]
        time_s = np.r_[time_s, time_s[-1] + missing_frame_count / frame_rate]
    padded_motion = motion.select(rows)
    return replace(padded_motion, frame_index=frames.astype(np.int32), time_s=time_s.astype(motion.time_s.dtype))


def resample_uniformly(motion: Motion, fps: float) -> Motion:
    """Return the motion at `fps` frames per second from its first to its last frame; rotations take the shorter arc."""
    start_s, end_s = float(motion.time_s[0]), float(motion.time_s[-1])
    time_s = start_s + np.arange(int(np.floor((end_s - start_s) * fps + 1e-6)) + 1) / fps
    after = np.clip(np.searchsorted(motion.time_s, time_s, side="right"), 1, max(len(motion.time_s) - 1, 1))
    before, after = after - 1, np.minimum(after, len(motion.time_s) - 1)
    span_s = np.maximum(motion.time_s[after] - motion.time_s[before], 1e-9)
    fraction = np.clip((time_s - motion.time_s[before]) / span_s, 0.0, 1.0)
    rotations = torch.from_numpy(motion.rotations_wxyz.astype(np.float64))
    step = torch.from_numpy(fraction)[:, None, None].expand(*rotations[before].shape[:2], 1)
    between = slerp(rotations[before], rotations[after], step)
    root_m = motion.root_translation_m.astype(np.float64)
    place_m = root_m[before] + fraction[:, None] * (root_m[after] - root_m[before])
    index = np.arange(len(time_s), dtype=np.int32)
    return Motion(index, time_s, between.numpy().astype(np.float32), place_m.astype(np.float32))
