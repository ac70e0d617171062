"""body: fit one parametric body, its pose in every frame and the camera to landmarks and masks."""

from collections.abc import Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace
from pathlib import Path
from typing import Literal

import numpy as np
import torch
from jaxtyping import Bool, UInt8
from pydantic import Field

from pipeline.body.body import Motion, ParametricBody, canonical_to_world, load_anny
from pipeline.body.files import (
    FrameScores,
    save_body,
    save_camera,
    save_motion,
    save_scores,
)
from pipeline.body.filmed_legs import LegProfile, leg_profile, rest_with_filmed_legs
from pipeline.body.fit.detections.hand_observations import filter_hand_detections, finger_curls_rad
from pipeline.body.fit.detections.hidden_legs import hidden_leg_share
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
from pipeline.body.fit.fit import TooFewLandmarksError, fit_supplied_poses
from pipeline.body.fit.options import FitOptions
from pipeline.body.fit.rejection import fit_body_without_others
from pipeline.body.fit.result import FitResult
from pipeline.body.fit.silhouette_icp import MaskWindow, crop_mask_window
from pipeline.body.fit.supplied_poses import SuppliedPoses
from pipeline.body.fit.vertical.gravity import camera_tilt_deg
from pipeline.body.foreign_objects import foreign_object_warnings, frames_with_foreign_objects, residual_blob_shares
from pipeline.body.overlay import draw_overlay, pose_vertices, tile_overlays
from pipeline.body.settings import DEFAULT_SETTINGS, FitSettings
from pipeline.body.smpl import SmplBody
from pipeline.body.smpl_file import load_smpl
from pipeline.capture.capture import Capture, load_capture
from pipeline.capture.frame_selection import TRAIN, format_frame_ranges
from pipeline.capture.hand_detector import HandLandmarks, undetected_hands
from pipeline.capture.smpl_poses import SMPL_POSES_NPZ
from pipeline.capture.usable_frames import SCORES_NPZ
from pipeline.core.cli import main
from pipeline.core.command import rerun_command
from pipeline.core.config import Config as BaseConfig
from pipeline.core.errors import UserError
from pipeline.core.progress import warn
from pipeline.core.stage import Stage
from pipeline.geometry.camera import Camera
from pipeline.io.image import to_uint8, write_rgb

_BODY, _BARE, _MOTION, _CAMERA, _OVERLAY = "body.npz", "bare.npz", "motion.npz", "camera.npz", "overlay.png"
_OVERLAY_FRAMES = 12


class Config(BaseConfig):
    """Options of the body stage."""

    model_file: str | None = Field(
        None, description="path of an SMPL, SMPL-H or SMPL-X model (.npz or .pkl); null: the built-in body"
    )
    height_m: float | None = Field(
        None, ge=0.5, le=2.5, description="stature of the person, m; null: estimated with a prior of 1.70 m"
    )
    field_of_view_deg: float | None = Field(
        None,
        ge=5.0,
        le=150.0,
        description="field of view along the longer image side, degrees; null: from the metadata, or estimated",
    )
    shared_frames: int = Field(48, ge=8, le=500, description="frames used to estimate shape and focal length")
    rounds: int = Field(8, ge=1, le=50, description="largest number of silhouette matchings for shape and focal length")
    supplied_poses: Literal["keep", "start", "ignore"] = Field(
        "keep",
        description="use of a supplied smpl_poses.npz (needs an SMPL model_file): keep its shape and poses; start: "
        "keep its shape and refine its poses with landmarks and silhouettes; ignore it",
    )
    min_silhouette_iou: float = Field(
        0.5, ge=0.0, le=1.0, description="minimum median IoU of body and masks; a worse fit is an error"
    )
    max_dropped_share: float = Field(
        0.3,
        ge=0.0,
        le=0.9,
        description="maximum fraction of training frames whose fit is unusable; they are not trained on, more are an "
        "error",
    )


