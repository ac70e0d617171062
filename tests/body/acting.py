"""Synthetic recordings: a person with known shape, motion and camera, and simulated detections."""

from dataclasses import dataclass

import numpy as np
import torch

from pipeline.body.body import ParametricBody
from pipeline.body.fit.camera_parameters import INTRINSICS_COUNT
from pipeline.body.fit.detections.face_observations import FACE_MESH_POINTS
from pipeline.body.fit.diagnostics import make_observations
from pipeline.body.fit.landmark_regressor import (
    FACE_MESH_START,
    HAND_LANDMARKS,
    LANDMARK_OFFSET_COUNT,
    LEFT_RIGHT_PAIRS,
    POSE_LANDMARK_COUNT,
    landmark_regressor,
    mirror_permutation,
)
from pipeline.body.fit.linear_body import ACTIVE_JOINTS, LinearBody, linearise_body
from pipeline.body.fit.posed_points import pose_points, pose_skeleton
from pipeline.body.fit.result import FitResult
from pipeline.body.fit.silhouette_icp import MaskWindow, crop_mask_window, posed_vertices
from pipeline.body.fit.state import FitState, Observations
from pipeline.capture.face_detector import undetected_face
from pipeline.capture.hand_detector import N_HAND_LANDMARKS, HandLandmarks
from pipeline.geometry.camera import Camera, project, transform_world_to_camera
from pipeline.geometry.rotation import axis_angle_to_matrix, quaternion_to_matrix, rotation_between
from pipeline.geometry.skinning import forward_kinematics
from pipeline.kernels.raster import rasterize


@dataclass(frozen=True)
class SyntheticRecording:
    """Ground truth (`state`, `model`, `camera`) and simulated detections."""

    model: LinearBody
    state: FitState
    camera: Camera
    time_s: np.ndarray
    landmarks_px: np.ndarray
    landmarks_world_m: np.ndarray
    hands: HandLandmarks
    faces_px: np.ndarray

    def observations(self, camera: Camera) -> Observations:
        return make_observations(
            self.time_s, self.landmarks_px, np.ones((len(self.time_s), 33)), self.landmarks_world_m, camera
        )

    def joints_m(self) -> torch.Tensor:
        return pose_skeleton(self.model, self.state.rotations, self.state.root_m).position_m

    def masks(self) -> list[np.ndarray]:
        masks = []
        for vertices in posed_vertices(self.model, self.state):
            vertices_px, depth_m = project(vertices, self.camera)
            face_id, _, _ = rasterize(vertices_px, depth_m, self.model.faces, self.camera.height, self.camera.width)
            masks.append(np.where(face_id.numpy() >= 0, 255, 0).astype(np.uint8))
        return masks

    def windows(self) -> list[MaskWindow | None]:
        return [crop_mask_window(mask) for mask in self.masks()]


def synthetic_recording(
    body: ParametricBody,
    frames: int = 24,
    shape: dict[str, float] | None = None,
    focal_px: float = 520.0,
    noise_m: float = 0.0,
    turn_rad: float = 2 * np.pi,
    wrists_rad: float = 0.0,
    seed: int = 0,
) -> SyntheticRecording:
    """Return a person who turns on the spot at 3 m and swings arms and legs: 256 x 320 pixels, 10 frames per second.

    noise_m: standard deviation of the landmarks at the depth of the person; hands have no noise.
    wrists_rad: rotation of the hands about each axis.
    """
    values = body.shape_defaults.clone()
    for name, value in (shape or {}).items():
        values[body.shape_names.index(name)] = value
    model = linearise_body(body, values)
    time_s = np.arange(frames) / 10.0
    phase = torch.linspace(0.0, 1.0, frames, dtype=torch.float64)
    camera = Camera(focal_px, focal_px, 128.0, 160.0, 256, 320)
    root = torch.stack([0.1 * torch.sin(6 * phase), 0.02 * torch.cos(9 * phase) - 0.05, -3.0 + 0.2 * phase], dim=1)
    state = FitState(
        _synthetic_rotations(phase, turn_rad, wrists_rad),
        root,
        values.double(),
        torch.zeros(LANDMARK_OFFSET_COUNT, dtype=torch.float64),
        torch.zeros(INTRINSICS_COUNT, dtype=torch.float64),
    )
    return simulate_detections(body, model, state, camera, time_s, noise_m, seed)


def simulate_detections(
    body: ParametricBody,
    model: LinearBody,
    state: FitState,
    camera: Camera,
    time_s: np.ndarray,
    noise_m: float = 0.0,
    seed: int = 0,
) -> SyntheticRecording:
    """Return the detections of a motion of the body `model`; noise as in `synthetic_recording`."""
    regressor = landmark_regressor(linearise_body(body, body.shape_defaults))
    skeleton = pose_skeleton(model, state.rotations, state.root_m)
    world = pose_points(model, skeleton, regressor.points(model, state.landmark_offsets_m)).world_m
    hands = _hands(world[:, POSE_LANDMARK_COUNT:FACE_MESH_START], camera)
    faces_px = _faces(world[:, FACE_MESH_START:], camera)
    world = world[:, :POSE_LANDMARK_COUNT]
    pixels, depth_m = project(world, camera)
    random = np.random.default_rng(seed)
    noise_px = noise_m * camera.fx / float(depth_m.mean())
    landmarks_px = pixels.numpy() + noise_px * random.standard_normal(pixels.shape)
    relative = relative_to_line_of_sight(world, camera).numpy()
    landmarks_3d_m = relative + 2 * noise_m * random.standard_normal(relative.shape)
    return SyntheticRecording(model, state, camera, time_s, landmarks_px, landmarks_3d_m, hands, faces_px)


