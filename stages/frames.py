"""frames: detect the person in a recording and write selected images with alpha mattes and landmarks."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

import numpy as np
from jaxtyping import UInt8
from pydantic import Field

from pipeline.capture import frame_selection as selection
from pipeline.capture.camera_motion import camera_motion_px, stabilise_detections
from pipeline.capture.capture import CONTACT_SHEET, FRAMES_NPZ, IMAGES_FOLDER, MASKS_FOLDER, Capture, save_capture
from pipeline.capture.contact_sheet import contact_sheet
from pipeline.capture.detection import THUMBNAIL_SIDE_PX, Detections, detect_in_frames
from pipeline.capture.detection_checkpoint import load_detections, save_detections
from pipeline.capture.disjoint_split import assign_disjoint_splits
from pipeline.capture.exif_focal import metadata_focal_px
from pipeline.capture.frame_writing import write_frames
from pipeline.capture.input_checks import (
    MAX_MOVED_FRACTION,
    assess_input,
    check_frames_that_differ,
    check_input,
    lacks_head_or_feet,
    sample_scene_changes,
)
from pipeline.capture.masks.raggedness import assess_supplied_masks
from pipeline.capture.user_files import UserFiles, UserSplit, load_user_files
from pipeline.capture.video import DEFAULT_IMAGE_FPS, FrameSource, open_frame_source, read_thumbnails
from pipeline.capture.worker_pool import start_worker_pool
from pipeline.core.cli import main
from pipeline.core.config import Config as BaseConfig
from pipeline.core.errors import UserError
from pipeline.core.progress import warn
from pipeline.core.stage import Stage
from pipeline.io.image import write_rgb

CHECKPOINT = "checkpoint_detections.safetensors"
_PEOPLE_COUNT_FRAMES = 6
_CANDIDATES_PER_FRAME = 1.25
"""Frames in which the person is detected for each that is used: detections tell motion and duplicates better."""

_MAX_MOVING_NOISE = 1.0
"""Largest noise of a recording whose scene moves, levels: three times that of the real clips, which is rounding."""


class Config(BaseConfig):
    """Options of the frames stage."""

    split: Literal["interleaved", "disjoint"] = Field(
        "interleaved",
        description="held-out frames: interleaved: every eighth; disjoint: the last turn or quarter, to judge a run",
    )
    max_frames: int = Field(
        200, ge=16, le=2000, description="maximum number of selected frames, held-out frames included"
    )
    min_frames: int = Field(16, ge=5, le=1000, description="minimum number of frames with a person")
    max_detection_frames: int = Field(900, ge=16, description="maximum number of frames that are looked at")
    max_side_px: int = Field(1280, ge=64, le=8192, description="maximum longer side of the stored images, px")
    duplicate_threshold_noise_ratio: float = Field(
        3.0,
        ge=0.0,
        le=100.0,
        description="a frame is dropped if it differs from the last kept one by less than this multiple of the noise",
    )
    fps: float | None = Field(
        None, gt=0.0, le=1000.0, description="frame rate of an image folder, 1/s; null: 30. A video has its own"
    )
    workers: int = Field(2, ge=1, le=64, description="threads for detection and matting")


def run(inputs: Mapping[str, Path], out: Path, config: Config) -> Mapping[str, float]:
    """Detect the person, select frames, and write images, masks, landmarks and a contact sheet."""
    source = open_frame_source(inputs["video"], config.fps or DEFAULT_IMAGE_FPS)
    if config.fps is not None and not source.files:
        raise UserError(f"{source.path} is a video with a frame rate of its own; remove frames.fps")
    if source.n_frames < config.min_frames:
        raise UserError(f"{source.path} has {source.n_frames} frames; at least {config.min_frames} are needed")
    user_files = load_user_files(inputs["video"], source)
    if user_files.split is not None and config.split == "disjoint":
        raise UserError(f"{inputs['video']} has a split.json, which frames.split=disjoint would ignore; remove one")
    with start_worker_pool(config.workers) as workers:
        frame_indices, n_repeats = select_detection_frames(source, user_files, config)
        detections = load_detections(out / CHECKPOINT)
        if detections is None:
            detections = detect_in_frames(
                source, user_files, frame_indices, _PEOPLE_COUNT_FRAMES, config.max_side_px, workers
            )
            save_detections(out / CHECKPOINT, detections)
        if user_files.split is None:
            detections = leave_out_cut_off(detections, source.path, config.min_frames)
        check_input(detections, source.path, config.min_frames)
        detections, moved_px = stabilise_camera(detections, source, user_files)
        noise = comparison_noise(detections)
        if user_files.split is None:
            selected = select_capture_frames(detections, source.path, config, noise)
        else:
            selected = select_listed_frames(detections, user_files.split, source.path)
        chosen = selected.positions
        # The colour noise of a blurred patch is at least one level, whatever the grey thumbnails show.
        write_frames(source, user_files, detections, chosen, out, config.max_side_px, max(1.0, noise), workers)
    capture = make_capture(detections, selected, out, source, user_files)
    save_capture(capture)
    write_rgb(out / CONTACT_SHEET, contact_sheet(capture))
    if user_files.read_mask is not None and not user_files.masks_are_own_alpha:
        assess_supplied_masks(capture, source.path)
    unseen_arc_rad = selection.largest_yaw_gap_rad(selection.body_yaw_rad(capture.landmarks_world_m))
    return {
        **assess_input(detections, unseen_arc_rad, source.path),
        "frames": len(chosen),
        "masks_count": len(chosen),
        "frames_train": len(capture.positions(selection.TRAIN)),
        "frames_validation": len(capture.positions(selection.VALIDATION)),
        "frames_heldout": len(capture.positions(selection.HELDOUT)),
        "video_frames": source.n_frames,
        "dropped_no_person": int((~detections.found).sum()),
        "dropped_duplicates": n_repeats + selected.n_duplicates,
        "noise_levels": noise,
        "camera_motion_px": moved_px,
        "landmark_visibility": float(np.nan_to_num(capture.landmarks_visibility).mean()),
        "hands_found": float((detections.hands.handedness_score[chosen] > 0.0).mean()),
        "unseen_arc_deg": float(np.degrees(unseen_arc_rad)),
        "turns": selected.turns,
        "scale": detections.scale,
    }


def leave_out_cut_off(detections: Detections, path: Path, min_frames: int) -> Detections:
    """Return the detections without frames that cut off the person, as far as others show the same side.

    A person who films alone comes from the camera and goes back to it.
    """
    is_poor = lacks_head_or_feet(detections)
    replaceable = selection.find_replaceable(selection.body_yaw_rad(detections.landmarks_world_m), is_poor)
    if not replaceable.any() or (detections.found & ~replaceable).sum() < min_frames:
        return detections
    warn(
        f"{replaceable.sum()} frames of {path} that cut off the person are left out, others show the same side: "
        f"{selection.format_frame_ranges(detections.frame_index, replaceable)}"
    )
    return detections.rows(~replaceable)


def stabilise_camera(detections: Detections, source: FrameSource, user_files: UserFiles) -> tuple[Detections, float]:
    """Return the detections in stabilised pictures, and how far the camera moved the corners of its picture, px.

    Detections of a still camera stay as they are (0 px); so do all if the camera's place or SMPL motion is supplied,
    which belongs to the frames of the recording. Supplied intrinsics hold for stabilised pictures as well.
    """
    size_px, calibration = (detections.width, detections.height), user_files.camera
    if user_files.smpl_poses is not None or (calibration is not None and calibration.world_to_camera is not None):
        return detections, 0.0
    if calibration is None:
        stabilised = stabilise_detections(detections, metadata_focal_px(source, *size_px))
    else:
        camera = calibration.to_camera(detections.scale, *size_px)
        stabilised = stabilise_detections(detections, camera.fx, (camera.cx, camera.cy))
    if stabilised.to_stabilised is None:
        return detections, 0.0
    motion_px = camera_motion_px(stabilised.to_stabilised, size_px)
    n_dropped = len(detections.frame_index) - len(stabilised.frame_index)
    dropped = f", {n_dropped} left out, which would cut off the person or whose motion is unknown" if n_dropped else ""
    warn(
        f"the camera of {source.path} moves, its picture by up to {motion_px:.0f} px: the frames are stabilised"
        f"{dropped}; film with a stand for more detail"
    )
    return stabilised, motion_px


def comparison_noise(detections: Detections) -> float:
    """Return the noise with which frames are compared, levels of 255; what moves the whole scene is no noise."""
    noise = selection.estimate_noise_level(detections.gray_thumbnails)
    if noise > _MAX_MOVING_NOISE and sample_scene_changes(detections)[1].mean() > MAX_MOVED_FRACTION:
        return _MAX_MOVING_NOISE
    return noise


def select_detection_frames(source: FrameSource, user_files: UserFiles, config: Config) -> tuple[Sequence[int], int]:
    """Return the indices of frames for detection, and the number of repeated frames that were left out.

    These are the frames of a user-supplied split. Else, of a recording with more frames than are used, small pictures
    are looked at first: repeats are left out, and of the others somewhat more than used are chosen by motion.

    Raises:
        UserError: the split lists more frames than the option allows, or fewer than needed differ.
    """
    if user_files.split is None:
        every = range(0, source.n_frames, detection_stride(source.n_frames, config.max_detection_frames))
        return (every, 0) if len(every) <= config.max_frames else select_moving_frames(source, every, config)
    listed: list[int] = user_files.split.frame_index.tolist()
    if len(listed) > config.max_frames:
        raise UserError(
            f"split.json of {source.path} lists {len(listed)} frames, frames.max_frames is {config.max_frames}; "
            f"list fewer, or allow them with --set frames.max_frames={len(listed)}"
        )
    return listed, 0


def select_moving_frames(source: FrameSource, indices: range, config: Config) -> tuple[Sequence[int], int]:
    """Return frames at equal steps of motion, `_CANDIDATES_PER_FRAME` for each that is used, and count the repeats.

    Raises:
        UserError: fewer frames than needed differ.
    """
    index, thumbnails = read_thumbnails(source, set(indices).__contains__, THUMBNAIL_SIDE_PX)
    noise = selection.estimate_noise_level(thumbnails)
    repeats, motion = selection.find_repeats(thumbnails, config.duplicate_threshold_noise_ratio * noise)
    moving = np.flatnonzero(~repeats)
    check_frames_that_differ(len(moving), len(index), source.path, config.min_frames)
    if config.split == "interleaved":  # a disjoint split is made of what is detected in all frames
        split, count = selection.assign_splits(index[moving]), round(_CANDIDATES_PER_FRAME * config.max_frames)
        moving = moving[selection.select_frames_by_motion(split, motion[moving], count)]
    return index[moving].tolist(), int(repeats.sum())


def detection_stride(n_frames: int, max_detection_frames: int) -> int:
    """Return the smallest odd stride with few enough frames; odd, so that all indices modulo 8 are equally frequent."""
    stride = -(-n_frames // max_detection_frames)
    return stride + 1 - stride % 2


@dataclass(frozen=True)
class FrameChoice:
    """The selected frames.

    positions: in the detections, increasing.
    split: of each of them.
    split_rule: in words, `Capture.split_rule`.
    turns: of the person in the whole recording, nan where a user-supplied split makes them irrelevant.
    n_duplicates: near-duplicates that were dropped.
    """

    positions: list[int]
    split: UInt8[np.ndarray, "k"]
    split_rule: str
    turns: float
    n_duplicates: int


def select_capture_frames(detections: Detections, path: Path, config: Config, noise: float) -> FrameChoice:
    """Select frames by motion and split them.

    Raises:
        UserError: too few frames are left for learning, validation or judgement.
    """
    found = np.flatnonzero(detections.found)
    threshold = config.duplicate_threshold_noise_ratio * noise
    distinct, cumulative_motion = selection.find_distinct_frames(
        detections.gray_thumbnails[found], detections.person_masks[found], threshold
    )
    kept = found[distinct]
    yaw_rad = selection.body_yaw_rad(detections.landmarks_world_m[kept])
    disjoint = assign_disjoint_splits(detections.frame_index[kept], yaw_rad)
    if config.split == "disjoint":
        split, rule = disjoint.split, f"disjoint: {disjoint.held_out_part} held out"
    else:
        split, rule = selection.assign_splits(detections.frame_index[kept]), selection.INTERLEAVED_RULE
    chosen = selection.select_frames_by_motion(split, cumulative_motion[distinct], config.max_frames)
    if chosen.sum() < config.min_frames or len(np.unique(split[chosen])) < 3:
        advice = " use --set frames.split=interleaved," if config.split == "disjoint" else ""
        raise UserError(
            f"{path} has only {chosen.sum()} frames in which the person has moved, {config.min_frames} are needed;"
            f"{advice} film a slow full turn, or lower frames.duplicate_threshold_noise_ratio"
        )
    return FrameChoice(kept[chosen].tolist(), split[chosen], rule, disjoint.turns, int((~distinct).sum()))


def select_listed_frames(detections: Detections, split: UserSplit, path: Path) -> FrameChoice:
    """Return the frames of a user-supplied split in which the person was found."""
    kept = np.flatnonzero(detections.found)
    kinds = split.for_frames(detections.frame_index[kept])
    if len(np.unique(kinds)) < 3:
        raise UserError(f"split.json of {path}: one of its lists has no frame with a person; list other frames")
    return FrameChoice(kept.tolist(), kinds, "split.json", float("nan"), 0)


def make_capture(
    detections: Detections, selected: FrameChoice, out: Path, source: FrameSource, user_files: UserFiles
) -> Capture:
    """Collect the data of the selected frames."""
    chosen = selected.positions
    frame_index = detections.frame_index[chosen]
    return Capture(
        folder=out,
        frame_index=frame_index,
        time_s=detections.time_s[chosen],
        split=selected.split,
        split_rule=selected.split_rule,
        fps=source.fps,
        width=detections.width,
        height=detections.height,
        landmarks_px=detections.landmarks_px[chosen],
        landmarks_visibility=detections.landmarks_visibility[chosen],
        landmarks_world_m=detections.landmarks_world_m[chosen],
        camera=None
        if user_files.camera is None
        else user_files.camera.to_camera(detections.scale, detections.width, detections.height),
        mask_source=user_files.mask_source or "detector",
        n_video_frames=source.n_frames,
        scale=detections.scale,
        metadata_focal_px=metadata_focal_px(source, detections.width, detections.height),
        hands=detections.hands.rows(chosen),
        faces_px=detections.faces_px[chosen],
        smpl_poses=None if user_files.smpl_poses is None else user_files.smpl_poses.for_frames(frame_index),
        camera_pose_is_known=user_files.camera is not None and user_files.camera.world_to_camera is not None,
    )


STAGE = Stage(
    "frames",
    version=19,
    needs=("video",),
    makes=(FRAMES_NPZ, IMAGES_FOLDER, MASKS_FOLDER, CONTACT_SHEET),
    config=Config,
    run=run,
)

if __name__ == "__main__":
    raise SystemExit(main(STAGE))
