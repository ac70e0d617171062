"""Initial state of a fit: orientation and position of the root in each frame."""

from dataclasses import replace

import numpy as np
import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from pipeline.body.fit.camera_parameters import INTRINSICS_COUNT
from pipeline.body.fit.root_placement import line_of_sight_rotation
from pipeline.body.fit.state import FitState, Observations
from pipeline.geometry.rotation import matrix_to_quaternion, quaternion_to_matrix, slerp

LEFT_HIP, RIGHT_HIP = 23, 24
TORSO_LANDMARKS = (11, 12, LEFT_HIP, RIGHT_HIP)


def torso_rotations(
    rest_landmarks_m: Float[Tensor, "l 3"], landmarks_3d_m: Float[Tensor, "n l 3"]
) -> Float[Tensor, "n 3 3"]:
    """Return the rotations that map the rest torso (hips, shoulders) to the 3D landmarks (Kabsch 1976)."""
    rows = list(TORSO_LANDMARKS)
    rest = rest_landmarks_m[rows] - rest_landmarks_m[rows].mean(0)
    observed = landmarks_3d_m[:, rows] - landmarks_3d_m[:, rows].mean(1, keepdim=True)
    u, _, v = torch.linalg.svd(observed.transpose(1, 2) @ rest)
    sign = torch.ones(len(observed), 3, dtype=rest.dtype)
    sign[:, 2] = torch.linalg.det(u @ v)
    return (u * sign[:, None]) @ v


def has_torso_landmarks(observations: Observations) -> Bool[np.ndarray, "n"]:
    """Return which frames have hips and shoulders in pixels and in 3D.

    Landmarks that all coincide, as those of a failed detection, do not count.
    """
    rows = list(TORSO_LANDMARKS)
    known = torch.minimum(observations.confidence[:, rows], observations.confidence_3d[:, rows]).min(1).values > 0
    return (known & (torso_radius_m(observations.landmarks_3d_m) > 1e-3)).numpy()


def torso_radius_m(positions_m: Float[Tensor, "n l 3"]) -> Float[Tensor, "n"]:
    """Return the root mean square distance (m) of hips and shoulders from their centroid."""
    torso = positions_m[:, list(TORSO_LANDMARKS)]
    return (torso - torso.mean(1, keepdim=True)).square().sum(-1).mean(1).sqrt()


def facing_yaw_rad(rotation: Float[Tensor, "n 3 3"]) -> Float[Tensor, "n"]:
    """Return the angle (rad) about +Y of the facing direction; 0 is +Z, positive towards +X."""
    return torch.atan2(rotation[:, 0, 2], rotation[:, 2, 2])


def initial_state(
    observations: Observations,
    rest_landmarks_m: Float[Tensor, "l 3"],
    joints_m: Float[Tensor, "j 3"],
    shape: Float[Tensor, "s"],
    offset_count: int,
) -> FitState:
    """Return the A-pose with the orientation of the torso, at the position with the least reprojection error.

    Frames without landmarks are interpolated.

    rest_landmarks_m, joints_m: of the default shape. shape: initial shape.
    """
    found = has_torso_landmarks(observations)
    landmarks_3d_m = in_world_axes(observations)
    torso_rotation = torso_rotations(rest_landmarks_m, landmarks_3d_m)
    rotated_m = (rest_landmarks_m - joints_m[0]) @ torso_rotation.transpose(1, 2)
    scale = torso_radius_m(rest_landmarks_m[None])[0] / torso_radius_m(landmarks_3d_m[torch.from_numpy(found)]).median()
    hips_m = 0.5 * (rotated_m[:, 23] + rotated_m[:, 24])
    relative = landmarks_3d_m * scale + hips_m[:, None]
    root = solve_root_position(observations, relative)
    torso_rotation, root = _fill_gaps(torso_rotation, root, found)
    rotations = torch.eye(3, dtype=torch.float64).repeat(len(root), len(joints_m), 1, 1)
    rotations[:, 0] = torso_rotation
    return FitState(
        rotations,
        root,
        shape.double(),
        torch.zeros(offset_count, dtype=torch.float64),
        torch.zeros(INTRINSICS_COUNT, dtype=torch.float64),
    )


