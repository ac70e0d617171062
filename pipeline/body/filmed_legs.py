"""Canonical legs as they were filmed, for skirts, dresses and coats.

Cloth that hangs from leg to leg is moved by linear blend skinning with one leg or the other. In a canonical pose whose
legs are farther apart than the filmed ones, nothing is filmed of what would then be between them: a skirt gets a slit.
Where such cloth is seen, the body is therefore given the mean legs of the recording as its canonical pose, opened
until there is room for trousers between the shins. Bare legs and trousers without a skirt or coat keep the model's
A-pose, whose legs are apart, so that they do not grow together.

Notation: Q_j rotation of joint j from the old canonical pose to the new one, R_j its local rotation in a frame.
"""

from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace

import numpy as np
import torch
from jaxtyping import Bool, Float
from torch import Tensor

from pipeline.body.body import Body, Motion, canonical_to_world, posed_joints_m
from pipeline.body.fit.linear_body import descendant_matrix
from pipeline.body.fit.silhouette_icp import MaskWindow, rasterise_in_window
from pipeline.body.overlay import pose_vertices
from pipeline.capture.frame_selection import evenly_spaced
from pipeline.geometry.camera import Camera, project
from pipeline.geometry.rotation import (
    axis_angle_to_matrix,
    continuous_quaternions,
    matrix_to_quaternion,
    quaternion_to_matrix,
)
from pipeline.geometry.skinning import (
    forward_kinematics,
    linear_blend_skinning,
    skinning_transforms,
)

LEGS = (("LeftUpLeg", "LeftLeg", "LeftFoot"), ("RightUpLeg", "RightLeg", "RightFoot"))
"""Joints of either leg; the feet stay flat."""

MIN_SHIN_GAP_M = 0.06
"""Room between the shins, feet included: trousers are 2 to 3 cm wider than the legs. A coat that was filmed with 0.02 m
had trousers that grew together below it, one that was filmed with 0.05 m had not."""

JUDGED_FRAMES = 24
"""Frames, evenly spaced, whose masks are compared with the legs of the body."""

HEIGHT_STEP, HIGHEST, LOWEST = 0.025, 0.1, 1.9
HEIGHTS = HIGHEST + HEIGHT_STEP * np.arange(round((LOWEST - HIGHEST) / HEIGHT_STEP) + 1)
"""Heights that are looked at, as of `Body.height_on_legs_m`, nearly to the ankles."""

FOOT_HEIGHTS = HEIGHTS[-1] + HEIGHT_STEP * np.arange(1, 18)
"""Heights below them, to the soles and beyond, at which only cloth down to the floor is looked for."""

JUDGED_FROM, JUDGED_TO = 0.29, 1.41
"""Heights that tell a skirt. Above, thighs touch anyway, and a hem is that of a shirt; below, trousers touch."""

HEM_RANGE = (0.1, 0.2)
"""Distance below a hem at which its step is measured, in the unit of `HEIGHTS`."""

MIN_MARGIN_M, MIN_STEP_M = 0.02, 0.015
"""Cloth ends at a hem where its distance from the legs, left and right, is at least the first and falls by the second.
Trousers of four people: at most 0.005 m; a knee-long coat 0.03, a wide skirt 0.23."""

MIN_SKIRT_STEP_M = 0.05
"""A hem with this step is that of a skirt that stands off the legs, whose outline says little of them. Coats of one
person: 0.025 to 0.042, skirts with 7 to 24 cm of flare: 0.07 to 0.21."""

MAX_OPEN_SHARE = 0.1
"""Share of the pixels between the legs above the hem that may show the background: through shorts it is seen."""

MIN_GAP_PX, WIDE_GAP_PX = 4.0, 8.0
"""Width of a gap between the legs, of a person 240 px tall (3 and 6 cm), that trousers do not fill where the background
is seen between the legs below, and wherever it is. Trousers down to the floor fill 4 px between shins side by side."""

MIN_OPEN_SHARE = 0.5
"""Share of the pixels between the legs that show the background below a skirt."""

