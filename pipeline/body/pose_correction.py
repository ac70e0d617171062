"""Corrections of the fitted poses, optimised jointly with the field and smooth over time.

Corrections mend the errors of the fit in single frames, which are correlated over a quarter of a second and have zero
mean. Between training frames they are therefore interpolated as a stationary process of this correlation time, and far
from training frames they are zero.
"""

import numpy as np
import torch
from jaxtyping import Float, Float32, Int
from torch import Tensor

from pipeline.body.body import Body, Motion
from pipeline.geometry.rotation import (
    axis_angle_to_matrix,
    axis_angle_to_quaternion,
    quaternion_conjugate,
    quaternion_multiply,
    quaternion_to_axis_angle,
    quaternion_to_matrix,
)
from pipeline.geometry.skinning import forward_kinematics, skinning_transforms
from pipeline.kernels.common.dispatch import runs_on_numba
from pipeline.kernels.kinematics import FittedPoses, Skeleton, skinning_matrices

CORRECTED_JOINTS = (
    "Hips", "Spine", "Spine1", "Spine2", "Neck", "Head",
    "LeftShoulder", "LeftArm", "LeftForeArm", "LeftHand", "RightShoulder", "RightArm", "RightForeArm", "RightHand",
    "LeftUpLeg", "LeftLeg", "LeftFoot", "RightUpLeg", "RightLeg", "RightFoot",
)  # fmt: skip

TYPICAL_CORRELATION_TIME_S = 0.25
"""Correlation time of learnt corrections (docs/decisions/field.md)."""


class PoseCorrection:
    """An axis-angle vector for each main joint and a translation of the root, for each training frame in time order.

    The correction of a joint is applied before its fitted local rotation: R = R_fit · exp(correction).
    """

    def __init__(self, body: Body, motion: Motion) -> None:
        self.body, self.motion = body, motion
        joints = [body.joint(name) for name in CORRECTED_JOINTS if name in body.joint_names]
        self.joints = torch.tensor(joints)
        frames = len(motion.frame_index)
        self.rotation_rad = torch.zeros(frames, len(joints), 3, requires_grad=True)
        self.shift_m = torch.zeros(frames, 3, requires_grad=True)
        self._joints_m = torch.as_tensor(body.joints_m)
        self._rotations = quaternion_to_matrix(torch.as_tensor(motion.rotations_wxyz))
        self._root_m = torch.as_tensor(motion.root_translation_m)
        correction_row = torch.full((len(body.joint_names),), -1)
        correction_row[self.joints] = torch.arange(len(joints))
        self._skeleton = Skeleton(torch.as_tensor(body.joints_m), torch.as_tensor(body.parents).long(), correction_row)
        intervals_s = np.diff(motion.time_s.astype(np.float64)) if frames > 1 else np.zeros(0)
        relative_intervals = (
            np.maximum(intervals_s / max(np.median(intervals_s), 1e-9), 1e-3) if len(intervals_s) else intervals_s
        )
        self._relative_interval = torch.tensor(relative_intervals, dtype=torch.float32)

    @property
    def size(self) -> int:
        """Number of parameters of a frame: a rotation vector of each joint, and the shift of the root."""
        return 3 * len(self.joints) + 3

    def canonical_to_world(self, rows: Tensor) -> Float[Tensor, "k j 4 4"]:
        """Return the skinning matrices of selected frames, differentiable in the corrections."""
        rotations = self._rotations[rows]
        turned = rotations[:, self.joints] @ axis_angle_to_matrix(self.rotation_rad[rows])
        posed = forward_kinematics(
            rotations.index_copy(1, self.joints, turned),
            self._root_m[rows] + self.shift_m[rows],
            self._joints_m,
            self.body.parents,
        )
        return skinning_transforms(posed, self._joints_m)

    def canonical_to_posed(
        self, rows: Int[Tensor, "k"], world_to_posed: Float[Tensor, "k 4 4"]
    ) -> Float[Tensor, "k j 4 4"]:
        """Return `canonical_to_world` followed by a rigid transform of each frame."""
        if not runs_on_numba(self.rotation_rad):
            return world_to_posed[:, None] @ self.canonical_to_world(rows)
        fitted = FittedPoses(self._rotations[rows], self._root_m[rows], world_to_posed.contiguous())
        return skinning_matrices(self.rotation_rad[rows], self.shift_m[rows], self._skeleton, fitted)

    def temporal_roughness(self) -> Tensor:
        """Return the mean squared change of the corrections between frames over the interval (rad² and dm²)."""
        if len(self.shift_m) < 2:
            return self.shift_m.new_zeros(())
        turn = self.rotation_rad.diff(dim=0).square().sum((1, 2)) / self._relative_interval
        shift = (10 * self.shift_m.diff(dim=0)).square().sum(1) / self._relative_interval
        return (turn + shift).mean()

    def mean_square_correction(self) -> Tensor:
        """Return the mean squared correction (rad² and dm²)."""
        return self.rotation_rad.square().sum((1, 2)).mean() + (10 * self.shift_m).square().sum(1).mean()

    def averaging_weights(self, correlation_s: float) -> Float[Tensor, "n n"]:
        """Return weights that average over the frames near each frame: exp(-interval / correlation_s), rows of sum 1.

        Corrections of near frames are alike with this covariance (see `interpolate_corrections`): a frame can learn
        from the gradients of its neighbours. 0 s: each frame alone.
        """
        time_s = self.motion.time_s.astype(np.float64)
        if correlation_s == 0.0:
            return torch.eye(len(time_s))
        weights = np.exp(-np.abs(time_s[:, None] - time_s) / correlation_s)
        return torch.from_numpy((weights / weights.sum(1, keepdims=True)).astype(np.float32))

    def apply(self, motion: Motion) -> Motion:
        """Return a motion (any frames) with the corrections interpolated to its times (`interpolate_corrections`)."""
        known_s, wanted_s = self.motion.time_s.astype(np.float64), motion.time_s.astype(np.float64)
        rotation_rad = self.rotation_rad.detach().numpy().reshape(len(known_s), -1)
        rotation = interpolate_corrections(wanted_s, known_s, rotation_rad)
        shift = interpolate_corrections(wanted_s, known_s, self.shift_m.detach().numpy())
        quaternions = torch.as_tensor(motion.rotations_wxyz).clone()
        turn = axis_angle_to_quaternion(torch.from_numpy(rotation.reshape(len(wanted_s), -1, 3)))
        quaternions[:, self.joints] = quaternion_multiply(quaternions[:, self.joints], turn)
        return motion.with_pose(quaternions.numpy(), motion.root_translation_m + shift)


