"""Scores of the frames and body stages: zero error for the ground truth itself, and known errors."""

import shlex
import shutil
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest
import torch

from data_tools.command import run_command
from data_tools.evaluate import compare
from data_tools.evaluate.compare import main as compare_command
from data_tools.evaluate.compare_body import (
    compare_body,
    compare_masks,
    compare_surface,
    joint_accelerations,
    left_right_swapped_frames,
    rest_slope_rad,
    trunk_axes,
)
from data_tools.evaluate.page import LIT_NOTE
from data_tools.evaluate.truth import load_true_mask
from pipeline.body.files import load_body, load_camera, load_motion, save_body, save_camera, save_motion
from pipeline.core.errors import UserError
from pipeline.core.manifest import MANIFEST_FILE, Manifest, digest_video, write_manifest
from pipeline.geometry.rotation import axis_angle_to_quaternion, quaternion_multiply, quaternion_to_matrix
from pipeline.io.image import read_gray, write_gray
from pipeline.io.npz import save_npz


@pytest.fixture
def run(sample: Path, tmp_path: Path) -> Path:
    """A run with the ground truth as its result, on every second frame."""
    truth, rows = sample / "truth", np.array([0, 2, 4])
    (tmp_path / "frames" / "masks").mkdir(parents=True)
    (tmp_path / "body").mkdir()
    save_npz(tmp_path / "frames" / "frames.npz", {"frame_index": rows.astype(np.int32)})
    for index in rows:
        write_gray(tmp_path / "frames" / "masks" / f"{index:06d}.png", load_true_mask(sample, int(index)))
    save_body(tmp_path / "body" / "body.npz", load_body(truth / "bare.npz"))
    save_motion(tmp_path / "body" / "motion.npz", load_motion(truth / "motion.npz").select(rows))
    save_camera(tmp_path / "body" / "camera.npz", load_camera(truth / "camera.npz"))
    save_npz(tmp_path / "body" / "scores.npz", {"silhouette_iou": np.array([0.9, np.nan, 0.8])})
    return tmp_path


def test_ground_truth_has_no_error(sample: Path, run: Path) -> None:
    figures = compare_body(sample, run / "body")
    assert figures["joint_error_mm"] < 1e-3
    assert figures["scaled_joint_error_mm"] < 1e-3
    assert figures["joint_error_px"] < 1e-3
    assert figures["absolute_joint_error_mm"] < 1e-3
    assert figures["acceleration_error_ratio"] < 1e-3
    assert figures["jitter_ratio"] == pytest.approx(1.0, abs=1e-3)
    assert figures["left_right_swapped_frames"] == 0
    assert figures["silhouette_iou"] == pytest.approx(0.85)
    assert figures["focal_ratio"] == pytest.approx(1.0)
    assert figures["scale_ratio"] == pytest.approx(1.0)
    assert figures["lean_worst_deg"] < 0.1
    assert figures["camera_pitch_error_deg"] == pytest.approx(0.0, abs=1e-4)
    assert figures["camera_roll_error_deg"] == pytest.approx(0.0, abs=1e-4)
    assert compare_masks(sample, run / "frames") == {"mask_iou_median": 1.0, "mask_iou_worst": 1.0}


def test_person_of_half_the_size_at_half_the_distance(sample: Path, run: Path) -> None:
    """The image is equal, the scale is not: only the error without scale alignment changes."""
    body, motion = load_body(run / "body" / "body.npz"), load_motion(run / "body" / "motion.npz")
    save_body(run / "body" / "body.npz", replace(body, joints_m=body.joints_m / 2, vertices=body.vertices / 2))
    save_motion(run / "body" / "motion.npz", motion.with_pose(motion.rotations_wxyz, motion.root_translation_m / 2))
    figures = compare_body(sample, run / "body")
    assert figures["joint_error_px"] < 1e-2
    assert figures["scaled_joint_error_mm"] < 0.1
    assert figures["joint_error_mm"] > 100.0
    assert figures["scale_ratio"] == pytest.approx(0.5, abs=1e-4)


def test_tilt_of_the_world_changes_lean_and_camera_but_no_joint(sample: Path, run: Path) -> None:
    """The run took a camera that looks down by 6 degrees as level: person and camera are turned together."""
    motion, camera = load_motion(run / "body" / "motion.npz"), load_camera(run / "body" / "camera.npz")
    tilt = axis_angle_to_quaternion(torch.tensor([np.radians(6.0), 0.0, 0.0], dtype=torch.float32))
    matrix = quaternion_to_matrix(tilt).numpy()
    rotations = torch.from_numpy(motion.rotations_wxyz).clone()
    rotations[:, 0] = quaternion_multiply(tilt.expand(len(rotations), 4), rotations[:, 0])
    save_motion(run / "body" / "motion.npz", motion.with_pose(rotations.numpy(), motion.root_translation_m @ matrix.T))
    world_to_camera = camera.world_to_camera.copy()
    world_to_camera[:3, :3] = world_to_camera[:3, :3] @ matrix.T
    save_camera(run / "body" / "camera.npz", replace(camera, world_to_camera=world_to_camera))
    figures = compare_body(sample, run / "body")
    assert figures["absolute_joint_error_mm"] < 0.01
    assert figures["joint_error_px"] < 1e-2
    assert figures["lean_median_deg"] == pytest.approx(6.0, abs=0.2)
    assert figures["camera_pitch_error_deg"] == pytest.approx(6.0, abs=0.01)
    assert figures["camera_roll_error_deg"] == pytest.approx(0.0, abs=0.01)


