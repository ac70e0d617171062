"""Where an avatar's scene has its origin: on the floor, where the person stood."""

from dataclasses import replace

import numpy as np
from jaxtyping import Float

from pipeline.body.body import Motion
from pipeline.geometry.camera import Camera

FLOOR_PERCENTILE = 10.0


def world_to_scene_translation_m(motion: Motion, lowest_vertex_y_m: Float[np.ndarray, "n"]) -> Float[np.ndarray, "3"]:
    """Translation (m) that carries world points into the scene of the exported file.

    The floor (y = 0) is where the feet are: the lowest tenth of the frames' lowest points, since a jump lifts some
    frames and a wrong pose sinks few. x = z = 0 is the middle (median) of the root's places, so that viewers, which
    look at the rest pose, find the moving person. Nothing is scaled or turned: displacements and the camera's relative
    place stay.

    lowest_m: y of the lowest point of the posed surface, a frame, world.
    """
    median_root_m = np.median(motion.root_translation_m, axis=0)
    floor_m = np.percentile(lowest_vertex_y_m, FLOOR_PERCENTILE)
    return -np.array([median_root_m[0], floor_m, median_root_m[2]], dtype=np.float32)


def translate_motion(motion: Motion, offset_m: Float[np.ndarray, "3"]) -> Motion:
    """The same motion with the world's points shifted by `offset_m`."""
    return motion.with_pose(motion.rotations_wxyz, motion.root_translation_m + offset_m)


def translate_camera(camera: Camera, offset_m: Float[np.ndarray, "3"]) -> Camera:
    """The camera that sees the shifted world as it saw the world before."""
    world_to_camera = camera.world_to_camera.copy()
    world_to_camera[:3, 3] -= world_to_camera[:3, :3] @ offset_m
    return replace(camera, world_to_camera=world_to_camera)


def pad_motion_to_video(motion: Motion, frame_rate: float, video_frame_count: int) -> Motion:
    """The motion over the whole video: the first and last pose held to the first and last frame of the video.

    Frames keep their own times, whose steps vary in a phone's video. An added first frame is at 0, an added last one
    as far behind its neighbour as the frames between them take at the video's mean rate.

    frame_rate: the video's mean, frames a second.
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
