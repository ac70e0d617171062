"""Second fit of the poses, through a surface that wears the clothes and the hair of the masks.

The outline of the bare body lies inside the masks, by as much as the clothes are thick. The skinned mesh of the avatar
has the outline of the masks, so its silhouette tells the pose more exactly. Shape, camera and landmark places are
those of the first fit; no colours are used.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import partial

import numpy as np
import torch
from jaxtyping import Bool, Float
from torch import Tensor

from pipeline.body.body import Body, Motion
from pipeline.body.fit.camera_parameters import INTRINSICS_COUNT
from pipeline.body.fit.energy import EnergyParameters, Objective, compute_px_per_m
from pipeline.body.fit.ground_contact import estimate_floor_contact
from pipeline.body.fit.landmark_regressor import LANDMARK_OFFSET_COUNT, LANDMARKS, fixed_landmarks
from pipeline.body.fit.levenberg_marquardt import minimise
from pipeline.body.fit.linear_body import (
    ACTIVE_JOINTS,
    LinearBody,
    descendant_matrix,
    merge_skin_weights,
    reduced_parents,
)
from pipeline.body.fit.prior.posture import Posture, prior_of_recording
from pipeline.body.fit.prior.priors import (
    ShapePrior,
    estimate_motion_std,
    pose_prior,
)
from pipeline.body.fit.root_placement import world_to_perspective
from pipeline.body.fit.silhouette_icp import MaskWindow, match_silhouettes
from pipeline.body.fit.state import FitState, Observations
from pipeline.body.settings import DEFAULT_SETTINGS, FitSettings
from pipeline.core.progress import track
from pipeline.geometry.rotation import continuous_quaternions, matrix_to_quaternion, quaternion_to_matrix
from pipeline.geometry.skinning import forward_kinematics, linear_blend_skinning, skinning_transforms


def surface_model(surface: Body, motion: Motion, landmarks_m: Float[Tensor, "l 3"]) -> LinearBody:
    """Return a skinned surface as a linear body without shape parameters, its fingers bent as in the motion.

    surface: a body with the vertices, faces and skin weights of any surface in its A-pose.
    motion: its joints that are not active have the same rotations in all frames.
    landmarks_m: places of the landmarks on the A-pose.
    """
    active = tuple(surface.joint(name) for name in ACTIVE_JOINTS)
    rest_m = torch.from_numpy(surface.joints_m).double()
    bent = quaternion_to_matrix(torch.from_numpy(motion.rotations_wxyz[0])).double()
    bent[list(active)] = torch.eye(3, dtype=torch.float64)
    joint_to_world = forward_kinematics(bent[None], rest_m[None, 0], rest_m, surface.parents)
    weights = torch.from_numpy(surface.skin_weights).double()
    vertices_m = linear_blend_skinning(
        torch.from_numpy(surface.vertices).double(), weights, skinning_transforms(joint_to_world, rest_m)
    )[0]
    joints_m, parents = joint_to_world[0, :, :3, 3], reduced_parents(surface.parents, active)
    return LinearBody(
        shape=torch.zeros(0, dtype=torch.float64),
        vertices_m=vertices_m,
        vertices_shape_jacobian=vertices_m.new_zeros(*vertices_m.shape, 0),
        joints_m=joints_m[list(active)],
        joints_shape_jacobian=joints_m.new_zeros(len(active), 3, 0),
        skin_weights=merge_skin_weights(surface, active),
        parents=parents,
        is_descendant=descendant_matrix(parents),
        faces=torch.from_numpy(surface.faces),
        finger_rotations=bent,
        full_joint_indices=active,
        joint_index_by_name={name: index for index, name in enumerate(surface.joint_names)},
        full_joints_m=joints_m,
        full_joints_shape_jacobian=joints_m.new_zeros(len(joints_m), 3, 0),
        landmark_positions_m={
            landmark.name: tuple(landmarks_m[landmark.indices[0]].tolist()) for landmark in LANDMARKS
        },
    )


@dataclass(frozen=True)
class RefittedPoses:
    """Poses of all frames, and the IoU of outline and mask before and after the fit (nan without a mask)."""

    motion: Motion
    iou_before: Float[np.ndarray, "n"]
    iou_after: Float[np.ndarray, "n"]


def refit_poses(
    surface: Body,
    motion: Motion,
    is_fixed: Bool[np.ndarray, "n"],
    landmarks: tuple[Observations, Float[Tensor, "l 3"]],
    windows: Sequence[MaskWindow | None],
    settings: FitSettings = DEFAULT_SETTINGS,
) -> RefittedPoses:
    """Fit the poses of all frames but the fixed ones to landmarks and masks.

    Args:
        surface: as in `surface_model`.
        motion: poses at the start.
        is_fixed: frames that keep their pose; the motion prior ties the others to them.
        landmarks: observed landmarks, and their places on the A-pose (`pipeline.body.files.load_observations`).
        windows: masks of the frames, from `crop_mask_window`; None without a mask, and for fixed frames.
    """
    observations, landmarks_m = landmarks
    model = surface_model(surface, motion, landmarks_m)
    prior, active = pose_prior(model), list(model.full_joint_indices)
    rotations = quaternion_to_matrix(torch.from_numpy(motion.rotations_wxyz).double())
    state = FitState(
        rotations=rotations[:, active],
        root_m=torch.from_numpy(motion.root_translation_m).double(),
        shape=model.shape,
        landmark_offsets_m=torch.zeros(LANDMARK_OFFSET_COUNT, dtype=torch.float64),
        intrinsics_delta=torch.zeros(INTRINSICS_COUNT, dtype=torch.float64),
    )
    match = partial(match_silhouettes, model, observations=observations, windows=windows, is_clothed=True)
    contour, iou_before = match(state)
    posture: Posture | None = None
    for number in track(range(settings.pose_rounds), "poses through the mesh"):
        root_perspective = world_to_perspective(state.root_m, observations.camera)
        objective = Objective(
            model=model,
            regressor=fixed_landmarks(landmarks_m),
            pose_prior=prior,
            shape_prior=ShapePrior(*[model.shape] * 4),
            observations=observations,
            parameters=_energy_parameters(settings),
            px_per_m=compute_px_per_m(state, observations.camera),
            contour=contour,
            motion_std=estimate_motion_std(state.rotations, root_perspective, observations.time_s),
            contact=estimate_floor_contact(
                model, state.rotations, state.root_m, observations.confidence, observations.time_s
            ),
            free_frames=torch.from_numpy(~is_fixed),
        )
        if number == 0:
            posture = objective.estimate_posture(prior, state)
        tied = prior_of_recording(prior, posture, state.rotations, observations.time_s)
        objective = replace(objective, pose_prior=tied)
        state, _ = minimise(state, objective, objective.retract, settings.silhouette_steps)
        contour, iou_after = match(state)
    rotations[:, active] = state.rotations
    refitted = motion.with_pose(continuous_quaternions(matrix_to_quaternion(rotations)).numpy(), state.root_m.numpy())
    return RefittedPoses(select_poses(~is_fixed, refitted, motion), iou_before, iou_after)


def select_poses(use_first: Bool[np.ndarray, "n"], first: Motion, second: Motion) -> Motion:
    """Return the poses of the first motion in the given frames and those of the second in the others."""
    return second.with_pose(
        np.where(use_first[:, None, None], first.rotations_wxyz, second.rotations_wxyz),
        np.where(use_first[:, None], first.root_translation_m, second.root_translation_m),
    )


def _energy_parameters(settings: FitSettings) -> EnergyParameters:
    """Return the parameters of a fit of poses alone to landmarks and outlines."""
    return replace(
        EnergyParameters.from_settings(settings),
        landmark_std_m=settings.silhouette_landmark_std_m,
        hand_std_m=settings.fitted_hand_std_m,
        face_std_m=settings.fitted_face_std_m,
        landmark_3d_std_m=settings.silhouette_landmark_3d_std_m,
        contour_std_m=settings.avatar_contour_std_m,
        free_shape=False,
    )
