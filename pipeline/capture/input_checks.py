"""Checks of a recording: conditions that end a run before the expensive stages, and warnings."""

from pathlib import Path

import cv2
import numpy as np
from jaxtyping import Bool, Float, Int

from pipeline.capture.detection import Detections
from pipeline.capture.frame_selection import evenly_spaced, format_frame_ranges
from pipeline.capture.landmarks import ANKLES, FEET, TORSO, PoseLandmark
from pipeline.capture.masks.background_plate import detect_scene_changes
from pipeline.capture.person_detector import is_ankle_visible
from pipeline.core.errors import UserError
from pipeline.core.progress import warn

_MAX_BLACK_LEVEL = 8
# Height of a shoe's sole below the landmarks of heel and toe, as a fraction of the image height.
_SOLE_HEIGHT_FRACTION = 0.02
# Half the width of a head, as a fraction of the image width.
_HEAD_HALF_WIDTH_FRACTION = 0.03
# Minimum cosine between the spine (shoulders to hips) and the image's downward axis of a standing person.
_MIN_UPRIGHT_COSINE = 0.5
_MAX_UNSEEN_ARC_DEG = 120.0
# Height of the person up to which the default preset gains from more pixels.
_TARGET_PERSON_HEIGHT_PX = 640.0
# Detection of a moving camera: number of images, fraction of them that must differ, and margin around the person
# (fraction of the longer side) that excludes shadows and errors of the mask.
_N_SCENE_FRAMES, MAX_MOVED_FRACTION, _PERSON_MARGIN_FRACTION = 32, 0.1, 0.03


def check_frames_that_differ(n_different: int, n_frames: int, path: Path, min_frames: int) -> None:
    """Raise UserError for a recording that repeats most of its frames. n_frames: those that were compared."""
    if n_different < min_frames:
        raise UserError(
            f"{path} has only {n_different} frames that differ among the {n_frames} that were compared, {min_frames} "
            "are needed; film a slow full turn"
        )


def check_input(detections: Detections, path: Path, min_frames: int) -> None:
    """Raise UserError for a recording that cannot be reconstructed.

    These are recordings that are black, show no person or several, show a person who is cut off or not upright, or
    whose pose is unknown.
    """
    if detections.gray_thumbnails.max(axis=(1, 2)).max() < _MAX_BLACK_LEVEL:
        raise UserError(f"all frames of {path} are black; use a recording that shows the person")
    # Twice, because one frame may show a picture on a wall or a reflection.
    multi_person_frames = detections.frame_index[detections.n_people > 1]
    if len(multi_person_frames) >= 2:
        raise UserError(
            f"{path} shows several people (for example in frame {multi_person_frames[0]}); "
            "use a recording of a single person, or crop it to one"
        )
    n_found, n_detection_frames = int(detections.found.sum()), len(detections.found)
    if n_found == 0:
        raise UserError(f"no person was found in {path}; film the whole body at half of the image height or more")
    if n_found < min_frames:
        raise UserError(
            f"a person was found in only {n_found} of {n_detection_frames} frames of {path}, {min_frames} are needed; "
            "film the whole body at half of the image height or more"
        )
    known = np.isfinite(detections.landmarks_px).all(axis=-1) & np.isfinite(detections.landmarks_world_m).all(axis=-1)
    is_torso_known = detections.found & known[:, TORSO].all(axis=1)
    n_torso = int(is_torso_known.sum())
    if n_torso < min_frames:
        raise UserError(
            f"hips and shoulders are known, in pixels and in 3D, in only {n_torso} of the {n_found} frames of {path} "
            f"that show a person; {min_frames} are needed: film the whole body unoccluded, and where landmarks.npz is "
            "supplied, complete it or remove it"
        )
    if not _is_upright(detections.landmarks_px[is_torso_known][:, TORSO]):
        raise UserError(
            f"the person in {path} is not upright (rotated recording); rotate it, for "
            "example with ffmpeg -i IN.mp4 -vf transpose=1 OUT.mp4 (a quarter turn clockwise)"
        )
    has_ankle_landmarks = detections.found & np.isfinite(detections.landmarks_px[:, ANKLES, 1]).any(axis=1)
    legs = is_ankle_visible(
        detections.landmarks_px[has_ankle_landmarks],
        detections.landmarks_visibility[has_ankle_landmarks],
        detections.height,
    )
    if np.sum(~legs) > 0.5 * len(legs):
        first = detections.frame_index[has_ankle_landmarks][~legs][0]
        raise UserError(
            f"the person in {path} is cut off above the feet in {np.sum(~legs)} of {len(legs)} frames "
            f"(frame {first} first); film the whole body from head to feet"
        )


def are_feet_cut_off(detections: Detections) -> Bool[np.ndarray, "n"]:
    """Return whether a foot is below the picture, as far as landmarks tell."""
    lowest_px = np.fmax.reduce(detections.landmarks_px[:, FEET, 1], axis=1)
    return lowest_px > (1.0 - _SOLE_HEIGHT_FRACTION) * detections.height