_IS_JUDGED = (HEIGHTS > JUDGED_FROM) & (HEIGHTS < JUDGED_TO)


@dataclass(frozen=True)
class LegProfile:
    """What masks show of the clothes of the legs at `HEIGHTS`.

    Attributes:
        margin_m: distance of the outline of the mask from that of the legs, mean of left and right, median over frames;
            nan where no frame shows it.
        gap_px: pixels between the legs of the body, mean over frames.
        open_px: those of them that the masks do not cover.
        half_width_m: half the width of the legs with their margins, median over frames; nan where no frame shows it.
        slope: tangent of the angle at which the camera sees a horizontal plane at each height, median over frames.
        thigh_m: height of the hips above the knees in the A-pose: the unit of `HEIGHTS`.
        floor_hem: where cloth that hangs between the legs at the lowest of `HEIGHTS` ends, in their unit.
    """

    margin_m: Float[np.ndarray, "k"]
    gap_px: Float[np.ndarray, "k"]
    open_px: Float[np.ndarray, "k"]
    half_width_m: Float[np.ndarray, "k"]
    slope: Float[np.ndarray, "k"]
    thigh_m: float
    floor_hem: float = LOWEST

    def cloth_hangs_between_legs(self) -> bool:
        """Return whether a skirt or coat goes from leg to leg.

        It does where it covers a gap between the legs that is wide, or open below, and where there is a hem above
        which nothing is seen between legs that are close to each other.
        """
        is_covered = (self.gap_px >= MIN_GAP_PX) & (self.open_px <= MAX_OPEN_SHARE * self.gap_px)
        is_open = (self.gap_px >= 1.0) & (self.open_px >= MIN_OPEN_SHARE * self.gap_px)
        is_open &= HEIGHTS < JUDGED_TO
        is_open_below = np.append(np.maximum.accumulate(is_open[::-1])[-2::-1], False)
        is_cloth = is_covered & (is_open_below | (self.gap_px >= WIDE_GAP_PX))
        if is_cloth[_IS_JUDGED].any():
            return True
        step_m = np.where(_IS_JUDGED, self._step_m(), 0.0)
        if step_m.max() >= MIN_STEP_M:
            hem = int(np.argmax(step_m))
        elif (np.nan_to_num(self.margin_m)[_IS_JUDGED] >= MIN_MARGIN_M).all():
            hem = int(np.flatnonzero(_IS_JUDGED)[-1])
        else:
            return False
        return bool(self.open_px[:hem].sum() <= MAX_OPEN_SHARE * self.gap_px[:hem].sum())

    def outline_hem(self) -> float | None:
        """Return where a skirt or coat ends in the pictures, in the unit of `HEIGHTS`; None without one.

        There the margin falls to half, or the background begins to be seen between the legs. Cloth down to the floor
        ends at `floor_hem`.
        """
        if not self.cloth_hangs_between_legs():
            return None
        return self.floor_hem if self.reaches_floor() else HIGHEST + HEIGHT_STEP * (self._rows_at_hem()[1] - 0.5)

    def reaches_floor(self) -> bool:
        """Return whether cloth hangs between the legs down to the lowest of `HEIGHTS`."""
        return self.cloth_hangs_between_legs() and self._rows_at_hem()[1] == len(HEIGHTS)

    def hem_height(self) -> float | None:
        """Return the height of the hem of a skirt or coat, in the unit of `HEIGHTS`; None without one.

        The hem is taken for a circle around the legs. Seen from above or below it is an ellipse, whose lower half is
        below the hem in the pictures: `outline_hem` is too low.
        """
        outline_hem = self.outline_hem()
        if outline_hem is None:
            return None
        widest, below = self._rows_at_hem()
        radius_m, fall_m = np.nan_to_num(self.half_width_m[widest]), 0.5 * self._step_m()[widest]
        depth_m = np.sqrt(radius_m**2 - max(radius_m - fall_m, 0.0) ** 2) if fall_m > 0.0 else radius_m
        drop_m = np.nan_to_num(self.slope[min(below, len(HEIGHTS) - 1)]) * depth_m
        return outline_hem - float(drop_m) / self.thigh_m

    def _rows_at_hem(self) -> tuple[int, int]:
        """Return the row of the cloth above the hem whose width counts, and the first row below the hem."""
        step_m = self._step_m()
        row = int(np.argmax(step_m))
        if step_m[row] >= MIN_STEP_M:
            below_m = np.append(np.nan_to_num(self.margin_m)[row:], 0.0)
            return row, row + int(np.argmax(below_m < below_m[0] - 0.5 * step_m[row]))
        is_covered = (self.gap_px >= MIN_GAP_PX) & (self.open_px < MIN_OPEN_SHARE * self.gap_px)
        below = int(np.flatnonzero(is_covered)[-1]) + 1 if is_covered.any() else len(HEIGHTS)
        return below - 1, below

    def stands_off(self) -> bool:
        """Return whether there is a skirt that stands off the legs at its hem."""
        if self.reaches_floor():
            return bool(self.gap_px[-1] >= WIDE_GAP_PX)
        return self.cloth_hangs_between_legs() and float(self._step_m().max()) >= MIN_SKIRT_STEP_M

    def _step_m(self) -> Float[np.ndarray, "k"]:
        """Return how far the margin falls below each height; 0 where it is not wide enough for the cloth of a hem."""
        margin_m = np.nan_to_num(self.margin_m)
        near, far = (round(distance / HEIGHT_STEP) for distance in HEM_RANGE)
        after_m = np.append(margin_m, np.full(far, margin_m[-1]))
        step_m = margin_m - np.lib.stride_tricks.sliding_window_view(after_m[near:], far - near + 1).min(axis=1)
        return np.where((margin_m >= MIN_MARGIN_M) & (HEIGHTS > JUDGED_FROM), step_m, 0.0)


