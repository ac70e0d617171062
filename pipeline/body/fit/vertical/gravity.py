"""The vertical of a recording: the world of a fit is turned until +Y is up, and its floor is y = 0.

Evidence of the tilt of the vertical, each with a standard deviation: a camera is held nearly level, the axis of a turn
in the images (module `turn_axis`), the floor through the standing soles, and the axis of the body over a
turn. Where nobody turns or walks, the camera stays level. A tilt is the slope (x, z) of the vertical in a
world whose y axis is nearly vertical: the vertical is (x, 1, z), normalised.

Silhouettes tell the vertical of a turn as well as its landmarks do, which err by several degrees at times: between
rounds of the fit the world is turned towards where the bodies would stand upright in the mean (`upright_turn`).

Dimensions: n frames.
"""

from dataclasses import dataclass, replace

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from pipeline.body.fit.ground_contact import Contact, estimate_floor_contact, floor_tilt_information, sole_points
from pipeline.body.fit.initialisation import facing_yaw_rad, has_torso_landmarks, in_world_axes, torso_rotations
from pipeline.body.fit.linear_body import ACTIVE_JOINTS, LinearBody
from pipeline.body.fit.posed_points import PosedSkeleton, pose_points, pose_skeleton
from pipeline.body.fit.state import FitState, Observations
from pipeline.body.fit.vertical.turn_axis import MAX_YAW_RESULTANT, TurnAxis, yaw_resultant
from pipeline.body.settings import FitSettings
from pipeline.geometry.camera import Camera
from pipeline.geometry.rotation import rotation_between

POSTURE_STD_RAD = 0.15
"""Standard deviation of the lean of a person in the frame of the body, which a turn separates from the vertical."""

MIN_AXIS_STD_RAD = np.radians(0.7)
"""Least standard deviation of the axis of a turn: median of its errors on six turns, whose largest was 4.4 degrees."""

DOUBT_STDS = 2.0
"""Contradiction, in standard deviations, at which evidence has a quarter of its weight."""

LEAN_GAIN_RIGHT, LEAN_GAIN_TOWARDS = 1.0, 1.7
"""Turn of the world over the mean lean of the bodies. Towards the camera a round moves them two fifths of the way: the
priors hold them upright in the present world, and a lean along the view changes a silhouette little."""
USUAL_ELEVATION_RAD, LEAN_OF_ELEVATION = np.radians(2.5), 0.075
"""Mean lean towards the camera of bodies in the true world, over the elevation of their necks above the camera beyond
the usual one. The detector underrates perspective: it sees near and far shoulders nearly at one height. Without, level
cameras at 3.6 m were found tilted by -0.5 degrees, those that look up by 5 to 25 degrees by -0.9 to -2.8."""
MAX_TURN_RAD = np.radians(5.0)
"""Largest turn of the world between two rounds."""

FLOOR_PERCENTILE = 10.0
"""Percentile of the lowest soles that is the floor where no contact was found."""


@dataclass(frozen=True)
class TiltEvidence:
    """Gaussian evidence of the tilt of the vertical: its information matrix (1 / rad²) and that times its mean."""

    information: Float[Tensor, "2 2"]
    weighted_tilt: Float[Tensor, "2"]

    @staticmethod
    def from_std(tilt_rad: Float[Tensor, "2"], std_rad: Float[Tensor, "2"]) -> "TiltEvidence":
        """Return independent evidence of both tilts."""
        information = torch.diag(std_rad**-2)
        return TiltEvidence(information, information @ tilt_rad)

    def __add__(self, other: "TiltEvidence") -> "TiltEvidence":
        return TiltEvidence(self.information + other.information, self.weighted_tilt + other.weighted_tilt)

    def doubted(self, tilt_rad: Float[Tensor, "2"]) -> "TiltEvidence":
        """Return the evidence with less weight the more it contradicts another tilt (Geman and McClure, 1985)."""
        difference = torch.linalg.solve(self.information, self.weighted_tilt) - tilt_rad
        weight = (1.0 + difference @ self.information @ difference / DOUBT_STDS**2) ** -2
        return TiltEvidence(weight * self.information, weight * self.weighted_tilt)

    def about(self, up: Float[Tensor, "3"]) -> "TiltEvidence":
        """Return evidence of the same precision that has another most probable vertical."""
        return TiltEvidence(self.information, self.information @ up[[0, 2]] / up[1])

    def up(self) -> Float[Tensor, "3"]:
        """Return the most probable vertical."""
        right, towards = torch.linalg.solve(self.information, self.weighted_tilt).tolist()
        return torch.nn.functional.normalize(torch.tensor([right, 1.0, towards], dtype=torch.float64), dim=0)


def level_evidence(settings: FitSettings) -> TiltEvidence:
    """Return the evidence that a camera is held nearly level."""
    none = torch.zeros(2, dtype=torch.float64)
    return TiltEvidence.from_std(none, none + np.radians(settings.camera_tilt_std_deg))