def relative_to_line_of_sight(world_m: torch.Tensor, camera: Camera) -> torch.Tensor:
    """3D landmarks as a detector sees them that knows a crop around the hips, not where the crop lies in the image."""
    hips_m = world_m[:, 23:25].mean(1)
    sight = torch.nn.functional.normalize(transform_world_to_camera(hips_m, camera), dim=1)
    turn = rotation_between(sight, torch.tensor([0.0, 0.0, 1.0], dtype=sight.dtype).expand_as(sight))
    to_camera = torch.as_tensor(camera.world_to_camera, dtype=world_m.dtype)[:3, :3]
    return (world_m - hips_m[:, None]) @ to_camera.T @ turn.mT


def swap_left_right(scene: SyntheticRecording, rows: slice | list[int]) -> None:
    """Swap left and right of the landmarks in some frames and mirror their depths, as the detector does."""
    order = mirror_permutation(LEFT_RIGHT_PAIRS)[:POSE_LANDMARK_COUNT]
    scene.landmarks_px[rows] = scene.landmarks_px[rows][:, order]
    scene.landmarks_world_m[rows] = scene.landmarks_world_m[rows][:, order] * [1.0, 1.0, -1.0]


def _hands(points_m: torch.Tensor, camera: Camera) -> HandLandmarks:
    """Return hand detections; landmarks that the fit ignores are copies of others."""
    copied = np.zeros(N_HAND_LANDMARKS, dtype=np.int64)
    copied[list(HAND_LANDMARKS)] = np.arange(len(HAND_LANDMARKS))
    positions_m = points_m.reshape(len(points_m), -1, 2, 3).transpose(1, 2)[:, :, copied]
    pixels, _ = project(positions_m.flatten(0, 2), camera)
    in_camera = (positions_m - positions_m.mean(2, keepdim=True)).numpy() * [1.0, -1.0, -1.0]
    return HandLandmarks(pixels.reshape(*positions_m.shape[:3], 2).numpy(), in_camera, np.ones((len(points_m), 2)))


def _faces(points_m: torch.Tensor, camera: Camera) -> np.ndarray:
    """Return face detections in every frame, also from behind; points that the fit ignores but the chin are nan."""
    pixels, depth_m = project(points_m.flatten(0, 1), camera)
    px_per_m = camera.fx / depth_m.mean()
    faces_px = undetected_face(len(points_m)).astype(np.float64)
    points_px = torch.cat([pixels, px_per_m * depth_m[:, None]], dim=1).reshape(*points_m.shape[:2], 3).numpy()
    faces_px[:, FACE_MESH_POINTS] = points_px
    mouth_px, bridge_px = points_px[:, 4:6].mean(axis=1), points_px[:, 7]
    faces_px[:, 152] = bridge_px + 1.5 * (mouth_px - bridge_px)
    return faces_px


def _synthetic_rotations(phase: torch.Tensor, turn_rad: float, wrists_rad: float) -> torch.Tensor:
    angles = torch.zeros(len(phase), len(ACTIVE_JOINTS), 3, dtype=torch.float64)
    swing = torch.sin(10 * phase)
    angles[:, ACTIVE_JOINTS.index("Hips"), 1] = turn_rad * phase
    for side, sign in (("Left", 1.0), ("Right", -1.0)):
        angles[:, ACTIVE_JOINTS.index(f"{side}Arm"), 0] = -0.3 * sign * swing
        angles[:, ACTIVE_JOINTS.index(f"{side}Arm"), 2] = -0.3 * sign
        angles[:, ACTIVE_JOINTS.index(f"{side}Hand")] = sign * wrists_rad
        angles[:, ACTIVE_JOINTS.index(f"{side}UpLeg"), 0] = 0.25 * sign * swing
        angles[:, ACTIVE_JOINTS.index(f"{side}Leg"), 0] = 0.3 + 0.2 * sign * swing
    angles[:, ACTIVE_JOINTS.index("Head"), 1] = 0.3 * torch.cos(7 * phase)
    return axis_angle_to_matrix(angles)


def fitted_joint_to_world(result: FitResult, scene: SyntheticRecording) -> torch.Tensor:
    """Return the world transforms of the fitted active joints: (n, j, 4, 4)."""
    joint_to_world = forward_kinematics(
        quaternion_to_matrix(torch.tensor(result.rotations_wxyz)),
        torch.tensor(result.root_translation_m),
        torch.tensor(result.body.joints_m),
        result.body.parents,
    )
    return joint_to_world[:, list(scene.model.full_joint_indices)].double()


def fitted_joints_m(result: FitResult, scene: SyntheticRecording) -> torch.Tensor:
    """Return the world positions of the fitted active joints."""
    return fitted_joint_to_world(result, scene)[..., :3, 3]


def joint_errors_m(found_m: torch.Tensor, true_m: torch.Tensor) -> tuple[float, float]:
    """Return the mean distance of joints, with the root joint aligned and absolute."""
    aligned = (found_m - found_m[:, :1]) - (true_m - true_m[:, :1])
    return float(aligned.norm(dim=-1).mean()), float((found_m - true_m).norm(dim=-1).mean())