def run(
    inputs: Mapping[str, Path], out: Path, config: Config, settings: FitSettings = DEFAULT_SETTINGS
) -> Mapping[str, float]:
    """Fit the body; write it with and without clothes, motion, camera, scores of the frames and the overlay image.

    settings: for sweeps and ablations from Python; the command uses the defaults.

    Raises:
        UserError: an input cannot be read, or the fit is worse than the options allow.
    """
    capture = load_capture(inputs["frames"])
    windows = read_mask_windows(capture)
    hands = filter_hand_detections(capture.hands or undetected_hands(len(capture)), capture.landmarks_px)
    result = fit_capture(capture, hands, windows, config, settings, out)
    legs = leg_profile_of(result, capture, windows)
    hem, motion = legs.hem_height(), motion_of(result, capture)
    hem_of_skirt = legs.outline_hem() if legs.stands_off() and not result.shape_is_supplied else None
    # The first body fills a skirt: it tells what is no cloth, and how well the frames fit.
    poses = canonical_to_world(result.body, motion)
    blob_shares = residual_blob_shares(result.body, poses, result.camera, windows, hem_of_skirt)
    if hem_of_skirt is not None:
        below = fit_capture(capture, hands, windows, config, settings, out, hem_of_skirt)
        result = replace(below, silhouette_iou=result.silhouette_iou)
        hem, motion = leg_profile_of(result, capture, windows).hem_height() or hem, motion_of(result, capture)
    usable, training = usable_frames(result), capture.split == TRAIN
    if hem is not None:
        rest, bare = (rest_with_filmed_legs(body, motion, training & usable) for body in (result.body, result.bare))
        motion, body = rest.motion, replace(rest.body, hem_m=rest.body.height_on_legs_m(hem))
        result = replace(result, body=body, bare=bare.body, rotations_wxyz=motion.rotations_wxyz)
    left_right_swapped = np.stack(list(result.left_right_swapped.values())).any(axis=0)
    save_body(out / _BODY, result.body)
    save_body(out / _BARE, result.bare)
    save_motion(out / _MOTION, motion)
    save_camera(out / _CAMERA, result.camera)
    scores = FrameScores(
        frame_index=capture.frame_index,
        silhouette_iou=result.silhouette_iou,
        landmark_error_px=result.landmark_error_px,
        left_right_swapped=left_right_swapped,
        residual_blob_share=blob_shares,
        usable=usable,
    )
    save_scores(out / SCORES_NPZ, scores)
    has_foreign_object = frames_with_foreign_objects(blob_shares)
    write_rgb(out / _OVERLAY, draw_overlay_grid(capture, result, motion, has_foreign_object))
    for message in fit_warnings(result, capture.frame_index, training) + foreign_object_warnings(
        blob_shares, capture.frame_index
    ):
        warn(message)
    pitch_deg, roll_deg = camera_tilt_deg(result.camera)
    return {
        "silhouette_iou": float(np.nanmedian(result.silhouette_iou)),
        "silhouette_iou_worst": float(np.nanmin(result.silhouette_iou)),
        "landmark_error_px": finite_median(result.landmark_error_px),
        "focal_px": result.camera.fx,
        "focal_relative_std": result.focal_relative_std,
        "principal_x_px": result.camera.cx,
        "principal_y_px": result.camera.cy,
        "camera_pitch_deg": pitch_deg,
        "camera_roll_deg": roll_deg,
        "lean_deg": result.lean_deg,
        "height_m": result.body.height_m(),
        "height_std_m": result.height_std_m,
        "left_right_swapped_frames": int(left_right_swapped.sum()),
        "hands_used": float((hands.handedness_score > 0.0).mean()),
        "suspicious_frames": int(suspicious_frames(result).sum()),
        "dropped_frames": int((training & ~usable).sum()),
        "frames_with_foreign_objects": int(has_foreign_object.sum()),
        "legs_as_filmed": float(hem is not None),
        "hidden_leg_share": hidden_leg_share(capture.landmarks_visibility, capture.time_s),
    }


