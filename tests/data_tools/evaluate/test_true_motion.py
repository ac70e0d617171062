"""Runs with the true motion: placement of the root against a known scale and offset, files against the truth."""

import shutil
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch

from data_tools.evaluate.comparison import Comparison
from data_tools.evaluate.true_motion import place_roots, prepare_run, true_motion, write_true_input
from pipeline.body.body import canonical_to_world
from pipeline.capture.user_files import load_user_files
from pipeline.capture.video import open_frame_source
from pipeline.core.errors import UserError
from pipeline.core.record import RunRecord, read_record, write_record
from pipeline.geometry.rotation import axis_angle_to_matrix
from tests.data_tools.ground_truth_run import bent_arm

CENTRE_M = np.array([0.3, 1.4, -3.0])


def turning_roots(seed: int) -> tuple[np.ndarray, np.ndarray]:
    generator = np.random.default_rng(seed)
    true_m = np.array([0.0, 0.9, 0.0]) + 0.1 * generator.normal(size=(60, 3))
    turn = torch.zeros(60, 3).double()
    turn[:, 1] = torch.linspace(0.0, 2.0 * np.pi, 60)
    return true_m, axis_angle_to_matrix(turn).numpy()


def test_scale_about_the_camera_and_offset_in_the_body_are_found() -> None:
    true_m, rotations = turning_roots(seed=0)
    fitted_m = CENTRE_M + 0.9 * (true_m - CENTRE_M) + rotations @ np.array([0.01, -0.02, 0.03])
    np.testing.assert_allclose(place_roots(fitted_m, true_m, rotations, CENTRE_M), fitted_m, atol=1e-6)


def test_noise_of_the_fit_averages_out() -> None:
    true_m, rotations = turning_roots(seed=1)
    exact_m = CENTRE_M + 1.1 * (true_m - CENTRE_M)
    noise_m = 0.02 * np.random.default_rng(2).normal(size=true_m.shape)
    placed_m = place_roots(exact_m + noise_m, true_m, rotations, CENTRE_M)
    assert np.linalg.norm(placed_m - exact_m, axis=1).max() < 0.5 * np.linalg.norm(noise_m, axis=1).mean()


def test_errors_of_the_fitted_poses_are_removed(perfect: Comparison) -> None:
    true_poses = canonical_to_world(perfect.run.body, perfect.run.motion)
    frames = np.array([1])
    bent = bent_arm(perfect, frames, 0.5)
    root_m = bent.root_translation_m.copy()
    root_m[frames] += 0.05
    rigs = replace(perfect.rigs, motion=bent.with_pose(bent.rotations_wxyz, root_m))
    found = canonical_to_world(rigs.body, true_motion(rigs))
    error_rad = np.abs((found - true_poses)[..., :3, :3].numpy()).max()  # no element differs by more than the angle
    assert error_rad < 1.5 * 0.5 / len(found)  # what is left is the mean over the frames
    assert np.abs((found - true_poses)[:, 0, :3, 3].numpy()).max() < 0.02


def test_camera_and_masks_are_those_of_the_capture(perfect: Comparison, tmp_path: Path) -> None:
    write_true_input(perfect.folder.parent, tmp_path / "input")
    source = open_frame_source(tmp_path / "input" / "video")
    files = load_user_files(tmp_path / "input" / "video", source)
    camera = perfect.truth.camera
    assert files.camera is not None
    assert files.read_mask is not None
    found = files.camera.to_camera(1.0, camera.width, camera.height)
    assert (found.fx, found.cx, found.cy) == pytest.approx((camera.fx, camera.cx, camera.cy))
    np.testing.assert_allclose(found.world_to_camera, camera.world_to_camera, atol=1e-6)
    assert (files.read_mask(0) > 127).sum() == (perfect.truth.render_frame(0)[1] > 127).sum()


def test_true_input_needs_a_capture(tmp_path: Path) -> None:
    (tmp_path / "video").mkdir()
    with pytest.raises(UserError, match="holds no ground truth"):
        write_true_input(tmp_path, tmp_path / "out")
    assert not (tmp_path / "out").exists()


def test_a_camera_in_the_hand_is_refused(hand_held: Path, tmp_path: Path) -> None:
    """Its frames are turned, the true masks and the camera are not."""
    with pytest.raises(UserError, match=r"hand-held.* 3.* make a capture without .*data_tools\.sample"):
        write_true_input(hand_held, tmp_path / "out")
    assert not (tmp_path / "out").exists()


def test_a_run_of_another_video_is_not_taken_over(perfect: Comparison, tmp_path: Path) -> None:
    capture, supplied, run = perfect.folder.parent, tmp_path / "run-true_input", tmp_path / "run"
    run.mkdir()
    write_record(RunRecord(str(tmp_path / "me.mp4")), run)
    with pytest.raises(UserError, match=r"belongs to the video .*me\.mp4"):
        prepare_run(capture, supplied, run, "default")
    assert read_record(run) == RunRecord(str(tmp_path / "me.mp4"))


def test_the_true_input_is_of_the_named_capture(perfect: Comparison, tmp_path: Path) -> None:
    capture, supplied, run = perfect.folder.parent, tmp_path / "run-true_input", tmp_path / "run"
    for _ in range(2):
        prepare_run(capture, supplied, run, "instant")
        assert read_record(run) == RunRecord(str((supplied / "video").resolve()), "instant")
    other = tmp_path / "other"
    shutil.copytree(capture / "truth", other / "truth")
    (other / "truth" / "masks" / "more.png").write_bytes(b"")
    with pytest.raises(UserError, match="is not of the capture"):
        prepare_run(other, supplied, run, "instant")
    with pytest.raises(UserError, match="holds no ground truth"):
        prepare_run(tmp_path / "none", supplied, run, "instant")
