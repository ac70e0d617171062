"""Supplied poses: interpolation over time, keeping them, and when keeping is better than refining."""

from dataclasses import replace

import cv2
import numpy as np
import pytest
import torch

from pipeline.body.fit.fit import fit_supplied_poses
from pipeline.body.fit.silhouette_icp import crop_mask_window
from pipeline.body.fit.supplied_poses import SuppliedPoses
from pipeline.body.smpl import SmplBody
from pipeline.geometry.rotation import axis_angle_to_matrix, quaternion_to_matrix
from tests.body.acting import SyntheticRecording, fitted_joints_m, joint_errors_m, swap_left_right, synthetic_recording
from tests.body.smpl_sample import sample_arrays

ACTIVE = (0, 2)


def turned(angles_rad: list[float]) -> torch.Tensor:
    """Return three joints in each frame, all rotated about +Y by the angle of the frame."""
    return axis_angle_to_matrix(torch.tensor([[[0.0, angle, 0.0]] * 3 for angle in angles_rad]))


@pytest.fixture
def supplied() -> SuppliedPoses:
    """Return poses of the frames 1 and 3."""
    return SuppliedPoses(
        np.array([1, 3]), torch.tensor([0.5, -1.0]), turned([0.2, 0.6]), torch.tensor([[0.0] * 3, [1.0] * 3])
    )


def test_poses_are_interpolated_inside_and_constant_outside(supplied: SuppliedPoses) -> None:
    state = supplied.to_fit_state(ACTIVE, torch.tensor([0.0, 1.0, 1.5, 3.0, 9.0]).double())
    assert torch.allclose(state.rotations[:, 0], turned([0.2, 0.2, 0.3, 0.6, 0.6])[:, 0].double(), atol=1e-6)
    assert state.root_m[:, 1].tolist() == pytest.approx([0.0, 0.0, 0.25, 1.0, 1.0])
    assert state.rotations.shape[1] == len(ACTIVE)
    assert state.shape.tolist() == supplied.shape.tolist()


def test_an_empty_set_of_poses_is_refused() -> None:
    empty = SuppliedPoses(np.zeros(0, np.int64), torch.zeros(2), torch.zeros(0, 3, 3, 3), torch.zeros(0, 3))
    with pytest.raises(ValueError, match="no frame has a supplied pose"):
        empty.to_fit_state(ACTIVE, torch.zeros(4).double())


def test_supplied_poses_are_restored_and_others_kept(supplied: SuppliedPoses) -> None:
    state = supplied.to_fit_state(ACTIVE, torch.arange(4).double())
    moved = replace(state, rotations=turned([0.9] * 4)[:, :2].double(), root_m=torch.full((4, 3), 5.0).double())
    back = supplied.overwrite_poses(moved, ACTIVE)
    assert (moved.root_m == 5.0).all()
    assert torch.equal(moved.rotations, moved.rotations[:1].expand(4, -1, -1, -1))
    assert torch.allclose(back.rotations[[1, 3]], supplied.rotations[:, list(ACTIVE)].double())
    assert torch.allclose(back.root_m[[1, 3]], supplied.root_m.double())
    assert torch.equal(back.rotations[[0, 2]], moved.rotations[[0, 2]])
    assert torch.equal(back.root_m[[0, 2]], moved.root_m[[0, 2]])


def test_inactive_joints_are_restored(supplied: SuppliedPoses) -> None:
    identity = np.tile(np.array([-1.0, 0.0, 0.0, 0.0], np.float32), (4, 4, 1))
    overwritten = supplied.overwrite_all_rotations(identity)
    assert (identity[..., 0] == -1.0).all()
    assert torch.allclose(
        quaternion_to_matrix(torch.from_numpy(overwritten))[[1, 3], :3], supplied.rotations, atol=1e-6
    )
    assert np.array_equal(np.abs(overwritten[:, 3]), np.abs(identity[:, 3]))
    assert (np.einsum("njc,njc->nj", overwritten[1:], overwritten[:-1]) > 0).all()


@pytest.fixture(scope="module")
def short() -> tuple[SmplBody, SyntheticRecording, SuppliedPoses]:
    """Return six frames of a person with their true poses."""
    body = SmplBody(sample_arrays(24))
    scene = synthetic_recording(body, 6, turn_rad=2.0)
    rotations = scene.model.all_joint_rotations(scene.state.rotations).float()
    return body, scene, SuppliedPoses(np.arange(6), scene.state.shape.float(), rotations, scene.state.root_m.float())


