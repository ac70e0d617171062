"""Motion of a hand-held camera, and stabilised pictures: those that a camera on a stand would have taken.

A camera in the hand turns by a few degrees and moves by little beside the distance of the scene, so that the scene
behind the person moves by a homography: yaw, pitch, roll, and a change of scale (a step forward, or the lens that
breathes). Corners of the scene in one frame are tracked to all others (Bouguet, "Pyramidal implementation of the
Lucas-Kanade feature tracker", 2001), on images whose local contrast is normalised because exposure changes, and the
four numbers of each frame are fitted to them robustly. A shift of the camera moves the person against the scene; that
is left to the person's motion.
"""

from __future__ import annotations

from dataclasses import replace
from functools import partial
from typing import NamedTuple

import cv2
import numpy as np
from jaxtyping import Bool, Float, UInt8

from pipeline.capture.detection import Detections, decode_mask, encode_mask
from pipeline.capture.frame_selection import evenly_spaced
from pipeline.capture.input_checks import MAX_MOVED_FRACTION, dilated_person_masks, sample_scene_changes
from pipeline.core.progress import track

FOCAL_RATIOS = (0.7, 0.9, 1.2, 1.6, 2.2, 3.0)
"""Focal lengths over the longer side that are tried where the metadata of the recording tell none: corners of the scene
far from the centre move by more the shorter it is."""
_FOCAL_FRAMES = 24
"""Frames that tell it."""
_MAX_CORNERS, _CORNER_QUALITY, _CORNER_DISTANCE_PX = 400, 0.01, 5
_CONTRAST_SIGMA_PX, _CONTRAST_FLOOR, _CONTRAST_LEVELS = 6.0, 4.0, 45.0
# Lucas-Kanade: window, levels of the pyramid, and the error of tracking there and back.
_WINDOW_PX, _PYRAMID_LEVELS, _MAX_ROUND_TRIP_PX = 15, 3, 0.5
# Robust fit: iterations, step (rad) that ends them, scale of the Cauchy weights, distance within which corners agree.
_ITERATIONS, _SMALL_STEP, _CAUCHY_PX, _INLIER_PX = 20, 1e-5, 0.3, 1.0
_MIN_CORNERS, _MIN_INLIER_SHARE = 20, 0.5
_MIDDLE = (0.5, 0.5)
# Share of the frames with a person that must remain.
_MIN_KEPT_SHARE = 0.9
# The scene must differ in so much fewer frames afterwards.
_MAX_CHANGE_RATIO = 0.5


class CameraMotion(NamedTuple):
    """How the camera has turned in each frame, against one of them.

    parameters: rotation vector (pitch, yaw, roll; rad), and the logarithm of the scale. known: whether enough corners
        agree.
    focal_ratio: focal length over the longer side. centre_ratio: principal point over width and height.
    """

    parameters: Float[np.ndarray, "n 4"]
    known: Bool[np.ndarray, "n"]
    focal_ratio: float
    centre_ratio: tuple[float, float] = _MIDDLE

    def to_stabilised_camera(self, size_px: tuple[int, int]) -> Float[np.ndarray, "k 3 3"]:
        """Return homographies from the frames whose motion is known to the picture of a camera that stands still.

        Its orientation is the median one. They act on pixels, centres at +0.5. size_px: width and height.
        """
        view, known = _View.of(size_px, self.focal_ratio, self.centre_ratio), self.parameters[self.known]
        stabilised = view.homography(np.median(known, axis=0))
        return np.stack([stabilised @ np.linalg.inv(view.homography(row)) for row in known])