def axis_evidence(axis: TurnAxis | None, settings: FitSettings) -> TiltEvidence:
    """Return what is known of the vertical before the fit, in the world of a level camera.

    axis: None if the person hardly turns.
    """
    evidence = level_evidence(settings)
    if axis is None:
        return evidence
    std_rad = torch.from_numpy(axis.std_rad).clamp_min(MIN_AXIS_STD_RAD)
    return evidence + TiltEvidence.from_std(torch.from_numpy(axis.tilt_rad), std_rad)


def upright_turn(
    model: LinearBody, state: FitState, evidence: TiltEvidence, settings: FitSettings, camera: Camera
) -> Float[Tensor, "3 3"]:
    """Return the rotation to the most probable world, in which the bodies stand upright in the mean.

    No rotation without a turn, over which a lean of the person cannot be told from one of the world.

    evidence: what was known before the fit, in the world of the state. camera: in that world.
    """
    skeleton = pose_skeleton(model, state.rotations, state.root_m)
    yaw_rad = facing_yaw_rad(skeleton.rotation[:, 0])
    if yaw_resultant(yaw_rad.numpy()) > MAX_YAW_RESULTANT:
        return torch.eye(3, dtype=torch.float64)
    gain = torch.tensor([LEAN_GAIN_RIGHT, LEAN_GAIN_TOWARDS], dtype=torch.float64)
    lean_rad = (gain * unbiased_lean_rad(skeleton, yaw_rad, camera)).clamp(-MAX_TURN_RAD, MAX_TURN_RAD)
    std_rad = torch.full_like(lean_rad, np.radians(settings.body_axis_std_deg))
    up = (evidence.doubted(lean_rad) + TiltEvidence.from_std(lean_rad, std_rad)).up()
    return rotation_between(up, _y_axis())


def turn_world(observations: Observations, rotation: Float[Tensor, "3 3"]) -> Observations:
    """Return the observations in a world turned by `rotation`; the torso of the 3D landmarks stays upright in it."""
    return replace(observations, camera=turn_camera(observations.camera, rotation, torch.zeros(3, dtype=torch.float64)))


def turn_observations(
    observations: Observations,
    up: Float[Tensor, "3"],
    axis: TurnAxis | None,
    rest_landmarks_m: Float[Tensor, "l 3"],
) -> Observations:
    """Return the observations in the world in which `up` is +Y; on a turn, with 3D landmarks whose torso is upright.

    The detector reports a part of the tilt of the camera only, and the fit would start from there. The camera gets the
    focal length at which the turn was seen.

    axis: None if the person hardly turns.
    """
    to_vertical = rotation_between(up, _y_axis())
    camera = observations.camera
    if axis is not None:
        zoom = float(np.exp(axis.focal_log))
        camera = replace(camera, fx=camera.fx * zoom, fy=camera.fy * zoom)
    turned = replace(
        observations,
        landmarks_3d_m=observations.landmarks_3d_m @ to_vertical.T,
        camera=turn_camera(camera, to_vertical, torch.zeros(3, dtype=torch.float64)),
    )
    if axis is None:
        return turned
    rotation = torso_rotations(rest_landmarks_m, in_world_axes(turned)[has_torso_landmarks(observations)])
    to_upright = rotation_between(rotation[:, :, 1].mean(0), _y_axis())
    return replace(turned, landmarks_3d_m=turned.landmarks_3d_m @ to_upright.T)


def align_with_gravity(
    model: LinearBody, state: FitState, observations: Observations, evidence: TiltEvidence, settings: FitSettings
) -> tuple[FitState, Observations]:
    """Return fitted poses and their observations in the vertical world whose floor is y = 0; the images stay the same.

    evidence: what was known before the fit, in the world of the state.
    """
    contact = estimate_floor_contact(model, state.rotations, state.root_m, observations.confidence, observations.time_s)
    level = torch.zeros(2, dtype=torch.float64)
    up = (evidence.doubted(level) + fitted_evidence(model, state, contact, settings)).up()
    to_vertical = rotation_between(up, _y_axis())
    translation_m = -floor_height_m(model, state, contact, up) * _y_axis()
    aligned = replace(
        observations,
        landmarks_3d_m=observations.landmarks_3d_m @ to_vertical.T,
        camera=turn_camera(observations.camera, to_vertical, translation_m),
    )
    return turn_state(state, to_vertical, translation_m), aligned


def fitted_evidence(model: LinearBody, state: FitState, contact: Contact | None, settings: FitSettings) -> TiltEvidence:
    """Return the evidence of a fit in its world: the floor under the soles, and the axis of the body over a turn."""
    skeleton = pose_skeleton(model, state.rotations, state.root_m)
    none = torch.zeros(2, dtype=torch.float64)
    evidence = TiltEvidence(torch.zeros(2, 2, dtype=torch.float64), none)
    if contact is not None:
        soles_m = pose_points(model, skeleton, contact.points).world_m
        normal, information = contact.axes[0], floor_tilt_information(soles_m, contact.weight[..., 0])
        tilt = torch.stack([normal[0], normal[2]]) / normal[1]
        evidence += TiltEvidence(information, information @ tilt)
    yaw_rad = facing_yaw_rad(skeleton.rotation[:, 0])
    if yaw_resultant(yaw_rad.numpy()) <= MAX_YAW_RESULTANT:
        std = none + np.radians(settings.body_axis_std_deg)
        evidence += TiltEvidence.from_std(mean_lean_rad(body_axes(skeleton), yaw_rad), std)
    return evidence