def select_frames(supplied: SuppliedPoses, rows: np.ndarray) -> SuppliedPoses:
    return replace(supplied, rows=rows, rotations=supplied.rotations[rows], root_m=supplied.root_m[rows])


def test_kept_poses_need_no_landmarks(short: tuple[SmplBody, SyntheticRecording, SuppliedPoses]) -> None:
    body, scene, supplied = short
    without_landmarks = replace(scene, landmarks_px=np.full_like(scene.landmarks_px, np.nan))
    observations, windows = without_landmarks.observations(scene.camera), scene.windows()
    result = fit_supplied_poses(body, observations, windows, supplied, keep=True)
    assert (fitted_joints_m(result, scene) - scene.joints_m()).abs().max() < 1e-4
    assert np.isnan(result.landmark_error_px).all()
    assert result.silhouette_iou.min() > 0.97
    with pytest.raises(ValueError, match="fewer than 3 frames"):
        fit_supplied_poses(body, observations, windows, select_frames(supplied, np.arange(5)), keep=True)
    with pytest.raises(ValueError, match="fewer than 3 frames"):
        fit_supplied_poses(body, observations, windows, supplied, keep=False)


def test_only_fitted_frames_count_as_corrected(short: tuple[SmplBody, SyntheticRecording, SuppliedPoses]) -> None:
    """The detector swaps left and right in frame 3, which does not matter if its pose is kept."""
    body, scene, supplied = short
    swapped = replace(scene, landmarks_px=scene.landmarks_px.copy(), landmarks_world_m=scene.landmarks_world_m.copy())
    swap_left_right(swapped, [3])
    observations, windows = swapped.observations(scene.camera), scene.windows()
    for rows, corrected in ((np.arange(6), []), (np.array([0, 1, 2, 4, 5]), [3])):
        result = fit_supplied_poses(body, observations, windows, select_frames(supplied, rows), keep=True)
        assert np.flatnonzero(result.left_right_swapped["whole body"]).tolist() == corrected
        assert result.landmark_error_px.max() < 2.0


def errors_mm(
    scene: SyntheticRecording, body: SmplBody, supplied: SuppliedPoses, clothing_px: int, keep: bool
) -> tuple[float, float]:
    """Return the joint errors, hips aligned and absolute, for masks that extend beyond the body by this distance."""
    kernel = np.ones((2 * clothing_px + 1,) * 2, np.uint8)
    windows = [crop_mask_window(cv2.dilate(mask, kernel)) for mask in scene.masks()]
    result = fit_supplied_poses(body, scene.observations(scene.camera), windows, supplied, keep)
    found = fitted_joints_m(result, scene)
    aligned_m, absolute_m = joint_errors_m(found, scene.joints_m())
    return 1e3 * aligned_m, 1e3 * absolute_m


@pytest.mark.slow
def test_poses_with_three_degrees_error_are_better_kept_with_loose_clothing() -> None:
    """Independent errors in every frame: 3 degrees of each joint, 1 cm of the root; clothing of 0 or 17 mm."""
    body = SmplBody(sample_arrays(24))
    scene = synthetic_recording(body, 24, shape={"beta_0": 1.0, "beta_1": 1.5, "beta_4": -1.0}, noise_m=0.02)
    generator = torch.Generator().manual_seed(0)
    true = scene.model.all_joint_rotations(scene.state.rotations).float()
    error = np.radians(3.0) / np.sqrt(3.0) * torch.randn(*true.shape[:2], 3, generator=generator)
    root_m = scene.state.root_m.float() + 0.01 / np.sqrt(3.0) * torch.randn(24, 3, generator=generator)
    supplied = SuppliedPoses(np.arange(24), scene.state.shape.float(), axis_angle_to_matrix(error) @ true, root_m)
    for clothing_px, kept_is_better in ((0, False), (3, True)):
        kept, refined = (errors_mm(scene, body, supplied, clothing_px, keep) for keep in (True, False))
        print(f"masks {clothing_px} px wider, aligned and absolute, mm: kept {kept}, refined {refined}")
        assert (kept[1] < refined[1]) == kept_is_better