@dataclass(frozen=True)
class RestPose:
    """A body in another canonical pose, and the same motion as rotations from that pose."""

    body: Body
    motion: Motion


def leg_profile(
    body: Body, motion: Motion, camera: Camera, windows: Sequence[MaskWindow | None], frames: Bool[np.ndarray, "n"]
) -> LegProfile:
    """Compare the masks with the legs of the fitted body.

    Args:
        body: the fitted body.
        motion: of all frames.
        camera: of the recording.
        windows: masks of the frames.
        frames: those that may be judged.
    """
    found = np.flatnonzero(frames & np.array([window is not None for window in windows]))
    chosen = found[evenly_spaced(len(found), JUDGED_FRAMES)]
    legs = np.stack([_leg_faces(body, side) for side in LEGS])
    rows = np.full((5, len(chosen), len(HEIGHTS) + len(FOOT_HEIGHTS)), np.nan)
    for k, pose in enumerate(canonical_to_world(body, motion.select(chosen))):
        window = windows[chosen[k]]
        if window is not None:
            rows[:, k] = _profile_of_frame(body, legs, pose, camera, window)
    seen = np.isfinite(rows[0]).any(axis=0)
    medians = np.full((3, rows.shape[2]), np.nan)
    medians[:, seen] = np.nanmedian(rows[[0, 3, 4]][..., seen], axis=1)
    gap_px, open_px = np.nansum(rows[1:3], axis=1) / max(1, len(chosen))
    thigh_m = body.height_on_legs_m(0.0) - body.height_on_legs_m(1.0)
    hangs = (gap_px >= 1.0) & (open_px < MIN_OPEN_SHARE * gap_px)
    floor_hem = LOWEST + HEIGHT_STEP * (int(np.argmin(np.append(hangs[len(HEIGHTS) :], False))) + 0.5)
    end = len(HEIGHTS)
    margin_m, half_width_m, slope = medians[:, :end]
    return LegProfile(margin_m, gap_px[:end], open_px[:end], half_width_m, slope, thigh_m, floor_hem)


