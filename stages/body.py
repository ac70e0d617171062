"""body: one parametric body, its pose in every frame, and the camera, fitted to landmarks and masks."""

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Literal

import numpy as np
import torch
from jaxtyping import Bool, UInt8
from pydantic import Field

from pipeline.body.body import Motion, ParametricBody, canonical_to_world, load_anny
from pipeline.body.files import save_body, save_camera, save_motion
from pipeline.body.fit.diagnostics import (
    FRAME_RATINGS,
    finite_median,
    fit_warnings,
    make_observations,
    median_silhouette_iou,
    rate_frames,
    select_overlay_frames,
    suspicious_frames,
    usable_frames,
)
from pipeline.body.fit.fit import FitOptions, FitResult, TooFewLandmarksError, fit_body, fit_given
from pipeline.body.fit.foreign_objects import foreign_object_warnings, frames_with_foreign_objects, residual_blob_shares
from pipeline.body.fit.hand_observations import filter_hand_detections, finger_curls_rad
from pipeline.body.fit.silhouette_icp import crop_mask_window
from pipeline.body.fit.supplied_poses import SuppliedPoses
from pipeline.body.overlay import draw_overlay, overlay_grid, pose_vertices
from pipeline.body.smpl import SmplBody
from pipeline.body.smpl_file import load_smpl
from pipeline.capture.capture import Capture, load_capture
from pipeline.capture.frame_selection import TRAIN, format_frame_ranges
from pipeline.capture.hand_detector import HandLandmarks, undetected_hands
from pipeline.capture.smpl_poses import SMPL_POSES_NPZ
from pipeline.capture.usable_frames import SCORES_NPZ
from pipeline.core.cli import main
from pipeline.core.config import Config as BaseConfig
from pipeline.core.errors import UserError
from pipeline.core.progress import warn
from pipeline.core.stage import Stage
from pipeline.geometry.camera import Camera
from pipeline.io.image import to_uint8, write_rgb
from pipeline.io.npz import save_npz

_BODY, _MOTION, _CAMERA, _OVERLAY = "body.npz", "motion.npz", "camera.npz", "overlay.png"
_OVERLAY_FRAMES = 12
_DEFAULT_FOCAL_STD, _EXIF_FOCAL_STD = 0.5, 0.1
"""Relative deviations of a guessed focal length and of one in the metadata (`pipeline.capture.exif_focal`)."""


class Config(BaseConfig):
    """Options of the body stage."""

    model_file: str | None = Field(
        None, description="SMPL, SMPL-H or SMPL-X model to fit, a path to .npz or .pkl; null: the built-in body."
    )
    height_m: float | None = Field(
        None, ge=0.5, le=2.5, description="Stature of the person, metres; null: about 1.70 m, as the pictures suggest."
    )
    field_of_view_deg: float | None = Field(
        None, ge=5.0, le=150.0, description="Angle of view along the longer image side, degrees; null: estimated."
    )
    initial_focal_ratio: float = Field(
        1.2, ge=0.3, le=5.0, description="Where the estimate of the focal length starts, times the longer image side."
    )
    principal_point_std_ratio: float = Field(
        0.05,
        ge=0.0,
        le=0.3,
        description="Standard deviation of the principal point about the picture's centre where the camera is not "
        "known, longer image sides; 0: it is the centre.",
    )
    shared_frames: int = Field(48, ge=8, le=500, description="Frames from which shape and focal length are found.")
    rounds: int = Field(8, ge=1, le=50, description="Rounds of matching outlines to find shape and focal length.")
    supplied_poses: Literal["keep", "start", "ignore"] = Field(
        "keep",
        description="With an SMPL model_file, of smpl_poses.npz beside the video: keep its shape and poses; keep its "
        "shape and start from its poses, which landmarks and outlines refine; or ignore it.",
    )
    min_silhouette_iou: float = Field(
        0.5, ge=0.0, le=1.0, description="A fit is refused whose median overlap with the masks (IoU, 0 to 1) is lower."
    )
    max_dropped_share: float = Field(
        0.3,
        ge=0.0,
        le=0.9,
        description="A fit is refused that misses the person in a larger share of the training frames; fewer are "
        "left out of the training.",
    )


