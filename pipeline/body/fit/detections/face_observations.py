"""Faces of a fit: reliable detections, and the landmarks that follow the skull.

The face points of a pose detector err by a tenth of the face: hair over the forehead or a low camera shift them all
together. Those of a face detector err by a pixel, in faces that are not turned far from the camera.
"""

import numpy as np
from jaxtyping import Bool, Float

from pipeline.capture.hand_detector import image_scale_px_per_m
from pipeline.capture.landmarks import PoseLandmark

FACE_MESH_POINTS = (263, 33, 362, 133, 291, 61, 4, 168)
"""Face mesh points used by the fit: outer and inner corners of the eyes and corners of the mouth, left and right; tip
and bridge of the nose. Order as in `landmark_regressor.LANDMARKS`."""

MIN_FACING_COSINE = 0.6
"""Cosine of the largest angle between face and view; beyond it half of the points are hidden and guessed."""

MAX_DISTANCE_M = 0.06
"""Largest mean distance from the same landmarks of the pose; a face farther away is another one, or none."""

MIN_POSE_FACING_COSINE = -0.2
"""The same of the head of the pose, which knows front from back: the face detector finds faces in the hair of a head
that is seen from behind."""

_OUTER_EYES, _BRIDGE_AND_CHIN = (263, 33), (168, 152)
_SAME_POINTS = (
    (263, PoseLandmark.LEFT_EYE_OUTER),
    (33, PoseLandmark.RIGHT_EYE_OUTER),
    (291, PoseLandmark.MOUTH_LEFT),
    (61, PoseLandmark.MOUTH_RIGHT),
    (4, PoseLandmark.NOSE),
)


def face_landmarks(
    faces_px: Float[np.ndarray, "n 478 3"],
    pose_px: Float[np.ndarray, "n 33 2"],
    pose_world_m: Float[np.ndarray, "n 33 3"],
) -> tuple[Float[np.ndarray, "n k 2"], Float[np.ndarray, "n k"]]:
    """Return the face landmarks used by the fit (`FACE_MESH_POINTS`) in pixels, and their confidence, 0 or 1.

    faces_px: pixels and depth in pixels (`pipeline.capture.face_detector`), nan without a face.
    pose_px, pose_world_m: landmarks of the pose, the latter relative to the hips.
    """
    reliable = (
        _is_near_pose(faces_px, pose_px, pose_world_m)
        & (facing_cosine(faces_px) >= MIN_FACING_COSINE)
        & (_pose_facing_cosine(pose_world_m) >= MIN_POSE_FACING_COSINE)
    )
    points_px = faces_px[:, FACE_MESH_POINTS, :2]
    return points_px, np.repeat(reliable[:, None].astype(np.float64), len(FACE_MESH_POINTS), axis=1)


def facing_cosine(faces_px: Float[np.ndarray, "*n 478 3"]) -> Float[np.ndarray, "*n"]:
    """Return the cosine of the angle between the face's forward direction and the direction to the camera.

    It is nan without a face.
    """
    across, down = (
        faces_px[..., first, :] - faces_px[..., second, :] for first, second in (_OUTER_EYES, _BRIDGE_AND_CHIN[::-1])
    )
    # Pixel axes: x right, y down, z away. A face that looks at the camera has its left side at larger x.
    forward = np.cross(down, across)
    return -forward[..., 2] / np.linalg.norm(forward, axis=-1)


def _pose_facing_cosine(pose_world_m: Float[np.ndarray, "n 33 3"]) -> Float[np.ndarray, "n"]:
    """Return the cosine of the angle between the direction from ears to nose and the direction to the camera."""
    ears_m = pose_world_m[:, [PoseLandmark.LEFT_EAR, PoseLandmark.RIGHT_EAR]].mean(axis=1)
    forward = pose_world_m[:, PoseLandmark.NOSE] - ears_m
    return -forward[:, 2] / np.linalg.norm(forward, axis=1)


def _is_near_pose(
    faces_px: Float[np.ndarray, "n 478 3"],
    pose_px: Float[np.ndarray, "n 33 2"],
    pose_world_m: Float[np.ndarray, "n 33 3"],
) -> Bool[np.ndarray, "n"]:
    mesh_points, pose_points = (list(points) for points in zip(*_SAME_POINTS, strict=True))
    distance_px = np.linalg.norm(faces_px[:, mesh_points, :2] - pose_px[:, pose_points], axis=-1).mean(axis=-1)
    return distance_px < MAX_DISTANCE_M * image_scale_px_per_m(pose_px, pose_world_m)