def lacks_head_or_feet(detections: Detections) -> Bool[np.ndarray, "n"]:
    """Return whether head or feet are beyond the picture: the mask reaches its top over the nose, or a foot is below.

    Hands at its sides do not count.
    """
    masks = detections.person_masks
    column_px = (np.arange(masks.shape[2]) + 0.5) * detections.width / masks.shape[2]
    nose_px = detections.landmarks_px[:, PoseLandmark.NOSE]
    over_nose = np.abs(column_px - nose_px[:, :1]) <= _HEAD_HALF_WIDTH_FRACTION * detections.width
    return (masks[:, 0] & over_nose).any(axis=1) | (nose_px[:, 1] < 0.0) | are_feet_cut_off(detections)


def _is_upright(torso_px: Float[np.ndarray, "n 4 2"]) -> bool:
    """Return whether the spine is upright in at least half of the frames; shoulders come before hips."""
    spine_px = torso_px[:, 2:].mean(axis=1) - torso_px[:, :2].mean(axis=1)
    is_fallen = spine_px[:, 1] < _MIN_UPRIGHT_COSINE * np.linalg.norm(spine_px, axis=1)
    return bool(is_fallen.mean() <= 0.5)


def assess_input(detections: Detections, unseen_arc_rad: float, path: Path) -> dict[str, float]:
    """Warn about properties of the recording that reduce the quality; return them as metrics.

    Returns:
        person_px: median height of the person in the pictures that are kept.
        cut_feet_share: of the frames with a person, those in which the feet are cut off.
        scene_change_share: of sampled frames, those with another background.
    """
    missing = ~detections.found
    if missing.any():
        warn(
            f"{missing.sum()} of {len(missing)} frames of {path} show no person and are dropped: "
            f"{format_frame_ranges(detections.frame_index, missing)}"
        )
    cropped = detections.found & are_feet_cut_off(detections)
    if cropped.any():
        warn(
            f"the feet are cut off in {cropped.sum()} frames of {path}; the avatar's feet will be less sharp: "
            f"{format_frame_ranges(detections.frame_index, cropped)}"
        )
    person_px = float(np.median(detections.person_masks[detections.found].any(axis=2).mean(axis=1))) * detections.height
    if detections.scale < 1.0 and person_px < _TARGET_PERSON_HEIGHT_PX:
        target_scale = min(1.0, detections.scale * _TARGET_PERSON_HEIGHT_PX / person_px)
        side_px = round(max(detections.width, detections.height) * target_scale / detections.scale)
        warn(
            f"the person is {person_px / detections.scale:.0f} px tall in {path} and {person_px:.0f} px in the smaller "
            f"pictures that are kept; --set frames.max_side_px={side_px} keeps more detail"
        )
    frame_index, differs = sample_scene_changes(detections)
    if differs.sum() > MAX_MOVED_FRACTION * len(differs):
        warn(
            f"the scene behind the person changes in {path} (frames {format_frame_ranges(frame_index, differs)}): "
            "the camera or the light seems to change, which causes errors of motion and colour; film again with a "
            f"fixed camera and locked exposure{_advice_to_cut(frame_index, differs)}"
        )
    if unseen_arc_rad > np.radians(_MAX_UNSEEN_ARC_DEG):
        warn(
            f"the person in {path} is never seen from {np.degrees(unseen_arc_rad):.0f} degrees of the full turn; "
            "that side will be guessed; film a full turn"
        )
    return {
        "person_px": person_px,
        "cut_feet_share": float(cropped.sum() / detections.found.sum()),
        "scene_change_share": float(differs.mean()),
    }


def _advice_to_cut(frame_index: Int[np.ndarray, "k"], differs: Bool[np.ndarray, "k"]) -> str:
    """Return what to do if the scene changes once and stays so; else nothing."""
    changes = np.flatnonzero(differs[1:] != differs[:-1]) + 1
    if len(changes) != 1:
        return ""
    first = frame_index[changes[0]]
    return f"; from frame {first} on the scene is another one: if the video shows two scenes, cut it there"


def sample_scene_changes(detections: Detections) -> tuple[Int[np.ndarray, "k"], Bool[np.ndarray, "k"]]:
    """Return frame indices, evenly spaced over frames with a person, and which of them show another background.

    Detection works on grey thumbnails: a camera shift of a few thumbnail pixels is found where the scene has edges.
    """
    found = np.flatnonzero(detections.found)
    sampled = found[evenly_spaced(len(found), _N_SCENE_FRAMES)]
    return detections.frame_index[sampled], detect_scene_changes(
        detections.gray_thumbnails[sampled][..., None].repeat(3, axis=-1),
        dilated_person_masks(detections.person_masks[sampled]),
    )


def dilated_person_masks(person_masks: Bool[np.ndarray, "n h w"]) -> Bool[np.ndarray, "n h w"]:
    """Return the masks with a margin that holds shadows and errors of the mask."""
    margin_px = round(_PERSON_MARGIN_FRACTION * max(person_masks.shape[1:]))
    kernel = np.ones((2 * margin_px + 1, 2 * margin_px + 1), np.uint8)
    return np.stack([cv2.dilate(person.astype(np.uint8), kernel) > 0 for person in person_masks])
