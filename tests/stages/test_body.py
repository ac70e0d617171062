from dataclasses import replace
from pathlib import Path
from unittest import mock

import numpy as np
import pytest
import torch
from pydantic import ValidationError

from pipeline.body.body import load_anny
from pipeline.body.files import load_body, load_camera, load_motion, load_scores
from pipeline.body.filmed_legs import HEIGHTS, LegProfile
from pipeline.body.fit.fit import TooFewLandmarksError
from pipeline.body.fit.rejection import fit_body_without_others
from pipeline.body.fit.result import FitResult
from pipeline.body.overlay import BODY_OUTLINE_RGB, MASK_OUTLINE_RGB, WARNING_RGB
from pipeline.body.settings import FitSettings
from pipeline.capture.capture import (
    IMAGES_FOLDER,
    MASKS_FOLDER,
    Capture,
    image_path,
    load_capture,
    mask_path,
    save_capture,
)
from pipeline.capture.smpl_poses import save_smpl_poses
from pipeline.core.errors import UserError
from pipeline.core.progress import take_warnings
from pipeline.core.stage import CHECKPOINT_PREFIX
from pipeline.geometry.camera import Camera, transform_world_to_camera
from pipeline.io.image import read_rgb, write_gray, write_rgb
from stages.body import STAGE, Config, check_fit_quality, fit_capture, initial_camera, read_mask_windows, run
from tests.body.acting import SyntheticRecording, synthetic_recording
from tests.body.fit.test_diagnostics import result
from tests.capture.test_smpl_poses import make_poses

FRAMES = 8


@pytest.fixture(scope="module")
def scene() -> SyntheticRecording:
    """Return a recording in which all hands but one have a high handedness score."""
    scene = synthetic_recording(load_anny(), FRAMES, turn_rad=2.0, noise_m=0.005)
    scene.hands.handedness_score[2, 0] = 0.4
    return scene