def run(inputs: Mapping[str, Path], out: Path, config: Config) -> Mapping[str, float]:
    """Fit the body; write body, motion, camera, a score per frame and the overlay picture."""
    capture = load_capture(inputs["frames"])
    masks = [to_uint8(capture.mask(position)) for position in range(len(capture))]
    hands = filter_hand_detections(capture.hands or undetected_hands(len(capture)), capture.landmarks_px)
    result = fit(capture, hands, masks, inputs["frames"], config)
    motion = Motion(capture.frame_index, capture.time_s, result.rotations_wxyz, result.root_translation_m)
    left_right_swapped = np.stack(list(result.left_right_swapped.values())).any(axis=0)
    save_body(out / _BODY, result.body)
    save_motion(out / _MOTION, motion)
    save_camera(out / _CAMERA, result.camera)
    blob_shares = residual_blob_shares(result.body, canonical_to_world(result.body, motion), result.camera, masks)
    usable, training = usable_frames(result), capture.split == TRAIN
    scores = {
        "silhouette_iou": result.silhouette_iou,
        "landmark_error_px": result.landmark_error_px,
        "left_right_swapped": left_right_swapped,
    }
    scores |= {"residual_blob_share": blob_shares, "usable": usable}
    save_npz(out / SCORES_NPZ, {"frame_index": capture.frame_index, **scores})
    write_rgb(out / _OVERLAY, overlay(capture, masks, result, motion, frames_with_foreign_objects(blob_shares)))
    for message in fit_warnings(result, capture.frame_index, training) + foreign_object_warnings(
        blob_shares, capture.frame_index
    ):
        warn(message)
    return {
        "silhouette_iou": float(np.nanmedian(result.silhouette_iou)),
        "silhouette_iou_worst": float(np.nanmin(result.silhouette_iou)),
        "landmark_error_px": finite_median(result.landmark_error_px),
        "focal_px": result.camera.fx,
        "focal_relative_std": result.focal_relative_std,
        "principal_x_px": result.camera.cx,
        "principal_y_px": result.camera.cy,
        "height_m": result.body.height_m(),
        "height_std_m": result.height_std_m,
        "left_right_swapped_frames": int(left_right_swapped.sum()),
        "hands_used": float((hands.handedness_score > 0.0).mean()),
        "suspicious_frames": int(suspicious_frames(result).sum()),
        "dropped_frames": int((training & ~usable).sum()),
        "frames_with_foreign_objects": int(frames_with_foreign_objects(blob_shares).sum()),
    }


def fit(
    capture: Capture, hands: HandLandmarks, masks: Sequence[UInt8[np.ndarray, "h w"]], frames_dir: Path, config: Config
) -> FitResult:
    """Fit and judge; UserError when the landmarks or the result are of no use."""
    camera, focal_relative_std = initial_camera(capture, config)
    landmarks = capture.landmarks_px, capture.landmarks_visibility, capture.landmarks_world_m
    observations = make_observations(capture.time_s, *landmarks, camera, hands)
    side_px = max(camera.width, camera.height)
    principal_point_relative_std = (
        config.principal_point_std_ratio * side_px / camera.fx if focal_relative_std > 0.0 else 0.0
    )
    options = FitOptions(
        config.height_m, focal_relative_std, principal_point_relative_std, config.shared_frames, config.rounds
    )
    windows = [crop_mask_window(mask) for mask in masks]
    model = load_anny() if config.model_file is None else load_smpl(Path(config.model_file))
    supplied = supplied_poses(capture, model, camera, focal_relative_std == 0.0, config)
    try:
        if supplied is None:
            result = fit_body(model, observations, windows, options, finger_curls_rad(model, hands))
        else:
            result = fit_given(model, observations, windows, supplied, config.supplied_poses == "keep")
    except TooFewLandmarksError as error:
        raise UserError(
            f"the body cannot be fitted to {frames_dir}: {error}; film hips and shoulders in view, or, where "
            "landmarks.npz lies beside the video, complete or remove it"
        ) from error
    check_fit_quality(result, capture, config, supplied is not None)
    return result


def check_fit_quality(result: FitResult, capture: Capture, config: Config, poses_supplied: bool) -> None:
    """UserError when the body fits the person poorly all over, or not at all in too many of the training frames."""
    remedy = (
        f"look at {capture.folder / 'contact.jpg'} for wrong masks or landmarks, film the whole body unoccluded, "
        f"{'set body.supplied_poses=start, ' if poses_supplied else ''}or"
    )
    silhouette_iou = median_silhouette_iou(result)
    if silhouette_iou < config.min_silhouette_iou:
        raise UserError(
            f"the body does not fit the person in {capture.folder}: median overlap with the masks "
            f"{silhouette_iou:.2f}, "
            f"needed {config.min_silhouette_iou:.2f}; {remedy} lower body.min_silhouette_iou"
        )
    training, unusable = capture.split == TRAIN, ~usable_frames(result)
    dropped = np.count_nonzero(training & unusable)
    if dropped > config.max_dropped_share * np.count_nonzero(training):
        raise UserError(
            f"the body does not fit the person in {dropped} of {np.count_nonzero(training)} training frames of "
            f"{capture.folder} (frames {format_frame_ranges(capture.frame_index, unusable)}); {remedy} leave "
            "these frames out "
            "with split.json, or raise body.max_dropped_share"
        )


