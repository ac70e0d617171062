"""The axis of a turn, or of an arc of it, in the images alone: the vertical, seen by a camera that need not be level.

The 3D landmarks of the detector report 30 to 70 % of a camera's pitch. Their pixels show all of it: a point of a body
that turns about the vertical describes an ellipse, flatter the more level it is seen. Unknowns: one rigid body, its yaw
and its place on the floor in each frame, and the axis. They are fitted to the pixels by robust least squares (bundle
adjustment: Triggs et al., 2000). What sways about the mean pose is noise to it.

Axes of this module: y up, z towards the camera, of a level camera. The distance of the camera is the unit of length.
Dimensions: k frames, m landmarks.
"""

from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Float, Int
from scipy.optimize import least_squares

from pipeline.body.fit.state import Observations
from pipeline.body.settings import FitSettings
from pipeline.capture.frame_selection import evenly_spaced

AXIS_LANDMARKS = (7, 8, 11, 12, 13, 14, 15, 16, 23, 24, 25, 26, 27, 28, 29, 30, 31, 32)
"""Ears, shoulders, elbows, wrists, hips, knees, ankles, heels, tips of the feet; left and right alternate."""

HIPS_AND_SHOULDERS_LEFT, HIPS_AND_SHOULDERS_RIGHT = (11, 23), (12, 24)
MAX_FRAMES = 24
MIN_FRAMES = 8
MAX_EVALUATIONS = 200
COST_TOLERANCE = 1e-5
"""Relative gain at which the fit ends. Costs are some hundred squared deviations: 0.05 deviations are left to gain."""

MAX_YAW_RESULTANT, MAX_ARC_RESULTANT = 0.5, 0.98
"""Lengths of the mean of the facing directions (`yaw_resultant`) up to which a recording counts as a turn, and as an
arc that shows its axis: 0 for a full turn, 0.5 for an arc of 217 degrees, 0.98 for one of 40 degrees."""

LANDMARK_STD_RATIO, SYMMETRY_STD_RATIO = 0.01, 0.012
"""Standard deviations of a landmark in the image and of the symmetry of the body, over the height of the landmarks."""

MAX_FOCAL_LOG = 2.0 * FitSettings.initial_focal_std
"""Logarithm of the focal length over the initial one beyond which there is no evidence: a factor of 2.7 either way,
views of 17 to 97 degrees. A camera in the hand, which drifts up and down, looked like a lens of 100 times that."""

MAX_RESIDUAL_RATIO, MAX_ARC_RESIDUAL_RATIO = 0.03, 0.014
"""Median distance of the landmarks from the rigid body, over their height, above which a turn and an arc are no
evidence: a walk whose limbs swing is no rigid body. Arcs had 0.003 to 0.009, a walk and a juggler 0.023 to 0.028."""

ARC_FOCAL_LOG_STD = 0.06
"""Standard deviation of an unknown log focal length in the fit of an arc, which hardly shows it: a loose one makes the
tilt worse (docs/decisions/body.md)."""

STD_FACTOR = 2.0
"""True over formal standard deviation: errors of neighbouring frames are alike (1 to 2 degrees on three turns)."""

TILT_DIFFERENCE_STEP = 1e-6
"""Step of the central differences of `axis_rotation`, whose error is then 1e-11."""

COMMON_FOCAL_LOG_STD = 0.1
"""Standard deviation of the log focal length that any number of landmarks leaves; errors were -0.10 to 0.04."""

CONTRADICTION_STDS = 2.5
"""Standard deviations between a supplied focal length and that of a turn above which the user is told.

About a factor of 1.4. Errors of the estimate on two captures were -0.03 (0.2 standard deviations) and -0.31 (2.1)."""


@dataclass(frozen=True)
class TurnAxis:
    """Direction of the axis of a turn.

    tilt_rad: slope of the axis to the right and towards a level camera: the axis is (right, 1, towards), normalised.
    std_rad: of each.
    focal_log, focal_log_std: logarithm of the focal length over the camera's, and its standard deviation.
    is_arc: whether it is the axis of an arc, which shows the focal length less than a turn does.
    """

    tilt_rad: Float[np.ndarray, "2"]
    std_rad: Float[np.ndarray, "2"]
    focal_log: float
    focal_log_std: float
    is_arc: bool = False