def body_axes(skeleton: PosedSkeleton) -> Float[Tensor, "n 3"]:
    """Return the directions from the middle of the hip joints to the base of the neck."""
    left, right, neck = (ACTIVE_JOINTS.index(name) for name in ("LeftUpLeg", "RightUpLeg", "Neck"))
    position_m = skeleton.position_m
    axis = position_m[:, neck] - 0.5 * (position_m[:, left] + position_m[:, right])
    return torch.nn.functional.normalize(axis, dim=-1)


def lean_deg(model: LinearBody, state: FitState) -> float:
    """Return the angle between +Y and the mean axis of the body."""
    mean = body_axes(pose_skeleton(model, state.rotations, state.root_m)).mean(0)
    return float(torch.rad2deg(torch.atan2(mean[[0, 2]].norm(), mean[1])))


def unbiased_lean_rad(skeleton: PosedSkeleton, yaw_rad: Float[Tensor, "n"], camera: Camera) -> Float[Tensor, "2"]:
    """Return the tilt that all bodies share, without what they lean towards the camera in the true world."""
    from_camera_m = skeleton.position_m[:, ACTIVE_JOINTS.index("Neck")] - torch.from_numpy(camera.centre_m())
    elevation_rad = torch.atan2(from_camera_m[:, 1], from_camera_m[:, [0, 2]].norm(dim=1)).mean()
    bias_rad = LEAN_OF_ELEVATION * (elevation_rad - USUAL_ELEVATION_RAD).clamp_min(0.0)
    return mean_lean_rad(body_axes(skeleton), yaw_rad) - torch.stack([torch.zeros_like(bias_rad), bias_rad])


def mean_lean_rad(axes: Float[Tensor, "n 3"], yaw_rad: Float[Tensor, "n"]) -> Float[Tensor, "2"]:
    """Return the tilt that all axes share, apart from a lean that is constant in the frame of the body.

    Least squares; a prior keeps the lean of the body near 0 (`POSTURE_STD_RAD`). Each frame counts as one with a
    standard deviation of 0.05 rad.
    """
    slope = axes[:, [0, 2]] / axes[:, 1:2]
    sine, cosine, one, zero = yaw_rad.sin(), yaw_rad.cos(), torch.ones_like(yaw_rad), torch.zeros_like(yaw_rad)
    right = torch.stack([one, zero, cosine, sine], dim=-1)
    towards = torch.stack([zero, one, -sine, cosine], dim=-1)
    design, values = torch.cat([right, towards]), slope.T.flatten()
    prior = torch.diag((0.05 / POSTURE_STD_RAD) ** 2 * design.new_tensor([1e-6, 1e-6, 1.0, 1.0]))
    return torch.linalg.solve(design.T @ design + prior, design.T @ values)[:2]


def floor_height_m(model: LinearBody, state: FitState, contact: Contact | None, up: Float[Tensor, "3"]) -> float:
    """Return the height of the floor along `up`: the standing soles', or a low percentile of the lowest ones."""
    skeleton = pose_skeleton(model, state.rotations, state.root_m)
    height_m = pose_points(model, skeleton, sole_points(model)).world_m @ up
    if contact is None:
        return float(np.percentile(height_m.min(1).values.numpy(), FLOOR_PERCENTILE))
    weight = contact.weight[..., 0]
    return float((weight * height_m).sum() / weight.sum())


def turn_camera(camera: Camera, rotation: Float[Tensor, "3 3"], translation_m: Float[Tensor, "3"]) -> Camera:
    """Return the camera in a world turned by `rotation`, then moved by `translation_m`; its images do not change."""
    world_to_camera = camera.world_to_camera.astype(np.float64)
    turned = np.eye(4)
    turned[:3, :3] = world_to_camera[:3, :3] @ rotation.numpy().T
    turned[:3, 3] = world_to_camera[:3, 3] - turned[:3, :3] @ translation_m.numpy()
    return replace(camera, world_to_camera=turned.astype(np.float32))


def turn_state(state: FitState, rotation: Float[Tensor, "3 3"], translation_m: Float[Tensor, "3"]) -> FitState:
    """Return the state in a world turned by `rotation`, then moved by `translation_m`."""
    rotations = state.rotations.clone()
    rotations[:, 0] = rotation @ rotations[:, 0]
    return replace(state, rotations=rotations, root_m=state.root_m @ rotation.T + translation_m)


def camera_tilt_deg(camera: Camera) -> tuple[float, float]:
    """Return pitch (of the optical axis above the horizon) and clockwise roll of a camera, degrees; +Y is up."""
    right, down, forward = camera.world_to_camera[:3, 1].astype(np.float64)
    return float(np.degrees(np.arcsin(np.clip(forward, -1.0, 1.0)))), float(np.degrees(np.arctan2(-right, -down)))


def _y_axis() -> Float[Tensor, "3"]:
    return torch.tensor([0.0, 1.0, 0.0], dtype=torch.float64)