def motion_of(result: FitResult, capture: Capture) -> Motion:
    """Return the fitted poses of the frames of a capture."""
    return Motion(capture.frame_index, capture.time_s, result.rotations_wxyz, result.root_translation_m)


def leg_profile_of(result: FitResult, capture: Capture, windows: Sequence[MaskWindow | None]) -> LegProfile:
    """Compare the masks of the training frames with the legs of a fitted body."""
    frames = (capture.split == TRAIN) & usable_frames(result)
    return leg_profile(result.body, motion_of(result, capture), result.camera, windows, frames)


def read_mask_windows(capture: Capture) -> list[MaskWindow | None]:
    """Return each frame's mask in its matching window (None if it is empty), all that the fit needs of it."""

    def read(position: int) -> MaskWindow | None:
        return crop_mask_window(to_uint8(capture.mask(position)))

    with ThreadPoolExecutor(torch.get_num_threads()) as pool:
        return list(pool.map(read, range(len(capture))))


def fit_capture(
    capture: Capture,
    hands: HandLandmarks,
    windows: Sequence[MaskWindow | None],
    config: Config,
    settings: FitSettings = DEFAULT_SETTINGS,
    out: Path | None = None,
    hem: float | None = None,
) -> FitResult:
    """Fit the body to a capture and check the quality of the fit, but for that of a body below a skirt.

    hands: from `filter_hand_detections`. windows: of the masks, from `read_mask_windows`. out: folder of the
    checkpoints; None: none. hem: of a skirt that stands off the legs, see `FitOptions`; without supplied poses.

    Raises:
        UserError: too few landmarks, an unreadable model file, or a fit worse than the options allow.
    """
    camera, focal_relative_std = initial_camera(capture, config, settings)
    landmarks = capture.landmarks_px, capture.landmarks_visibility, capture.landmarks_world_m
    observations = make_observations(capture.time_s, *landmarks, camera, hands, capture.faces_px)
    side_px = max(camera.width, camera.height)
    principal_point_relative_std = (
        settings.principal_point_std_ratio * side_px / camera.fx if focal_relative_std > 0.0 else 0.0
    )
    options = FitOptions(
        config.height_m,
        focal_relative_std,
        principal_point_relative_std,
        config.shared_frames,
        config.rounds,
        capture.camera_pose_is_known,
        hem,
        settings,
    )
    model = load_anny() if config.model_file is None else load_smpl(Path(config.model_file))
    supplied = None
    if hem is None:
        supplied = load_supplied_poses(capture, model, camera, focal_relative_std == 0.0, config)
    try:
        if supplied is None:
            curls_rad = finger_curls_rad(model, hands)
            result = fit_body_without_others(model, observations, windows, options, curls_rad, out)
        else:
            keep = config.supplied_poses == "keep"
            result = fit_supplied_poses(model, observations, windows, supplied, keep, settings)
    except TooFewLandmarksError as error:
        again = rerun_command("frames", capture.folder)
        raise UserError(
            f"the body cannot be fitted to {capture.folder}: {error}; film with hips and shoulders in view, or "
            f"complete or remove a supplied landmarks.npz, and run {again}"
        ) from error
    if hem is None:
        check_fit_quality(result, capture, config, supplied is not None)
    return result