def _profile_of_frame(
    body: Body, legs: Bool[np.ndarray, "2 f"], pose: Float[Tensor, "j 4 4"], camera: Camera, window: MaskWindow
) -> Float[np.ndarray, "5 k"]:
    """Return the values of a frame, in the order of `LegProfile`; nan where the legs are not seen."""
    vertices = pose_vertices(body, pose)
    face_id = rasterise_in_window(vertices, torch.from_numpy(body.faces), camera, window).face_id
    is_body = face_id >= 0
    left, right = legs[:, np.maximum(face_id, 0)] & is_body
    metres_per_px = body.height_m() / window.person_px
    heights = np.concatenate([HEIGHTS, FOOT_HEIGHTS])
    profile, slope = np.full((5, len(heights)), np.nan), _slopes(heights, body, pose, camera)
    for k, row in enumerate(rows_on_legs(heights, body, pose, camera, window)):
        if not (0 <= row < len(face_id) and left[row].any() and right[row].any()):
            continue
        columns = sorted((np.flatnonzero(left[row]), np.flatnonzero(right[row])), key=np.mean)
        start, end = min(map(np.min, columns)), max(map(np.max, columns))
        cloth = window.mask[row] & ~is_body[row]
        outside_px = _run_length(cloth[:start][::-1]) + _run_length(cloth[end + 1 :])
        between = np.zeros(len(cloth), dtype=bool)
        between[columns[0].max() + 1 : columns[1].min()] = True
        between &= ~is_body[row]
        margin_m, half_width_m = (0.5 * metres_per_px * px for px in (outside_px, outside_px + end + 1 - start))
        profile[:, k] = margin_m, between.sum(), (between & ~window.mask[row]).sum(), half_width_m, slope[k]
    return profile


def _slopes(
    heights: Float[np.ndarray, "k"], body: Body, pose: Float[Tensor, "j 4 4"], camera: Camera
) -> Float[np.ndarray, "k"]:
    """Return the tangents of the angles at which the camera sees the planes across the legs at some heights."""
    hip_m, knee_m = _hips_and_knees_m(body, pose).mean(axis=1)
    up = (hip_m - knee_m) / np.linalg.norm(hip_m - knee_m)
    to_camera_m = camera.centre_m() - (hip_m + heights[:, None] * (knee_m - hip_m))
    above_m = to_camera_m @ up
    return np.abs(above_m) / np.linalg.norm(to_camera_m - above_m[:, None] * up, axis=1)


def rows_on_legs(
    heights: Iterable[float], body: Body, pose: Float[Tensor, "j 4 4"], camera: Camera, window: MaskWindow
) -> list[int]:
    """Return the rows of a window at heights as of `Body.height_on_legs_m`, the mean of both legs."""
    places_px, _ = project(torch.from_numpy(_hips_and_knees_m(body, pose)), camera)
    hip_px, knee_px = ((places_px[..., 1].numpy() - window.top_px) * window.scale_xy[1]).mean(axis=1)
    return [int(hip_px + height * (knee_px - hip_px)) for height in heights]


def _hips_and_knees_m(body: Body, pose: Float[Tensor, "j 4 4"]) -> Float[np.ndarray, "2 2 3"]:
    """Return the positions of both hip joints and of both knees in a pose, m, world."""
    return posed_joints_m(body, pose)[[[body.joint(side[part]) for side in LEGS] for part in (0, 1)]]


def _run_length(flags: Bool[np.ndarray, "n"]) -> int:
    """Return how many flags are set before the first that is not."""
    return int(np.argmin(flags)) if not flags.all() else len(flags)


def _leg_faces(body: Body, names: tuple[str, ...]) -> Bool[np.ndarray, "f"]:
    weight = body.skin_weights[:, [body.joint(name) for name in names]].sum(axis=1)
    return np.asarray((weight[body.faces] > 0.5).all(axis=1))