def in_world_axes(observations: Observations) -> Float[Tensor, "n l 3"]:
    """Return the 3D landmarks in world axes (m): they are relative to the line of sight to the hips."""
    camera = observations.camera
    hips_px = observations.landmarks_px[:, [LEFT_HIP, RIGHT_HIP]].mean(1)
    direction = (hips_px - hips_px.new_tensor([camera.cx, camera.cy])) / hips_px.new_tensor([camera.fx, camera.fy])
    to_camera = torch.as_tensor(camera.world_to_camera, dtype=torch.float64)[:3, :3]
    return observations.landmarks_3d_m @ to_camera.T @ line_of_sight_rotation(direction)[0] @ to_camera


def solve_root_position(observations: Observations, relative_m: Float[Tensor, "n l 3"]) -> Float[Tensor, "n 3"]:
    """Return the world position of the root (m) from pixels of points with known positions relative to it.

    Each pixel gives two linear equations in the unknown position t: fx (X + t_x) - (u - cx) (Z + t_z) = 0, likewise y
    (direct linear transform).
    """
    camera = observations.camera
    pose = torch.as_tensor(camera.world_to_camera, dtype=torch.float64)
    in_camera = relative_m @ pose[:3, :3].T
    weight = observations.confidence.sqrt()
    rows, right = [], []
    for axis, (focal, centre) in enumerate(((camera.fx, camera.cx), (camera.fy, camera.cy))):
        offset_px = observations.landmarks_px[..., axis] - centre
        row = torch.zeros(*offset_px.shape, 3, dtype=torch.float64)
        row[..., axis], row[..., 2] = focal, -offset_px
        rows.append(row * weight[..., None])
        right.append((offset_px * in_camera[..., 2] - focal * in_camera[..., axis]) * weight)
    matrix, vector = torch.cat(rows, dim=1), torch.cat(right, dim=1)
    normal = matrix.transpose(1, 2) @ matrix + 1e-6 * torch.eye(3, dtype=torch.float64)
    root_in_camera = torch.linalg.solve(normal, (matrix * vector[..., None]).sum(1))
    return (root_in_camera - pose[:3, 3]) @ pose[:3, :3]


def _fill_gaps(
    torso_rotation: Float[Tensor, "n 3 3"], root_m: Float[Tensor, "n 3"], found: Bool[np.ndarray, "n"]
) -> tuple[Float[Tensor, "n 3 3"], Float[Tensor, "n 3"]]:
    """Return rotations and positions with those of missing frames interpolated between the nearest found frames."""
    known = np.flatnonzero(found)
    low, high, share = _interpolation_weights(known.astype(np.float64), np.arange(len(found), dtype=np.float64))
    quaternions = matrix_to_quaternion(torso_rotation[known])
    filled = quaternion_to_matrix(slerp(quaternions[low], quaternions[high], share))
    return filled, root_m[known][low] * (1 - share) + root_m[known][high] * share


def interpolated_state(state: FitState, rows: Int[np.ndarray, "k"], time_s: Float[Tensor, "n"]) -> FitState:
    """Return the poses of all n frames, interpolated over time from those of `rows`; constant outside."""
    times = time_s.numpy()
    low, high, share = _interpolation_weights(times[rows], times)
    quaternions = matrix_to_quaternion(state.rotations)
    interpolated = slerp(quaternions[low], quaternions[high], share[:, None].expand(-1, quaternions.shape[1], 1))
    return replace(
        state,
        rotations=quaternion_to_matrix(interpolated),
        root_m=state.root_m[low] * (1 - share) + state.root_m[high] * share,
    )


def _interpolation_weights(
    known: Float[np.ndarray, "k"], wanted: Float[np.ndarray, "n"]
) -> tuple[Int[np.ndarray, "n"], Int[np.ndarray, "n"], Float[Tensor, "n 1"]]:
    """Return the known values below and above each wanted value, and its fraction of the way between them (0 to 1)."""
    high = np.clip(np.searchsorted(known, wanted), 0, len(known) - 1)
    low = np.clip(high - 1, 0, None)
    gap = np.maximum(known[high] - known[low], 1e-9)
    share = np.where(high == low, 0.0, np.clip((wanted - known[low]) / gap, 0.0, 1.0))
    return low, high, torch.from_numpy(share)[:, None]