def check_fit_quality(result: FitResult, capture: Capture, config: Config, poses_supplied: bool) -> None:
    """Check the median silhouette IoU and the fraction of unusable training frames.

    Raises:
        UserError: one of them is worse than the options allow.
    """
    remedy = (
        f"check masks and landmarks in {capture.folder / 'contact.jpg'}, film the whole body unoccluded, "
        f"{'set body.supplied_poses=start, ' if poses_supplied else ''}or"
    )
    silhouette_iou = median_silhouette_iou(result)
    if silhouette_iou < config.min_silhouette_iou:
        raise UserError(
            f"the body does not fit the person in {capture.folder}: median silhouette IoU {silhouette_iou:.2f}, "
            f"minimum {config.min_silhouette_iou:.2f}; {remedy} lower body.min_silhouette_iou"
        )
    training, unusable = capture.split == TRAIN, ~usable_frames(result)
    dropped = np.count_nonzero(training & unusable)
    if dropped > config.max_dropped_share * np.count_nonzero(training):
        raise UserError(
            f"the body does not fit the person in {dropped} of {np.count_nonzero(training)} training frames of "
            f"{capture.folder} (frames {format_frame_ranges(capture.frame_index, unusable)}); {remedy} exclude these "
            "frames with split.json, or raise body.max_dropped_share"
        )


def load_supplied_poses(
    capture: Capture, model: ParametricBody, camera: Camera, focal_is_known: bool, config: Config
) -> SuppliedPoses | None:
    """Return user-supplied poses converted to this model and to world space; None, with a warning, if unusable.

    The shape is the mean over the frames, because some sources fit one shape per frame.
    """
    poses = capture.smpl_poses
    if poses is None or config.supplied_poses == "ignore":
        return None
    if not isinstance(model, SmplBody) or not model.accepts_smpl_poses(poses.betas.shape[1]):
        reason = f"it needs an SMPL or SMPL-H model file ({poses.gender}); add --set body.model_file=FILE"
    elif not focal_is_known:
        reason = "its camera is unknown; supply camera.json or body.field_of_view_deg"
    elif len(poses.frame_index) == 0:
        reason = "it has no pose of a selected frame"
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


def initial_camera(capture: Capture, config: Config, settings: FitSettings = DEFAULT_SETTINGS) -> tuple[Camera, float]:
    """Return the initial camera and the relative standard deviation of its focal length (0: known).

    In this order: the supplied camera, the option, the metadata of the recording, the default.
    """
    if capture.camera is not None:
        return capture.camera, 0.0
    side_px = max(capture.width, capture.height)
    focal_px, std = settings.initial_focal_ratio * side_px, settings.initial_focal_std
    if config.field_of_view_deg is not None:
        focal_px, std = 0.5 * side_px / float(np.tan(np.radians(0.5 * config.field_of_view_deg))), 0.0
    elif capture.metadata_focal_px is not None:
        focal_px, std = capture.metadata_focal_px, settings.exif_focal_std
    camera = Camera(focal_px, focal_px, 0.5 * capture.width, 0.5 * capture.height, capture.width, capture.height)
    return camera, std


def draw_overlay_grid(
    capture: Capture,
    result: FitResult,
    motion: Motion,
    has_foreign_object: Bool[np.ndarray, "n"],
) -> UInt8[np.ndarray, "h w 3"]:
    """Return tiles of at most 12 frames: up to half are those with the worst ratings, the others evenly spaced."""
    rating = rate_frames(result, suspicious_frames(result) | has_foreign_object)
    positions = select_overlay_frames(rating, result.silhouette_iou, _OVERLAY_FRAMES)
    transforms = canonical_to_world(result.body, motion.select(positions))
    tiles = [
        draw_overlay(
            to_uint8(capture.image(int(position))),
            to_uint8(capture.mask(int(position))),
            pose_vertices(result.body, transforms[tile]),
            result.body,
            result.camera,
            f"frame {capture.frame_index[position]}  IoU {result.silhouette_iou[position]:.2f}",
            FRAME_RATINGS[rating[position]],
        )
        for tile, position in enumerate(positions)
    ]
    return tile_overlays(tiles)


STAGE = Stage(
    "body",
    version=44,
    needs=("frames",),
    makes=(_BODY, _BARE, _MOTION, _CAMERA, SCORES_NPZ, _OVERLAY),
    config=Config,
    run=run,
)

if __name__ == "__main__":
    raise SystemExit(main(STAGE))