def corrections_between(body: Body, first: Motion, second: Motion) -> Float[np.ndarray, "n p"]:
    """Return the corrections (rotation vectors of the corrected joints, then the shift) that lead to another motion."""
    joints = [body.joint(name) for name in CORRECTED_JOINTS if name in body.joint_names]
    from_wxyz, to_wxyz = (torch.as_tensor(motion.rotations_wxyz[:, joints]) for motion in (first, second))
    turns_rad = quaternion_to_axis_angle(quaternion_multiply(quaternion_conjugate(from_wxyz), to_wxyz))
    return np.concatenate([turns_rad.flatten(1), second.root_translation_m - first.root_translation_m], axis=1)


def interpolate_corrections(
    wanted_s: Float[np.ndarray, "m"], known_s: Float[np.ndarray, "n"], corrections: Float[np.ndarray, "n c"]
) -> Float32[np.ndarray, "m c"]:
    """Return corrections at any times from those at known times.

    They are the means of a Gaussian process of zero mean with the covariance exp(-interval / correlation time), given
    the known values (kriging). The process is Markovian, so only the two neighbours in time count: the interpolation
    is linear over gaps that are much shorter than the correlation time, and falls to zero in longer ones and outside.

    known_s: increasing, at least one.
    """
    correlation_s = correlation_time_s(known_s, corrections)
    time_s = np.concatenate([[-np.inf], known_s, [np.inf]])
    values = np.pad(corrections.astype(np.float64), ((1, 1), (0, 0)))
    after = np.clip(np.searchsorted(time_s, wanted_s, side="right"), 1, len(time_s) - 1)
    since = (wanted_s - time_s[after - 1]) / correlation_s
    until = (time_s[after] - wanted_s) / correlation_s
    # sinh(until) / sinh(since + until) and its mirror image, without overflow.
    norm = -np.expm1(-2.0 * (since + until))
    before_weight = np.exp(-since) * -np.expm1(-2.0 * until) / norm
    after_weight = np.exp(-until) * -np.expm1(-2.0 * since) / norm
    interpolated = before_weight[:, None] * values[after - 1] + after_weight[:, None] * values[after]
    return interpolated.astype(np.float32)


def correlation_time_s(time_s: Float[np.ndarray, "n"], corrections: Float[np.ndarray, "n c"]) -> float:
    """Estimate the time (s) over which the correlation of corrections falls to 1 / e, from successive frames.

    Pairs of frames more than twice the median interval apart are not used. The result is at least a tenth of the mean
    interval of the pairs, and at most ten times: a longer correlation cannot be told from a constant. One frame alone
    has `TYPICAL_CORRELATION_TIME_S`.
    """
    if len(time_s) < 2:
        return TYPICAL_CORRELATION_TIME_S
    interval_s = np.diff(time_s)
    near = interval_s <= 2.0 * np.median(interval_s)
    first, second = corrections[:-1][near], corrections[1:][near]
    power = np.sqrt(np.square(first).sum() * np.square(second).sum())
    correlation = (first * second).sum() / power if power > 0.0 else 0.0
    return float(interval_s[near].mean() / -np.log(np.clip(correlation, np.exp(-10.0), np.exp(-0.1))))
