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
from jaxtyping import Bool, Float
from torch import Tensor

from pipeline.body.fit.prior.priors import (
    UNCONSTRAINED_RAD,
    PosePrior,
    inverse_left_jacobian_so3,
    rotation_to_axis_angle,
    tilt_of_hips,
)

MIN_SPREAD_RAD, MAX_SPREAD_RAD, SPREADS = 0.01, 1.0, 41
"""Range and number of the spreads tried: whoever stands as still as possible sways by half a degree."""
POSTURE_TIME_S = 0.5
LOOSE_STD_RAD = 0.25
"""Standard deviation from which the prior of an angle is loose: only such angles are tied."""
MAX_MEAN_FACING_LENGTH = 0.75
"""Length of the mean of the unit vectors in which the hips face: 0 for a full turn, 0.64 for half of one."""
STILL_SLACK, MIN_STILL_SPREAD_RAD, MAX_STILL_SLACK_RAD = 3.0, 0.02, 0.25
"""Without a posture: slack in spreads, smallest spread, and slack from which a joint is taken to move."""
DAMPING = 1e-6


@dataclass(frozen=True)
class Posture:
    """Mean and spread (rad) of the angles of all active joints in the axes of the prior, then of `tilt_of_hips`."""

    mean_rad: Float[Tensor, "d"]
    spread_rad: Float[Tensor, "d"]


def estimate_posture(
    prior: PosePrior,
    rotations: Float[Tensor, "n j 3 3"],
    time_s: Float[Tensor, "n"],
    hessian: Float[Tensor, "n p p"],
) -> Posture | None:
    """Return the posture of fitted poses; None if it cannot be known.

    An angle that the image hardly shows is taken to move as the others do: no spread is below their root mean square.
    Whoever is filmed from one side has no frames that show what the others hide: the posture is not known.

    Args:
        prior: the prior of anyone. Poses that were tied to a posture already lie too near to its mean.
        rotations: fitted poses.
        time_s: of the frames.
        hessian: of the energy of image and `prior` at these poses, for each frame (`Objective.image_hessian`).
    """
    if not is_filmed_from_all_sides(rotations):
        return None
    angle_rad, variance = _angles(prior, rotations, hessian)
    posture = most_likely_posture(angle_rad, variance / frames_per_posture(time_s))
    typical_rad = posture.spread_rad[_is_loose(prior)].square().mean().sqrt()
    return replace(posture, spread_rad=posture.spread_rad.clamp(min=float(typical_rad)))


def most_likely_posture(angle_rad: Float[Tensor, "n d"], variance: Float[Tensor, "n d"]) -> Posture:
    """Return the posture from angles of independent observations and their variances (rad^2)."""
    spread_rad = torch.logspace(math.log10(MIN_SPREAD_RAD), math.log10(MAX_SPREAD_RAD), SPREADS, dtype=angle_rad.dtype)
    weight = 1.0 / (spread_rad[:, None, None] ** 2 + variance)
    mean_rad = (weight * angle_rad).sum(1) / weight.sum(1)
    log_likelihood = 0.5 * (weight.log() - weight * (angle_rad - mean_rad[:, None]).square()).sum(1)
    best = log_likelihood.argmax(0)
    return Posture(mean_rad.gather(0, best[None])[0], spread_rad[best])


def prior_of_recording(
    prior: PosePrior, posture: Posture | None, rotations: Float[Tensor, "n j 3 3"], time_s: Float[Tensor, "n"]
) -> PosePrior:
    """Return the pose prior of a recording: tied to its posture, or the still joints to their mean if it is unknown."""
    return tie_still_joints(prior, rotations) if posture is None else tie_to_posture(prior, posture, time_s)


def tie_to_posture(prior: PosePrior, posture: Posture, time_s: Float[Tensor, "n"]) -> PosePrior:
    """Return the prior of each frame of a recording: the posture, where it is tighter than a loose prior of anyone."""
    anyone_mean_rad = torch.cat([prior.mean_rad.flatten(), prior.tilt_mean])
    anyone_std_rad = torch.cat([prior.std_rad.flatten(), prior.tilt_std])
    std_rad = frames_per_posture(time_s) ** 0.5 * posture.spread_rad
    is_tighter = _is_loose(prior) & (std_rad < anyone_std_rad)
    mean_rad = torch.where(is_tighter, posture.mean_rad, anyone_mean_rad)
    std_rad = torch.where(is_tighter, std_rad, anyone_std_rad)
    return replace(
        prior,
        mean_rad=mean_rad[:-2].reshape(-1, 3),
        std_rad=std_rad[:-2].reshape(-1, 3),
        tilt_mean=mean_rad[-2:],
        tilt_std=std_rad[-2:],
    )


def is_filmed_from_all_sides(rotations: Float[Tensor, "n j 3 3"]) -> bool:
    """Return whether the hips face in so many directions that frames show what others hide."""
    facing = torch.nn.functional.normalize(rotations[:, 0, ::2, 2], dim=-1)
    return float(facing.mean(0).norm()) <= MAX_MEAN_FACING_LENGTH


def _is_loose(prior: PosePrior) -> Bool[Tensor, "d"]:
    """Return which angles have a loose prior: those of the limbs and the tilt of the hips, not of the spine."""
    loose = (prior.std_rad >= LOOSE_STD_RAD) & (prior.std_rad < UNCONSTRAINED_RAD)
    return torch.cat([loose.flatten(), torch.ones(2, dtype=torch.bool)])


def tie_still_joints(prior: PosePrior, rotations: Float[Tensor, "n j 3 3"]) -> PosePrior:
    """Return the prior with joints that hardly move tied to their mean; for recordings without a known posture.

    Only axes with a loose prior and a slack below `MAX_STILL_SLACK_RAD` are changed.
    """
    angle_rad = (prior.axes @ rotation_to_axis_angle(rotations)[..., None]).squeeze(-1)
    slack_rad = STILL_SLACK * (angle_rad.var(0, correction=0) + MIN_STILL_SPREAD_RAD**2).sqrt()
    is_still = _is_loose(prior)[:-2].reshape(-1, 3) & (slack_rad < MAX_STILL_SLACK_RAD)
    return replace(
        prior,
        mean_rad=torch.where(is_still, angle_rad.mean(0), prior.mean_rad),
        std_rad=torch.where(is_still, slack_rad, prior.std_rad),
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