def rest_with_filmed_legs(body: Body, motion: Motion, frames: Bool[np.ndarray, "n"]) -> RestPose:
    """Return the body with the mean rotations of hips and knees in some frames as its canonical pose, feet flat.

    Shins that are nearer to each other than `MIN_SHIN_GAP_M` are opened at the hips. Posed bodies stay the same, but
    for the blended skin around the hips, which differs by millimetres.

    Args:
        body: in its canonical pose.
        motion: rotations from that pose.
        frames: those whose mean is taken.
    """
    local = torch.eye(3, dtype=torch.float64).repeat(len(body.joint_names), 1, 1)
    rotations = quaternion_to_matrix(torch.from_numpy(motion.rotations_wxyz)).double()
    for upper, lower, _ in (tuple(map(body.joint, side)) for side in LEGS):
        local[upper], local[lower] = (_mean_rotation(rotations[frames, joint]) for joint in (upper, lower))
    rest, vertices = _with_flat_feet(local, body)
    missing_m = MIN_SHIN_GAP_M - _shin_gap_m(body, vertices)
    if missing_m > 0.0:
        hip_m, foot_m = (rest[0, [body.joint(side[part]) for side in LEGS], :3, 3].mean(0) for part in (0, 2))
        angle_rad = 0.5 * missing_m / float(hip_m[1] - foot_m[1])
        for side, outwards_rad in zip(LEGS, (angle_rad, -angle_rad), strict=True):
            about_z = torch.tensor([[0.0, 0.0, outwards_rad]], dtype=torch.float64)
            local[body.joint(side[0])] = axis_angle_to_matrix(about_z)[0] @ local[body.joint(side[0])]
        rest, vertices = _with_flat_feet(local, body)
    drop_m = torch.tensor([0.0, float(vertices[:, 1].min()), 0.0], dtype=torch.float64)
    turned = rest[0, :, :3, :3]
    of_parent = torch.stack([turned[max(parent, 0)] for parent in body.parents.tolist()])
    of_parent[0] = torch.eye(3, dtype=torch.float64)
    changed = of_parent @ rotations @ turned.transpose(1, 2)
    new = replace(
        body,
        vertices=(vertices - drop_m).float().numpy(),
        joints_m=(rest[0, :, :3, 3] - drop_m).float().numpy(),
    )
    quaternions = continuous_quaternions(matrix_to_quaternion(changed)).float().numpy()
    return RestPose(new, motion.with_pose(quaternions, motion.root_translation_m))


def _with_flat_feet(local: Float[Tensor, "j 3 3"], body: Body) -> tuple[Float[Tensor, "1 j 4 4"], Float[Tensor, "v 3"]]:
    """Return the joints' transforms and the vertices (m) with these local rotations, but for the feet."""
    for upper, lower, foot in (tuple(map(body.joint, side)) for side in LEGS):
        local[foot] = (local[upper] @ local[lower]).T
    joints_m = torch.from_numpy(body.joints_m).double()
    rest = forward_kinematics(local[None], joints_m[None, 0], joints_m, body.parents)
    vertices = linear_blend_skinning(
        torch.from_numpy(body.vertices).double(),
        torch.from_numpy(body.skin_weights).double(),
        skinning_transforms(rest, joints_m),
    )[0]
    return rest, vertices


def _shin_gap_m(body: Body, vertices: Float[Tensor, "v 3"]) -> float:
    """Return the distance between both shins with their feet along x, m; negative where they overlap."""
    below = descendant_matrix(body.parents.tolist()).numpy()[[body.joint(side[1]) for side in LEGS]]
    left, right = (vertices[torch.from_numpy(body.skin_weights @ of_leg > 0.5), 0] for of_leg in below)
    return float(left.min() - right.max())


def _mean_rotation(rotations: Float[Tensor, "n 3 3"]) -> Float[Tensor, "3 3"]:
    """Return the rotation with the least squared chordal distance to some (Moakher, "Means and averaging", 2002)."""
    u, _, vt = torch.linalg.svd(rotations.mean(0))
    sign = torch.tensor([1.0, 1.0, float(torch.det(u @ vt).sign())], dtype=u.dtype)
    return u @ torch.diag(sign) @ vt