class _View(NamedTuple):
    """Focal length and principal point of a picture, px."""

    focal_px: float
    centre_px: tuple[float, float]

    @classmethod
    def of(cls, size_px: tuple[int, int], focal_ratio: float, centre_ratio: tuple[float, float]) -> _View:
        """See `CameraMotion`; size_px: width and height."""
        (width, height), (x, y) = size_px, centre_ratio
        return cls(focal_ratio * max(size_px), (x * width, y * height))

    def homography(self, parameters: Float[np.ndarray, "4"]) -> Float[np.ndarray, "3 3"]:
        """Return where a camera that turns and scales its picture sees the pixels of the reference."""
        scale, centre = np.exp(parameters[3]), self.centre_px
        to_pixels = np.array([[self.focal_px, 0.0, centre[0]], [0.0, self.focal_px, centre[1]], [0.0, 0.0, 1.0]])
        matrix: np.ndarray = to_pixels @ np.diag([scale, scale, 1.0]) @ cv2.Rodrigues(parameters[:3])[0]
        return matrix @ np.linalg.inv(to_pixels)

    def derivatives(self, points_px: Float[np.ndarray, "m 2"]) -> Float[np.ndarray, "m 2 4"]:
        """Return by how many pixels points move with each parameter, for small angles."""
        x, y = (points_px - self.centre_px).T / self.focal_px
        right = np.stack([-x * y, 1.0 + x * x, -y, x], axis=-1)
        down = np.stack([-1.0 - y * y, x * y, x, y], axis=-1)
        return self.focal_px * np.stack([right, down], axis=1)


class _Track(NamedTuple):
    """Corners of the reference and where they are in another frame, px."""

    reference: Float[np.ndarray, "m 2"]
    found: Float[np.ndarray, "m 2"]


