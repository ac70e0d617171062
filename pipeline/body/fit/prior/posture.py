"""Posture of a recording: the mean and the spread of each joint angle and of the tilt of the hips.

One camera sees how far an arm is raised, but hardly how far it is swung towards it; a quarter turn later it is the
other way around. The image leaves the angle a_t of frame t a standard deviation s_t. Mean m and spread S of the angles
maximise the likelihood of a_t ~ N(m, S^2 + s_t^2), a random-effects model (DerSimonian and Laird, "Meta-analysis in
clinical trials", 1986); then they become the prior of the angle (empirical Bayes). Whoever stands still has a small
spread, and what a frame does not show follows the frames that do. Whoever dances has a large one, which ties nothing.

Angles stay where they are for `POSTURE_TIME_S`: the frames of this time count as one observation of the posture.

Dimensions: n frames, j active joints, p = 3 j + 3 parameters of a frame, d = 3 j + 2 angles.
"""

import math
from dataclasses import dataclass, replace

import torch
from jaxtyping import Float
from torch import Tensor

from pipeline.body.fit.prior.priors import PosePrior, inverse_left_jacobian_so3, rotation_to_axis_angle, tilt_of_hips

MIN_SPREAD_RAD, MAX_SPREAD_RAD, SPREADS = 0.01, 1.0, 41
"""Range and number of the spreads tried: whoever stands as still as possible sways by half a degree."""
POSTURE_TIME_S = 0.5
DAMPING = 1e-6


@dataclass(frozen=True)
class Posture:
    """Mean and spread (rad) of the angles of all active joints in the axes of the prior, then of `tilt_of_hips`."""

    mean_rad: Float[Tensor, "d"]
    spread_rad: Float[Tensor, "d"]


def unknown_posture(prior: PosePrior) -> Posture:
    """Return the posture of anyone."""
    return Posture(
        torch.cat([prior.mean_rad.flatten(), prior.tilt_mean]), torch.cat([prior.std_rad.flatten(), prior.tilt_std])
    )


def estimate_posture(
    prior: PosePrior,
    rotations: Float[Tensor, "n j 3 3"],
    time_s: Float[Tensor, "n"],
    hessian: Float[Tensor, "n p p"],
) -> Posture:
    """Return the posture of fitted poses.

    Args:
        prior: the prior of anyone, with which the poses were fitted: those that are tied to a posture already lie too
            near to its mean.
        rotations: fitted poses.
        time_s: of the frames.
        hessian: of the energy of image and `prior` at these poses, for each frame (`Objective.image_hessian`).
    """
    angle_rad, variance = _angles(prior, rotations, hessian)
    return most_likely_posture(angle_rad, variance / frames_per_posture(time_s))


def most_likely_posture(angle_rad: Float[Tensor, "n d"], variance: Float[Tensor, "n d"]) -> Posture:
    """Return the posture from angles of independent observations and their variances (rad^2)."""
    spread_rad = torch.logspace(math.log10(MIN_SPREAD_RAD), math.log10(MAX_SPREAD_RAD), SPREADS, dtype=angle_rad.dtype)
    weight = 1.0 / (spread_rad[:, None, None] ** 2 + variance)
    mean_rad = (weight * angle_rad).sum(1) / weight.sum(1)
    log_likelihood = 0.5 * (weight.log() - weight * (angle_rad - mean_rad[:, None]).square()).sum(1)
    best = log_likelihood.argmax(0)
    return Posture(mean_rad.gather(0, best[None])[0], spread_rad[best])


def tie_to_posture(prior: PosePrior, posture: Posture, time_s: Float[Tensor, "n"]) -> PosePrior:
    """Return the prior of each frame of a recording: the posture, where it is tighter than the prior of anyone."""
    anyone = unknown_posture(prior)
    std_rad = frames_per_posture(time_s) ** 0.5 * posture.spread_rad
    is_tighter = std_rad < anyone.spread_rad
    mean_rad = torch.where(is_tighter, posture.mean_rad, anyone.mean_rad)
    std_rad = torch.where(is_tighter, std_rad, anyone.spread_rad)
    return replace(
        prior,
        mean_rad=mean_rad[:-2].reshape(-1, 3),
        std_rad=std_rad[:-2].reshape(-1, 3),
        tilt_mean=mean_rad[-2:],
        tilt_std=std_rad[-2:],
    )


def frames_per_posture(time_s: Float[Tensor, "n"]) -> float:
    """Return the number of frames in `POSTURE_TIME_S`, at least 1."""
    duration_s = float(time_s[-1] - time_s[0])
    return max(1.0, POSTURE_TIME_S * (len(time_s) - 1) / duration_s) if duration_s > 0.0 else 1.0


def _angles(
    prior: PosePrior, rotations: Float[Tensor, "n j 3 3"], hessian: Float[Tensor, "n p p"]
) -> tuple[Float[Tensor, "n d"], Float[Tensor, "n d"]]:
    """Return the angles and their variances."""
    covariance = torch.linalg.inv(hessian + DAMPING * torch.eye(hessian.shape[-1], dtype=hessian.dtype))
    joints = rotations.shape[1]
    blocks = torch.stack([covariance[:, 3 * k : 3 * k + 3, 3 * k : 3 * k + 3] for k in range(joints)], dim=1)
    vector = rotation_to_axis_angle(rotations)
    angle_rad = (prior.axes @ vector[..., None]).squeeze(-1)
    variance = _variance(prior.axes @ inverse_left_jacobian_so3(vector), blocks)
    tilt_rad, tilt_jacobian = tilt_of_hips(rotations[:, 0])
    return (
        torch.cat([angle_rad.flatten(1), tilt_rad], dim=1),
        torch.cat([variance.flatten(1), _variance(tilt_jacobian, blocks[:, 0])], dim=1),
    )


def _variance(jacobian: Float[Tensor, "*n a 3"], covariance: Float[Tensor, "*n 3 3"]) -> Float[Tensor, "*n a"]:
    """Return the diagonal of J C J^T."""
    return ((jacobian @ covariance) * jacobian).sum(-1)