def test_rest_pose_of_another_rig_does_not_count_as_lean(sample: Path, run: Path) -> None:
    """The neck joint of the run's rig is 5 cm farther forward in every pose: a slope of the axis, no lean."""
    body = load_body(run / "body" / "body.npz")
    joints_m = body.joints_m.copy()
    joints_m[body.joint("Neck"), 2] += 0.05
    other = replace(body, joints_m=joints_m)
    motion, truth = load_motion(run / "body" / "motion.npz"), load_body(sample / "truth" / "bare.npz")
    fitted, true = trunk_axes(other, motion, truth), trunk_axes(truth, motion, truth)
    assert np.degrees(rest_slope_rad(other) - rest_slope_rad(truth)) > 4.0
    assert np.degrees(np.arccos(np.clip((fitted * true).sum(1), -1.0, 1.0))).max() < 0.7


def test_translation_changes_only_the_reprojection_error(sample: Path, run: Path) -> None:
    """10 cm sideways: f times 0.1 / depth in the image, zero after aligning the hips."""
    motion, camera = load_motion(run / "body" / "motion.npz"), load_camera(run / "body" / "camera.npz")
    shifted = motion.root_translation_m + np.array([0.1, 0.0, 0.0])
    save_motion(run / "body" / "motion.npz", motion.with_pose(motion.rotations_wxyz, shifted))
    figures = compare_body(sample, run / "body")
    expected_px = camera.fx * 0.1 / -float(motion.root_translation_m[:, 2].mean())
    assert figures["joint_error_mm"] < 1e-2
    assert figures["absolute_joint_error_mm"] == pytest.approx(100.0, abs=0.1)
    assert figures["acceleration_error_ratio"] < 1e-2
    assert figures["joint_error_px"] == pytest.approx(expected_px, rel=0.05)


def test_iou_of_a_cropped_mask(sample: Path, run: Path) -> None:
    mask = load_true_mask(sample, 2)
    rows = np.flatnonzero((mask > 127).any(axis=1))
    half = np.where(np.arange(len(mask))[:, None] < rows.mean(), mask, 0).astype(np.uint8)
    write_gray(run / "frames" / "masks" / "000002.png", half)
    figures = compare_masks(sample, run / "frames")
    assert figures["mask_iou_worst"] == pytest.approx((half > 127).sum() / (mask > 127).sum())
    assert figures["mask_iou_median"] == 1.0


def test_masks_of_reduced_frames_are_compared_at_their_size(sample: Path, run: Path) -> None:
    """As a preset with frames.max_side_px below the size of the capture stores them."""
    for path in (run / "frames" / "masks").iterdir():
        write_gray(path, cv2.resize(read_gray(path), (120, 120), interpolation=cv2.INTER_AREA))
    assert compare_masks(sample, run / "frames") == {"mask_iou_median": 1.0, "mask_iou_worst": 1.0}


def test_surface_distance_of_the_true_body_ignores_translation(sample: Path, run: Path) -> None:
    motion = load_motion(run / "body" / "motion.npz")
    save_motion(run / "body" / "motion.npz", motion.with_pose(motion.rotations_wxyz, motion.root_translation_m + 0.1))
    assert compare_surface(sample, run / "body")["surface_median_mm"] < 2.0


def test_surface_distance_of_a_thinner_body(sample: Path, run: Path) -> None:
    body = load_body(run / "body" / "body.npz")
    thin = body.vertices * np.array([1.0, 1.0, 0.8], dtype=np.float32)
    save_body(run / "body" / "body.npz", replace(body, vertices=thin))
    assert 5.0 < compare_surface(sample, run / "body")["surface_median_mm"] < 40.0


def test_frame_with_exchanged_knees_is_left_right_swapped() -> None:
    names = ["Hips", "LeftLeg", "RightLeg", "Head"]
    true = np.array([[0.0, 0, 0], [0.1, -0.5, 0], [-0.1, -0.5, 0], [0, 0.6, 0]])[None].repeat(3, 0)
    fitted = true + 0.02
    fitted[1, [1, 2]] = fitted[1, [2, 1]]
    assert left_right_swapped_frames(names, fitted, true).tolist() == [False, True, False]