def supplied_poses(
    capture: Capture, model: ParametricBody, camera: Camera, focal_is_known: bool, config: Config
) -> SuppliedPoses | None:
    """What others fitted, for this model and in this world; None, with a warning, where that is of no use here.

    The shape is the mean over frames: some sources fit one a frame.
    """
    poses = capture.smpl_poses
    if poses is None or config.supplied_poses == "ignore":
        return None
    if not isinstance(model, SmplBody) or not model.accepts_smpl_poses(poses.betas.shape[1]):
        reason = f"it needs an SMPL or SMPL-H model file ({poses.gender}), --set body.model_file=FILE"
    elif not focal_is_known:
        reason = "the camera that it belongs to is not known; supply camera.json or body.field_of_view_deg"
    elif len(poses.frame_index) == 0:
        reason = "it has no pose of a chosen frame"
    else:
        pose = np.concatenate([poses.global_orient, poses.body_pose], axis=1).reshape(-1, 24, 3)
        to_world = np.linalg.inv(camera.world_to_camera.astype(np.float64)) @ poses.smpl_to_camera
        betas = torch.from_numpy(poses.betas)
        rotations, root_m = model.convert_smpl_poses(
            torch.from_numpy(pose), torch.from_numpy(poses.transl), betas, torch.from_numpy(to_world).float()
        )
        rows = np.searchsorted(capture.frame_index, poses.frame_index)
        return SuppliedPoses(rows, betas.mean(0), rotations, root_m)
    warn(f"the supplied {SMPL_POSES_NPZ} is not used: {reason}")
    return None


def initial_camera(capture: Capture, config: Config) -> tuple[Camera, float]:
    """The camera to start from, and the relative deviation of its focal length (0: known).

    Supplied, by the options, as the recording's metadata say, or a guess, in this order.
    """
    if capture.camera is not None:
        return capture.camera, 0.0
    side_px = max(capture.width, capture.height)
    focal_px, std = config.initial_focal_ratio * side_px, _DEFAULT_FOCAL_STD
    if config.field_of_view_deg is not None:
        focal_px, std = 0.5 * side_px / float(np.tan(np.radians(0.5 * config.field_of_view_deg))), 0.0
    elif capture.metadata_focal_px is not None:
        focal_px, std = capture.metadata_focal_px, _EXIF_FOCAL_STD
    camera = Camera(focal_px, focal_px, 0.5 * capture.width, 0.5 * capture.height, capture.width, capture.height)
    return camera, std


def overlay(
    capture: Capture,
    masks: Sequence[UInt8[np.ndarray, "h w"]],
    result: FitResult,
    motion: Motion,
    has_foreign_object: Bool[np.ndarray, "n"],
) -> UInt8[np.ndarray, "h w 3"]:
    """Tiles of frames: up to half are the worst of those that a warning may name, marked, the others evenly spread."""
    rating = rate_frames(result, suspicious_frames(result) | has_foreign_object)
    positions = select_overlay_frames(rating, result.silhouette_iou, _OVERLAY_FRAMES)
    transforms = canonical_to_world(result.body, motion.select(positions))
    tiles = [
        draw_overlay(
            to_uint8(capture.image(int(position))),
            masks[position],
            pose_vertices(result.body, transforms[tile]),
            result.body,
            result.camera,
            f"frame {capture.frame_index[position]}  overlap {result.silhouette_iou[position]:.2f}",
            FRAME_RATINGS[rating[position]],
        )
        for tile, position in enumerate(positions)
    ]
    return overlay_grid(tiles)


STAGE = Stage(
    "body",
    version=10,
    needs=("frames",),
    makes=(_BODY, _MOTION, _CAMERA, SCORES_NPZ, _OVERLAY),
    config=Config,
    run=run,
)

if __name__ == "__main__":
    raise SystemExit(main(STAGE))