def estimate_camera_motion(
    gray: UInt8[np.ndarray, "n h w"],
    person: Bool[np.ndarray, "n h w"],
    focal_ratio: float | None,
    centre_ratio: tuple[float, float] = _MIDDLE,
) -> CameraMotion:
    """Return the motion of the camera. person: dilated masks; corners in them do not count.

    focal_ratio: focal length over the longer side; None: that of `FOCAL_RATIOS` which explains the corners best.
    centre_ratio: principal point over width and height.
    """
    (height, width), middle = gray.shape[1:], FOCAL_RATIOS[len(FOCAL_RATIOS) // 2]
    views = {ratio: _View.of((width, height), ratio, centre_ratio) for ratio in (*FOCAL_RATIOS, focal_ratio or middle)}
    tracks = _track_corners(gray, person, views[focal_ratio or middle])
    if focal_ratio is None:
        sampled = [tracks[k] for k in evenly_spaced(len(tracks), _FOCAL_FRAMES)]
        errors = {ratio: sum(_fit(one, views[ratio])[1] for one in sampled) for ratio in FOCAL_RATIOS}
        focal_ratio = min(errors, key=errors.__getitem__)
    fits = [_fit(one, views[focal_ratio])[0] for one in tracks]
    parameters = np.stack([np.zeros(4) if fit is None else fit for fit in fits])
    return CameraMotion(parameters, np.array([fit is not None for fit in fits]), focal_ratio, centre_ratio)


def _track_corners(gray: UInt8[np.ndarray, "n h w"], person: Bool[np.ndarray, "n h w"], view: _View) -> list[_Track]:
    """Return corners of the scene in the middle frame and where they are in each frame."""
    pictures = [_normalise_contrast(image) for image in gray]
    reference = len(gray) // 2
    background = np.where(person[reference], 0, 255).astype(np.uint8)
    corners = cv2.goodFeaturesToTrack(
        pictures[reference], _MAX_CORNERS, _CORNER_QUALITY, _CORNER_DISTANCE_PX, mask=background
    )
    # OpenCV's pixel centres are whole numbers.
    points = np.zeros((0, 2)) if corners is None else np.asarray(corners).reshape(-1, 2).astype(np.float64) + 0.5
    tracks = [_Track(points, points)] * len(gray)
    last = np.zeros(4)
    both_ways = [*range(reference + 1, len(gray)), *range(reference - 1, -1, -1)] if len(points) else []
    for k in track(both_ways, "following the camera"):
        last = np.zeros(4) if k == reference - 1 else last
        expected = apply_homography(view.homography(last), points)
        found, is_good = _follow(pictures[reference], pictures[k], points, expected, ~person[k])
        tracks[k] = _Track(points[is_good], found[is_good])
        fitted = _fit(tracks[k], view, last)[0]
        last = last if fitted is None else fitted
    return tracks


def stabilise_detections(
    detections: Detections, focal_px: float | None, centre_px: tuple[float, float] | None = None
) -> Detections:
    """Return the detections in stabilised pictures.

    Frames in which the person would be cut off, or whose motion is unknown, are left out. The detections are returned
    as they are if the scene behind the person does not move, if these are many frames, or if the scene does not stand
    still afterwards, because it is no turning camera that changes it.

    focal_px: focal length, in pixels of the pictures that are kept; None: unknown.
    centre_px: principal point in these pictures; None: their middle.
    """
    before = sample_scene_changes(detections)[1].mean()
    if before <= MAX_MOVED_FRACTION:
        return detections
    size_px = detections.width, detections.height
    focal_ratio = None if focal_px is None else focal_px / max(size_px)
    centre_ratio = _MIDDLE if centre_px is None else (centre_px[0] / size_px[0], centre_px[1] / size_px[1])
    person = dilated_person_masks(detections.person_masks)
    motion = estimate_camera_motion(detections.gray_thumbnails, person, focal_ratio, centre_ratio)
    if motion.known[detections.found].mean() < _MIN_KEPT_SHARE:
        return detections
    to_stabilised = motion.to_stabilised_camera(size_px)
    known = detections.rows(motion.known)
    stabilised = _warp_detections(known, to_stabilised)
    ratio = detections.gray_thumbnails.shape[2] / detections.width
    is_cut = _is_cut_off(known.person_masks, stabilised.person_masks, rescaled(to_stabilised, ratio))
    stabilised = stabilised.rows(~is_cut)
    if stabilised.found.sum() < _MIN_KEPT_SHARE * detections.found.sum():
        return detections
    return stabilised if sample_scene_changes(stabilised)[1].mean() <= _MAX_CHANGE_RATIO * before else detections


def camera_motion_px(to_stabilised: Float[np.ndarray, "n 3 3"], size_px: tuple[int, int]) -> float:
    """Return how far the motion of the camera moved the corners of its picture, 95th percentile over frames."""
    corners = np.array([(x, y) for x in (0.0, size_px[0]) for y in (0.0, size_px[1])])
    shift_px = np.linalg.norm(apply_homography(to_stabilised, corners[None]) - corners, axis=-1)
    return float(np.percentile(shift_px.max(axis=1), 95))


def warp_image(
    image: UInt8[np.ndarray, "h w *c"], homography: Float[np.ndarray, "3 3"], *, is_mask: bool = False
) -> UInt8[np.ndarray, "h w *c"]:
    """Return the stabilised image; beyond the edge a mask is 0 and a picture repeats its edge."""
    to_corner = np.array([[1.0, 0.0, 0.5], [0.0, 1.0, 0.5], [0.0, 0.0, 1.0]])
    matrix = np.linalg.inv(to_corner) @ homography @ to_corner
    size_px = image.shape[1], image.shape[0]
    if is_mask:
        return cv2.warpPerspective(image, matrix, size_px, flags=cv2.INTER_LINEAR)
    return cv2.warpPerspective(image, matrix, size_px, flags=cv2.INTER_CUBIC, borderMode=cv2.BORDER_REPLICATE)


def rescaled(homographies: Float[np.ndarray, "*n 3 3"], factor: float) -> Float[np.ndarray, "*n 3 3"]:
    """Return homographies between pictures whose size is changed by a factor."""
    scale = np.diag([factor, factor, 1.0])
    return scale @ homographies @ np.linalg.inv(scale)


def _normalise_contrast(gray: UInt8[np.ndarray, "h w"]) -> UInt8[np.ndarray, "h w"]:
    values = gray.astype(np.float32)
    values -= cv2.GaussianBlur(values, (0, 0), _CONTRAST_SIGMA_PX)
    deviation = np.sqrt(cv2.GaussianBlur(values * values, (0, 0), _CONTRAST_SIGMA_PX))
    return np.clip(128.0 + _CONTRAST_LEVELS * values / (deviation + _CONTRAST_FLOOR), 0.0, 255.0).astype(np.uint8)


def _follow(
    first: UInt8[np.ndarray, "h w"],
    second: UInt8[np.ndarray, "h w"],
    points: Float[np.ndarray, "m 2"],
    expected: Float[np.ndarray, "m 2"],
    background: Bool[np.ndarray, "h w"],
) -> tuple[Float[np.ndarray, "m 2"], Bool[np.ndarray, "m"]]:
    """Return where the points are in the second image, and which of them are found in its background."""
    start, end = ((array - 0.5).astype(np.float32).reshape(-1, 1, 2) for array in (points, expected))
    flow = partial(
        cv2.calcOpticalFlowPyrLK,
        winSize=(_WINDOW_PX, _WINDOW_PX),
        maxLevel=_PYRAMID_LEVELS,
        flags=cv2.OPTFLOW_USE_INITIAL_FLOW,
    )
    there, found_there, _ = map(np.asarray, flow(first, second, start, end))
    back, found_back, _ = map(np.asarray, flow(second, first, there, start.copy()))
    tracked = there[:, 0] + 0.5
    height, width = second.shape
    inside = ((tracked >= 0.0) & (tracked < (width, height))).all(axis=1)
    column, row = np.clip(tracked, 0, (width - 1, height - 1)).astype(int).T
    is_good = (found_there[:, 0] > 0) & (found_back[:, 0] > 0) & inside & background[row, column]
    is_good &= np.linalg.norm(back[:, 0] - start[:, 0], axis=1) < _MAX_ROUND_TRIP_PX
    return tracked.astype(np.float64), is_good


def _fit(
    corners: _Track, view: _View, start: Float[np.ndarray, "4"] | None = None
) -> tuple[Float[np.ndarray, "4"] | None, float]:
    """Return the parameters of a frame by iteratively reweighted least squares, and their error.

    The parameters are None where corners are too few or disagree.
    """
    if len(corners.reference) < _MIN_CORNERS:
        return None, 0.0
    parameters = np.zeros(4) if start is None else start
    for _ in range(_ITERATIONS):
        expected = apply_homography(view.homography(parameters), corners.reference)
        error_px = corners.found - expected
        distance_px = np.linalg.norm(error_px, axis=1)
        scale_px = max(_CAUCHY_PX, float(np.median(distance_px)))
        weight = np.repeat(1.0 / (1.0 + (distance_px / scale_px) ** 2), 2)
        jacobian = view.derivatives(expected).reshape(-1, 4)
        weighted = jacobian * weight[:, None]
        step = np.linalg.solve(weighted.T @ jacobian, weighted.T @ error_px.ravel())
        parameters = parameters + step
        if np.abs(step).max() < _SMALL_STEP:
            break
    distance_px = np.linalg.norm(
        corners.found - apply_homography(view.homography(parameters), corners.reference), axis=1
    )
    is_inlier = distance_px < _INLIER_PX
    is_clear = is_inlier.sum() >= _MIN_CORNERS and is_inlier.mean() >= _MIN_INLIER_SHARE
    return parameters if is_clear else None, float(np.log1p((distance_px / _CAUCHY_PX) ** 2).sum())


def apply_homography(
    homography: Float[np.ndarray, "*#n 3 3"], points_px: Float[np.ndarray, "*#n m 2"]
) -> Float[np.ndarray, "..."]:
    """Transform points; nan stays nan."""
    mapped = points_px @ np.swapaxes(homography[..., :2], -1, -2) + homography[..., None, :, 2]
    return mapped[..., :2] / mapped[..., 2:]


def _warp_detections(detections: Detections, to_stabilised: Float[np.ndarray, "n 3 3"]) -> Detections:
    """Return the detections in the stabilised pictures."""
    ratio = detections.gray_thumbnails.shape[2] / detections.width
    small = rescaled(to_stabilised, ratio)
    pairs = zip(detections.gray_thumbnails, detections.person_masks, small, strict=True)
    warped = [(warp_image(gray, h), warp_image(person.astype(np.uint8), h, is_mask=True)) for gray, person, h in pairs]
    middle = np.array([detections.width, detections.height]) / 2.0
    left, right = np.moveaxis(apply_homography(to_stabilised, np.stack([middle, middle + (1.0, 0.0)])[None]), 1, 0)
    roll_rad = np.arctan2(right[:, 1] - left[:, 1], right[:, 0] - left[:, 0])
    hands, faces_px = detections.hands, detections.faces_px.copy()
    faces_px[..., :2] = apply_homography(to_stabilised, faces_px[..., :2])
    masks = zip(detections.masks_png, to_stabilised, strict=True)
    return replace(
        detections,
        gray_thumbnails=np.stack([gray for gray, _ in warped]),
        person_masks=np.stack([person for _, person in warped]) > 0,
        landmarks_px=apply_homography(to_stabilised, detections.landmarks_px).astype(np.float32),
        landmarks_world_m=_turn_in_picture(detections.landmarks_world_m, roll_rad),
        hands=replace(
            hands,
            landmarks_px=apply_homography(to_stabilised[:, None], hands.landmarks_px).astype(np.float32),
            landmarks_m=_turn_in_picture(hands.landmarks_m, roll_rad[:, None]),
        ),
        faces_px=faces_px,
        masks_png=tuple(_warp_png(mask, homography, detections.width) for mask, homography in masks),
        to_stabilised=to_stabilised,
    )


def _turn_in_picture(
    points: Float[np.ndarray, "*n m 3"], roll_rad: Float[np.ndarray, "*#n"]
) -> Float[np.ndarray, "*n m 3"]:
    """Turn points (x right, y down) about the viewing axis.

    Yaw and pitch of the camera do not matter to a detector that looks at a cut-out of the person.
    """
    cosine, sine = np.cos(roll_rad)[..., None], np.sin(roll_rad)[..., None]
    x, y, z = np.moveaxis(points, -1, 0)
    return np.stack([cosine * x - sine * y, sine * x + cosine * y, z], axis=-1).astype(points.dtype)


def _warp_png(mask_png: bytes, homography: Float[np.ndarray, "3 3"], width_px: int) -> bytes:
    """Warp an encoded mask, which may be smaller than the picture; empty if it is."""
    if not mask_png:
        return mask_png
    mask = decode_mask(mask_png)
    stabilised = warp_image(mask, rescaled(homography, mask.shape[1] / width_px), is_mask=True)
    return encode_mask(stabilised)


def _is_cut_off(
    before: Bool[np.ndarray, "n h w"], after: Bool[np.ndarray, "n h w"], to_stabilised: Float[np.ndarray, "n 3 3"]
) -> Bool[np.ndarray, "n"]:
    """Return in which frames the person meets what the camera did not see, or runs over the edge only afterwards.

    Whoever ends before the edge of a frame is seen whole, however near what the camera did not see begins.

    before, after: masks of the person in the frames, and in the stabilised pictures.
    """
    filmed, edge = np.full(before.shape[1:], 255, np.uint8), np.ones(before.shape[1:], dtype=bool)
    edge[1:-1, 1:-1] = False
    size_px = before.shape[2], before.shape[1]
    is_cut = []
    for mask_before, mask_after, homography in zip(before, after, to_stabilised, strict=True):
        if (mask_before & edge).any():
            unseen = (warp_image(filmed, homography, is_mask=True) < 255).astype(np.uint8)
            near_unseen = cv2.dilate(unseen, np.ones((3, 3), np.uint8)) > 0
            is_cut.append(bool((mask_after & near_unseen & ~edge).any()))
        else:
            moved = apply_homography(homography, np.argwhere(mask_before)[:, ::-1] + 0.5)
            is_cut.append(bool(((moved < 0.0) | (moved > size_px)).any()))
    return np.array(is_cut)