def write_capture(folder, scene: SyntheticRecording, camera: Camera | None, masks: list[np.ndarray]) -> None:
    """Write the artifact of the frames stage: grey images, masks, landmarks."""
    for name in (IMAGES_FOLDER, MASKS_FOLDER):
        (folder / name).mkdir(parents=True)
    index = 3 * np.arange(FRAMES, dtype=np.int32)
    for position, mask in enumerate(masks):
        write_gray(mask_path(folder, int(index[position])), mask)
        write_rgb(image_path(folder, int(index[position])), np.repeat(mask[..., None] // 3 + 60, 3, axis=2))
    save_capture(
        Capture(
            folder=folder,
            frame_index=index,
            time_s=scene.time_s,
            split=np.zeros(FRAMES, dtype=np.uint8),
            fps=10.0,
            width=scene.camera.width,
            height=scene.camera.height,
            landmarks_px=scene.landmarks_px.astype(np.float32),
            landmarks_visibility=np.ones((FRAMES, 33), dtype=np.float32),
            landmarks_world_m=scene.landmarks_world_m.astype(np.float32),
            camera=camera,
            mask_source="truth",
            n_video_frames=3 * FRAMES,
            scale=1.0,
            hands=scene.hands,
        )
    )


def test_stage_writes_body_motion_camera_scores_and_overlay(tmp_path, scene: SyntheticRecording) -> None:
    frames, out = tmp_path / "frames", tmp_path / "body"
    out.mkdir()
    write_capture(frames, scene, scene.camera, scene.masks())
    metrics = run({"frames": frames}, out, Config(height_m=scene.model.height_m()[0], rounds=2))
    written = {path.name for path in out.iterdir()}
    assert {name for name in written if not name.startswith(CHECKPOINT_PREFIX)} == set(STAGE.makes)
    assert metrics["silhouette_iou"] > 0.94
    assert metrics["landmark_error_px"] < 4.0
    assert metrics["focal_px"] == scene.camera.fx
    assert metrics["left_right_swapped_frames"] == 0
    assert metrics["hands_used"] == 1.0 - 0.5 / FRAMES
    motion, body = load_motion(out / "motion.npz"), load_body(out / "body.npz")
    assert np.array_equal(motion.frame_index, 3 * np.arange(FRAMES))
    assert np.array_equal(motion.time_s, scene.time_s)
    # Without a supplied pose of the camera the floor is y = 0: only positions in the camera's axes are comparable.
    camera = load_camera(out / "camera.npz")
    root_m = transform_world_to_camera(torch.from_numpy(motion.root_translation_m).double(), camera)
    assert (root_m - transform_world_to_camera(scene.state.root_m, scene.camera)).abs().max() < 0.05
    assert metrics["camera_pitch_deg"] == pytest.approx(0.0, abs=3.0)
    assert metrics["camera_roll_deg"] == pytest.approx(0.0, abs=3.0)
    assert 0.7 < motion.root_translation_m[:, 1].mean() < 1.2
    bare = load_body(out / "bare.npz")
    assert np.abs(bare.joints_m - body.joints_m).max() < 0.005
    assert bare.vertices.shape == body.vertices.shape
    assert body.height_m() == pytest.approx(scene.model.height_m()[0], abs=0.03)
    assert load_camera(out / "camera.npz").fx == scene.camera.fx
    scores = load_scores(out / "scores.npz")
    assert scores.silhouette_iou.shape == (FRAMES,)
    assert metrics["silhouette_iou_worst"] == scores.silhouette_iou.min()
    assert scores.residual_blob_share.max() < 0.005
    assert metrics["frames_with_foreign_objects"] == metrics["dropped_frames"] == 0
    assert scores.usable.all()
    tiles = read_rgb(out / "overlay.png")
    mask_px, body_px = ((tiles == colour).all(-1).sum() for colour in (MASK_OUTLINE_RGB, BODY_OUTLINE_RGB))
    assert 0 < mask_px < 0.6 * body_px  # where both agree, the body's outline hides that of the mask
    assert not (tiles == WARNING_RGB).all(-1).any()
    assert take_warnings() == []


def test_below_a_skirt_that_stands_off_the_body_is_fitted_again(tmp_path, scene: SyntheticRecording) -> None:
    """The frames keep the IoU of the first fit, which fills the skirt. Ignored poses change nothing."""
    write_capture(tmp_path / "frames", scene, scene.camera, scene.masks())
    save_smpl_poses(tmp_path / "frames" / "smpl_poses.npz", make_poses(FRAMES))
    (tmp_path / "body").mkdir()
    margin_m = np.where(HEIGHTS < 0.9, 0.12, 0.0)
    rows, open_px = np.ones(len(HEIGHTS)), np.where(HEIGHTS < 0.9, 0.0, 8.0)
    skirt = LegProfile(margin_m, 8.0 * rows, open_px, margin_m + 0.15, 0.2 * rows, 0.4)
    fits = []

    def fit_and_remember(*args) -> FitResult:
        fits.append(fit_body_without_others(*args))
        return fits[-1]

    with (
        mock.patch("stages.body.leg_profile_of", return_value=skirt),
        mock.patch("stages.body.fit_body_without_others", side_effect=fit_and_remember) as fit,
        mock.patch("stages.body.check_fit_quality", wraps=check_fit_quality) as check,
    ):
        config = Config(height_m=scene.model.height_m()[0], rounds=1, supplied_poses="ignore")
        run({"frames": tmp_path / "frames"}, tmp_path / "body", config)
    assert [call.args[3].hem for call in fit.call_args_list] == [None, skirt.outline_hem()]
    check.assert_called_once()  # below a skirt the body does not fill the mask
    scores = load_scores(tmp_path / "body" / "scores.npz")
    np.testing.assert_array_equal(scores.silhouette_iou, fits[0].silhouette_iou)
    assert not np.array_equal(fits[0].silhouette_iou, fits[1].silhouette_iou)
    body = load_body(tmp_path / "body" / "body.npz")
    assert body.hem_m == pytest.approx(body.height_on_legs_m(skirt.hem_height() or np.nan))


@pytest.mark.parametrize("is_known", [True, False])
def test_the_vertical_is_estimated_unless_the_camera_pose_is_supplied(
    tmp_path, scene: SyntheticRecording, is_known: bool
) -> None:
    masks = scene.masks()
    write_capture(tmp_path / "frames", scene, scene.camera, masks)
    capture = replace(load_capture(tmp_path / "frames"), camera_pose_is_known=is_known)
    stop = mock.patch("stages.body.fit_body_without_others", side_effect=TooFewLandmarksError("stop"))
    with stop as fit, pytest.raises(UserError, match="stop"):
        fit_capture(capture, scene.hands, read_mask_windows(capture), Config())
    assert fit.call_args.args[3].vertical_is_known is is_known


@pytest.mark.slow
def test_an_unusable_frame_is_marked_reported_and_dropped(tmp_path, scene: SyntheticRecording) -> None:
    frames, out = tmp_path / "frames", tmp_path / "body"
    out.mkdir()
    masks = scene.masks()
    masks[3] = np.roll(masks[3], 70, axis=1)
    write_capture(frames, scene, scene.camera, masks)
    take_warnings()
    metrics = run({"frames": frames}, out, Config(rounds=1))
    assert metrics["dropped_frames"] == 1
    assert np.flatnonzero(~load_scores(out / "scores.npz").usable).tolist() == [3]
    assert any(
        warning.startswith("frames 9: the body does not match the person; 1 frame") for warning in take_warnings()
    )
    assert (read_rgb(out / "overlay.png") == WARNING_RGB).all(-1).any()


def capture_of(split: list[int]) -> Capture:
    """Return a capture with the attributes that the quality check uses."""
    index = 2 * np.arange(len(split))
    return mock.MagicMock(spec=Capture, folder=Path("frames"), split=np.array(split), frame_index=index)


def test_a_fit_without_masks_is_refused() -> None:
    fit = result(silhouette_iou=np.full(12, np.nan))
    with pytest.raises(UserError, match="median silhouette IoU 0.00"):
        check_fit_quality(fit, capture_of([0] * 12), Config(), False)
    with pytest.raises(UserError, match="in 12 of 12 training frames"):
        check_fit_quality(fit, capture_of([0] * 12), Config(min_silhouette_iou=0.0), False)


@pytest.mark.slow
def test_a_fit_with_too_many_unusable_frames_is_refused() -> None:
    silhouette_iou = np.where(np.arange(12) < 4, 0.3, 0.9)
    with pytest.raises(UserError, match=r"in 4 of 12 training frames.*frames 0-6.*split.json.*body.max_dropped_share"):
        check_fit_quality(result(silhouette_iou=silhouette_iou), capture_of([0] * 12), Config(), False)
    check_fit_quality(
        result(silhouette_iou=silhouette_iou), capture_of([0] * 12), Config(max_dropped_share=0.34), False
    )
    check_fit_quality(result(silhouette_iou=silhouette_iou), capture_of([0, 0, 1, 2] + [0] * 8), Config(), False)
    check_fit_quality(
        result(silhouette_iou=np.maximum(silhouette_iou, 0.75)),
        capture_of([0] * 12),
        Config(max_dropped_share=0.0),
        False,
    )


@pytest.mark.slow
def test_a_foreign_object_is_reported(tmp_path, scene: SyntheticRecording) -> None:
    frames, out = tmp_path / "frames", tmp_path / "body"
    out.mkdir()
    masks = scene.masks()
    top, left = np.argwhere(masks[3] > 0).min(axis=0)
    masks[3][top : top + 30, left - 20 : left + 10] = 255
    write_capture(frames, scene, scene.camera, masks)
    take_warnings()
    metrics = run({"frames": frames}, out, Config(rounds=1))
    assert metrics["frames_with_foreign_objects"] == 1
    assert any(warning.startswith("frames 9: the mask contains another object") for warning in take_warnings())


def test_masks_of_another_object_are_refused_with_a_remedy(tmp_path, scene: SyntheticRecording) -> None:
    frames, out = tmp_path / "frames", tmp_path / "body"
    out.mkdir()
    wrong_mask = np.zeros((scene.camera.height, scene.camera.width), dtype=np.uint8)
    wrong_mask[280:315, 5:250] = 255
    write_capture(frames, scene, scene.camera, [wrong_mask] * FRAMES)
    with pytest.raises(UserError, match=r"does not fit the person .* body.min_silhouette_iou"):
        run({"frames": frames}, out, Config(rounds=1))


def test_landmarks_without_depth_are_refused_with_a_remedy(tmp_path, scene: SyntheticRecording) -> None:
    frames, out = tmp_path / "frames", tmp_path / "body"
    out.mkdir()
    flat = synthetic_recording(load_anny(), FRAMES)
    flat.landmarks_world_m[:] = np.nan
    write_capture(frames, flat, flat.camera, scene.masks())
    with pytest.raises(UserError, match="in pixels and in 3D.*landmarks.npz"):
        run({"frames": frames}, out, Config())


def test_a_supplied_principal_point_is_kept(tmp_path, scene: SyntheticRecording) -> None:
    """A supplied camera overrides the option of the field of view."""
    camera = replace(scene.camera, cx=scene.camera.cx + 30.0, cy=scene.camera.cy - 20.0)
    write_capture(tmp_path, scene, camera, [])
    found, std = initial_camera(load_capture(tmp_path), Config(field_of_view_deg=90.0))
    assert (found.cx, found.cy, std) == (camera.cx, camera.cy, 0.0)


def test_camera_priority_supplied_option_metadata_default(tmp_path, scene: SyntheticRecording) -> None:
    for name, camera in (("known", scene.camera), ("unknown", None)):
        write_capture(tmp_path / name, scene, camera, [])
    known, unknown = (load_capture(tmp_path / name) for name in ("known", "unknown"))
    assert initial_camera(known, Config(field_of_view_deg=90.0)) == (known.camera, 0.0)
    camera, std = initial_camera(unknown, Config(field_of_view_deg=90.0))
    assert std == 0.0
    assert camera.fx == pytest.approx(0.5 * scene.camera.height)
    camera, std = initial_camera(unknown, Config(), FitSettings(initial_focal_ratio=1.5))
    assert std == 0.5
    assert camera.fx == pytest.approx(1.5 * scene.camera.height)
    camera, std = initial_camera(replace(unknown, metadata_focal_px=333.0), Config())
    assert (camera.fx, std) == (333.0, 0.1)


@pytest.mark.parametrize("values", [{"height_m": 30.0}, {"rounds": 0}, {"max_dropped_share": 1.0}, {"heigth_m": 1.7}])
def test_values_out_of_range_and_typos_are_refused(values: dict) -> None:
    with pytest.raises(ValidationError):
        Config(**values)