def test_acceleration_of_free_fall_at_non_uniform_times() -> None:
    time_s = np.array([0.0, 0.1, 0.15, 0.4, 0.5])
    positions_m = np.zeros((5, 1, 3))
    positions_m[:, 0, 1] = -0.5 * 9.81 * time_s**2
    assert np.allclose(joint_accelerations(positions_m, time_s), [0.0, -9.81, 0.0])


def test_run_of_another_capture_is_an_error(sample: Path, run: Path) -> None:
    motion = load_motion(run / "body" / "motion.npz")
    save_motion(run / "body" / "motion.npz", replace(motion, frame_index=motion.frame_index + 100))
    with pytest.raises(UserError, match="name the capture that this run was made from"):
        compare_body(sample, run / "body")


def write_manifest_of(video: Path, stage: Path, **inputs: str) -> None:
    inputs |= {"video": digest_video(video)}
    write_manifest(Manifest(stage.name, 1, "", {}, inputs, {}, {}, 1.0, 1.0), stage / MANIFEST_FILE)


def test_a_run_of_another_video_is_refused(
    sample: Path, run: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    (tmp_path / "other.mp4").write_bytes(b"another video")
    write_manifest_of(tmp_path / "other.mp4", run / "frames")
    assert run_command(compare_command, [str(sample), str(run)]) == 2
    message = capsys.readouterr().err
    assert "was not made from" in message
    (words,) = [part for part in message.split(": ") if " --run " in part]
    options = shlex.split(words)[3:]
    assert options == ["--run", str(run), "--video", str(sample / "video"), "--force"]


@pytest.mark.parametrize("reads_file", [True, False])
def test_only_the_video_of_a_capture_counts(sample: Path, run: Path, tmp_path: Path, reads_file: bool) -> None:
    """Files that were added to the folder of the video after the run change nothing, not even a second video."""
    capture = tmp_path / "capture"
    shutil.copytree(sample, capture)
    write_manifest_of(capture / "video" / ("video.mp4" if reads_file else ""), run / "frames")
    for name in ("notes.txt", "other.mp4"):
        (capture / "video" / name).write_bytes(b"another file")
        assert run_command(compare_command, [str(capture), str(run)]) == 0
    (capture / "video" / "video.mp4").write_bytes(b"another video")
    assert run_command(compare_command, [str(capture), str(run)]) == 2
    (capture / "video" / "video.mp4").unlink()
    assert run_command(compare_command, [str(capture), str(run)]) == 2


def test_a_capture_of_another_version_is_refused_before_it_is_read(
    sample: Path, run: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    write_manifest_of(sample / "video", run / "frames")
    shutil.copytree(sample / "video", tmp_path / "old" / "video")
    (tmp_path / "old" / "truth").mkdir()
    (tmp_path / "old" / "truth" / "capture_settings.json").write_text('{"version": 1}')
    assert run_command(compare_command, [str(tmp_path / "old"), str(run)]) == 2
    assert "is a capture of version 1" in capsys.readouterr().err


def test_command_prints_scores_of_finished_stages(sample: Path, run: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert run_command(compare_command, [str(sample), str(run)]) == 2
    assert "has no finished stage" in capsys.readouterr().err
    write_manifest_of(sample / "video", run / "frames")
    write_manifest_of(sample / "video", run / "body")
    assert run_command(compare_command, [str(sample), str(run)]) == 0
    printed = capsys.readouterr().out
    assert "mask_iou_median" in printed
    assert "joint_error_mm" in printed


@pytest.mark.parametrize(("light", "is_said"), [("flat", False), (LIT_NOTE, True)])
def test_command_says_where_the_light_is_not_flat(
    light: str,
    is_said: bool,
    sample: Path,
    run: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    (run / "report").mkdir()
    write_manifest_of(sample / "video", run / "report")
    monkeypatch.setattr(compare, "write_comparison", lambda out, run_dir, measured: {"light": light})
    assert run_command(compare_command, [str(sample), str(run)]) == 0
    assert ("--light flat" in capsys.readouterr().out) == is_said


def test_a_run_whose_stages_do_not_belong_together_is_refused(
    sample: Path, run: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    """Frames were selected anew: what the report calls held out is not what the frames do now."""
    (run / "report").mkdir()
    write_manifest_of(sample / "video", run / "frames")
    write_manifest_of(sample / "video", run / "report", frames="digest of other frames")
    monkeypatch.setattr(compare, "write_comparison", lambda out, run_dir, measured: {})
    assert run_command(compare_command, [str(sample), str(run)]) == 2
    assert f"{run / 'report'} was made from another result of frames than" in capsys.readouterr().err
    (run / "report" / MANIFEST_FILE).unlink()
    assert run_command(compare_command, [str(sample), str(run)]) == 0