@dataclass(frozen=True)
class _Problem:
    """Rays of the landmarks (x right, y up, at z = -1), their weights, and the start of the unknowns.

    The weight, which multiplies the residual, is the squared confidence: the detector guesses hidden landmarks of an
    upright person. Pitch of two cameras at 15.1 degrees with powers 1, 2, 4: 13.4, 13.8, 13.8 and 12.9, 13.1, 13.1.
    """

    rays: Float[np.ndarray, "k m 2"]
    weight: Float[np.ndarray, "k m 1"]
    start_body: Float[np.ndarray, "m 3"]
    start_yaw_rad: Float[np.ndarray, "k"]
    height: float
    focal_log_std: float

    def unpack(
        self, unknowns: Float[np.ndarray, "u"]
    ) -> tuple[Float[np.ndarray, "m 3"], Float[np.ndarray, "k"], Float[np.ndarray, "k 2"], Float[np.ndarray, "4"]]:
        """Return the body, yaw and place on the floor of each frame, and (middle height, two tilts, focal_log)."""
        frames, points = self.rays.shape[:2]
        body, yaw, place, rest = np.split(unknowns, np.cumsum([3 * points, frames, 2 * frames]))
        return body.reshape(points, 3), yaw, place.reshape(frames, 2), rest

    def start(self) -> Float[np.ndarray, "u"]:
        """Return the unknowns of the body of the detector on a level turn."""
        place = np.zeros(2 * len(self.rays))
        middle = float(np.average(self.rays[..., 1], weights=self.weight[..., 0])) - self.start_body[:, 1].mean()
        return np.concatenate([self.start_body.ravel(), self.start_yaw_rad, place, [middle, 0.0, 0.0, 0.0]])

    def turned(self, unknowns: Float[np.ndarray, "u"]) -> Float[np.ndarray, "k m 3"]:
        """Return the body at its yaw and place in each frame, before the axis is tilted."""
        body, yaw, place, _ = self.unpack(unknowns)
        sine, cosine = np.sin(yaw)[:, None], np.cos(yaw)[:, None]
        return np.stack(
            [
                cosine * body[:, 0] + sine * body[:, 2] + place[:, :1],
                np.broadcast_to(body[:, 1], self.rays.shape[:2]),
                cosine * body[:, 2] - sine * body[:, 0] + place[:, 1:],
            ],
            axis=-1,
        )

    def seen(self, unknowns: Float[np.ndarray, "u"]) -> Float[np.ndarray, "k m 3"]:
        """Return the body in the axes of the level camera."""
        middle, right, towards, _ = self.unpack(unknowns)[3]
        return self.turned(unknowns) @ axis_rotation(right, towards).T + [0.0, middle, -1.0]

    def reprojection(self, unknowns: Float[np.ndarray, "u"]) -> Float[np.ndarray, "k m 2"]:
        """Return the distances of the projected body from the rays, over the height of the landmarks."""
        seen = self.seen(unknowns)
        return (np.exp(unknowns[-1]) * seen[..., :2] / -seen[..., 2:] - self.rays) / self.height

    def residuals(self, unknowns: Float[np.ndarray, "u"]) -> Float[np.ndarray, "r"]:
        """Return all residuals in standard deviations; the gauge fixes what an image does not show."""
        body, yaw, place, _ = self.unpack(unknowns)
        asymmetry = (body[::2] * [-1.0, 1.0, 1.0] - body[1::2]) / (self.height * SYMMETRY_STD_RATIO)
        offset = body[:, :2].mean(0) - self.start_body[:, :2].mean(0)
        gauge = [*offset, *place.mean(0), yaw.mean() - self.start_yaw_rad.mean()]
        pixels = self.weight * self.reprojection(unknowns) / LANDMARK_STD_RATIO
        return np.concatenate(
            [pixels.ravel(), asymmetry.ravel(), np.array(gauge) / 1e-3, unknowns[-1:] / self.focal_log_std]
        )

    def jacobian(self, unknowns: Float[np.ndarray, "u"]) -> Float[np.ndarray, "r u"]:
        """Return the derivative of the residuals."""
        body, yaw, _, (_, right, towards, focal_log) = self.unpack(unknowns)
        (frames, points), unknown_count = self.rays.shape[:2], len(unknowns)
        axes, seen = axis_rotation(right, towards), self.seen(unknowns)
        frame, point = np.arange(frames), np.arange(points)
        # Derivative of `seen`; unknowns as `unpack` splits them.
        parts = np.zeros((frames, points, 3, unknown_count))
        of_body, of_yaw, of_place, of_rest = np.split(parts, np.cumsum([3 * points, frames, 2 * frames]), axis=3)
        sine, cosine, zero = np.sin(yaw), np.cos(yaw), np.zeros(frames)
        turn = np.array([[cosine, zero, sine], [zero, zero + 1.0, zero], [-sine, zero, cosine]]).transpose(2, 0, 1)
        by_yaw = np.array([[-sine, zero, cosine], [zero, zero, zero], [-cosine, zero, -sine]]).transpose(2, 0, 1)
        for axis in range(3):
            of_body[:, point, :, 3 * point + axis] = (axes @ turn)[None, :, :, axis]
        of_yaw[frame, :, :, frame] = body @ (axes @ by_yaw).transpose(0, 2, 1)
        of_place[frame, :, :, 2 * frame], of_place[frame, :, :, 2 * frame + 1] = axes[:, 0], axes[:, 2]
        of_rest[..., 1, 0] = 1.0
        step, turned = TILT_DIFFERENCE_STEP, self.turned(unknowns)
        for column, (across, near) in enumerate(((step, 0.0), (0.0, step)), start=1):
            ahead, behind = (axis_rotation(right + s * across, towards + s * near) for s in (1, -1))
            of_rest[..., column] = turned @ (ahead - behind).T / (2.0 * step)
        depth = -seen[..., 2, None]
        pixels = (parts[..., :2, :] + (seen[..., :2] / depth)[..., None] * parts[..., 2:, :]) / depth[..., None]
        pixels[..., -1] = seen[..., :2] / depth
        pixels *= np.exp(focal_log) * self.weight[..., None] / (self.height * LANDMARK_STD_RATIO)
        return np.concatenate([pixels.reshape(-1, unknown_count), self._prior_jacobian(unknown_count)])

    def _prior_jacobian(self, unknown_count: int) -> Float[np.ndarray, "q u"]:
        """Return the derivative of the residuals after those of the pixels."""
        frames, points = self.rays.shape[:2]
        of_body = np.zeros((points // 2, 3, points, 3))
        pair, axis = np.divmod(np.arange(3 * (points // 2)), 3)
        of_body[pair, axis, 2 * pair, axis] = np.where(axis == 0, -1.0, 1.0)
        of_body[pair, axis, 2 * pair + 1, axis] = -1.0
        rows = np.zeros((len(pair) + 6, unknown_count))
        rows[: len(pair), : 3 * points] = of_body.reshape(len(pair), -1) / (self.height * SYMMETRY_STD_RATIO)
        gauge, places = rows[len(pair) :], 3 * points + frames
        gauge[0, 0 : 3 * points : 3] = gauge[1, 1 : 3 * points : 3] = 1e3 / points
        gauge[2, places : places + 2 * frames : 2] = gauge[3, places + 1 : places + 2 * frames : 2] = 1e3 / frames
        gauge[4, 3 * points : places] = 1e3 / frames
        gauge[5, -1] = 1.0 / self.focal_log_std
        return rows


def axis_rotation(right: float, towards: float) -> Float[np.ndarray, "3 3"]:
    """Return a rotation that takes y to the direction (right, 1, towards) and keeps x in the image plane."""
    up = np.array([right, 1.0, towards])
    up /= np.linalg.norm(up)
    across = np.array([up[1], -up[0], 0.0]) / np.hypot(up[0], up[1])
    return np.stack([across, up, np.cross(across, up)], axis=1)


def estimate_turn_axis(
    observations: Observations, focal_log_std: float, max_resultant: float = MAX_ARC_RESULTANT
) -> TurnAxis | None:
    """Return the axis about which a person turns, all round or in an arc.

    None if the person hardly turns or is not rigid, if landmarks are too few, or if the focal length is implausible.

    observations: with corrected left and right, in the world of a level camera.
    focal_log_std: standard deviation of the logarithm of its focal length; 0 for a known one.
    max_resultant: largest `yaw_resultant`; `MAX_YAW_RESULTANT` admits no arc.
    """
    rows = _complete_frames(observations)
    if len(rows) < MIN_FRAMES:
        return None
    directions = observations.landmarks_3d_m[rows].numpy()
    left = directions[:, HIPS_AND_SHOULDERS_LEFT].mean(1) - directions[:, HIPS_AND_SHOULDERS_RIGHT].mean(1)
    yaw_rad = np.unwrap(np.arctan2(-left[:, 2], left[:, 0]))
    resultant = yaw_resultant(yaw_rad)
    if resultant > max_resultant:
        return None
    is_arc = resultant > MAX_YAW_RESULTANT
    prior_std = min(focal_log_std, ARC_FOCAL_LOG_STD) if is_arc else focal_log_std
    problem = _make_problem(observations, rows, yaw_rad, max(prior_std, 1e-3))
    found = least_squares(
        problem.residuals,
        problem.start(),
        problem.jacobian,
        ftol=COST_TOLERANCE,
        loss="soft_l1",
        max_nfev=MAX_EVALUATIONS,
    )
    residual = np.linalg.norm(problem.reprojection(found.x), axis=-1)
    max_residual = MAX_ARC_RESIDUAL_RATIO if is_arc else MAX_RESIDUAL_RATIO
    if np.median(residual) > max_residual or abs(found.x[-1]) > MAX_FOCAL_LOG:
        return None
    covariance = np.linalg.pinv(found.jac.T @ found.jac)
    # The median distance of points with normal errors is 1.18 standard deviations.
    noise = max(float(np.median(residual)) / (1.18 * LANDMARK_STD_RATIO), 1.0)
    std = STD_FACTOR * noise * np.sqrt(np.diag(covariance)[-3:])
    focal_log_std = float(np.hypot(std[2], COMMON_FOCAL_LOG_STD))
    return TurnAxis(found.x[-3:-1], std[:2], float(found.x[-1]), focal_log_std, is_arc)


def contradicting_focal_log(observations: Observations) -> float:
    """Return the logarithm of the focal length that a turn shows over that of the camera, if they contradict; else 0.

    They contradict if they differ by more than `CONTRADICTION_STDS` standard deviations of what the turn shows.

    observations: with corrected left and right; their camera has the supplied focal length.
    """
    axis = estimate_turn_axis(observations, FitSettings.initial_focal_std, MAX_YAW_RESULTANT)
    is_contradiction = axis is not None and abs(axis.focal_log) > CONTRADICTION_STDS * axis.focal_log_std
    return axis.focal_log if axis is not None and is_contradiction else 0.0


def yaw_resultant(yaw_rad: Float[np.ndarray, "k"]) -> float:
    """Return the length of the mean facing direction, 0 (a full turn) to 1 (one direction)."""
    return float(np.abs(np.exp(1j * yaw_rad).mean()))


def _complete_frames(observations: Observations) -> Int[np.ndarray, "k"]:
    """Return at most `MAX_FRAMES` evenly spaced frames in which all landmarks were detected."""
    rows = list(AXIS_LANDMARKS)
    known = torch.minimum(observations.confidence[:, rows], observations.confidence_3d[:, rows]).min(1).values > 0
    complete = np.flatnonzero(known.numpy())
    return complete[evenly_spaced(len(complete), MAX_FRAMES)]


def _make_problem(
    observations: Observations, rows: Int[np.ndarray, "k"], yaw_rad: Float[np.ndarray, "k"], focal_log_std: float
) -> _Problem:
    camera, chosen = observations.camera, list(AXIS_LANDMARKS)
    pixels = observations.landmarks_px[rows][:, chosen].numpy()
    rays = (pixels - [camera.cx, camera.cy]) / [camera.fx, -camera.fy]
    sine, cosine = np.sin(yaw_rad)[:, None], np.cos(yaw_rad)[:, None]
    x, y, z = np.moveaxis(observations.landmarks_3d_m[rows][:, chosen].numpy(), -1, 0)
    body = np.median(np.stack([cosine * x - sine * z, y, sine * x + cosine * z], axis=-1), axis=0)
    height = float(np.median(np.ptp(rays[..., 1], axis=1)))
    weight = observations.confidence[rows][:, chosen].numpy()[..., None]
    return _Problem(rays, weight**2, body * height / np.ptp(body[:, 1]), yaw_rad, height, focal_log_std)
