"""Poses that others fitted: in between by time, kept where they were given, and when that beats refining."""

from dataclasses import replace

import cv2
import numpy as np
import pytest
import torch

from pipeline.body.fit.fit import fit_given
from pipeline.body.fit.silhouette_icp import crop_mask_window
from pipeline.body.fit.supplied_poses import SuppliedPoses
from pipeline.body.smpl import SmplBody
from pipeline.geometry.rotation import axis_angle_to_matrix, quaternion_to_matrix
from tests.body.acting import SyntheticRecording, fitted_joints_m, joint_errors_m, swap_left_right, synthetic_recording
from tests.body.smpl_sample import made_up_arrays

ACTIVE = (0, 2)


def turned(angles_rad: list[float]) -> torch.Tensor:
    """Three joints a frame, each turned about +Y by the frame's angle."""
    return axis_angle_to_matrix(torch.tensor([[[0.0, angle, 0.0]] * 3 for angle in angles_rad]))


@pytest.fixture
def supplied() -> SuppliedPoses:
    """Poses of the frames 1 and 3."""
    return SuppliedPoses(
        np.array([1, 3]), torch.tensor([0.5, -1.0]), turned([0.2, 0.6]), torch.tensor([[0.0] * 3, [1.0] * 3])
    )


def test_frames_between_follow_time_and_those_outside_the_nearest(supplied: SuppliedPoses) -> None:
    state = supplied.state(ACTIVE, torch.tensor([0.0, 1.0, 1.5, 3.0, 9.0]).double())
    assert torch.allclose(state.rotations[:, 0], turned([0.2, 0.2, 0.3, 0.6, 0.6])[:, 0].double(), atol=1e-6)
    assert state.root_m[:, 1].tolist() == pytest.approx([0.0, 0.0, 0.25, 1.0, 1.0])
    assert state.rotations.shape[1] == len(ACTIVE)
    assert state.shape.tolist() == supplied.shape.tolist()


def test_no_pose_at_all_is_refused() -> None:
    nothing = SuppliedPoses(np.zeros(0, np.int64), torch.zeros(2), torch.zeros(0, 3, 3, 3), torch.zeros(0, 3))
    with pytest.raises(ValueError, match="no frame has a pose"):
        nothing.state(ACTIVE, torch.zeros(4).double())


def test_supplied_poses_are_restored_and_others_kept(supplied: SuppliedPoses) -> None:
    state = supplied.state(ACTIVE, torch.arange(4).double())
    moved = replace(state, rotations=turned([0.9] * 4)[:, :2].double(), root_m=torch.full((4, 3), 5.0).double())
    back = supplied.overwrite_poses(moved, ACTIVE)
    assert (moved.root_m == 5.0).all()
    assert torch.equal(moved.rotations, moved.rotations[:1].expand(4, -1, -1, -1))
    assert torch.allclose(back.rotations[[1, 3]], supplied.rotations[:, list(ACTIVE)].double())
    assert torch.allclose(back.root_m[[1, 3]], supplied.root_m.double())
    assert torch.equal(back.rotations[[0, 2]], moved.rotations[[0, 2]])
    assert torch.equal(back.root_m[[0, 2]], moved.root_m[[0, 2]])


def test_inactive_joints_are_restored(supplied: SuppliedPoses) -> None:
    still = np.tile(np.array([-1.0, 0.0, 0.0, 0.0], np.float32), (4, 4, 1))
    whole = supplied.overwrite_all_rotations(still)
    assert (still[..., 0] == -1.0).all()
    assert torch.allclose(quaternion_to_matrix(torch.from_numpy(whole))[[1, 3], :3], supplied.rotations, atol=1e-6)
    assert np.array_equal(np.abs(whole[:, 3]), np.abs(still[:, 3]))
    assert (np.einsum("njc,njc->nj", whole[1:], whole[:-1]) > 0).all()


@pytest.fixture(scope="module")
def short() -> tuple[SmplBody, SyntheticRecording, SuppliedPoses]:
    """Six frames of a person, and their true poses."""
    body = SmplBody(made_up_arrays(24))
    scene = synthetic_recording(body, 6, turn_rad=2.0)
    rotations = scene.model.all_joint_rotations(scene.state.rotations).float()
    return body, scene, SuppliedPoses(np.arange(6), scene.state.shape.float(), rotations, scene.state.root_m.float())


def select_frames(supplied: SuppliedPoses, rows: np.ndarray) -> SuppliedPoses:
    return replace(supplied, rows=rows, rotations=supplied.rotations[rows], root_m=supplied.root_m[rows])


def test_poses_that_are_all_kept_need_no_landmarks(short: tuple[SmplBody, SyntheticRecording, SuppliedPoses]) -> None:
    body, scene, supplied = short
    blind = replace(scene, landmarks_px=np.full_like(scene.landmarks_px, np.nan))
    seen, windows = blind.observations(scene.camera), scene.windows()
    result = fit_given(body, seen, windows, supplied, keep=True)
    assert (fitted_joints_m(result, scene) - scene.joints_m()).abs().max() < 1e-4
    assert np.isnan(result.landmark_error_px).all()
    assert result.silhouette_iou.min() > 0.97
    with pytest.raises(ValueError, match="fewer than 3 frames"):
        fit_given(body, seen, windows, select_frames(supplied, np.arange(5)), keep=True)
    with pytest.raises(ValueError, match="fewer than 3 frames"):
        fit_given(body, seen, windows, supplied, keep=False)


def test_only_fitted_frames_count_as_corrected(short: tuple[SmplBody, SyntheticRecording, SuppliedPoses]) -> None:
    """The detector takes left for right in frame 3; a kept pose owes nothing to it."""
    body, scene, supplied = short
    swapped = replace(scene, landmarks_px=scene.landmarks_px.copy(), landmarks_world_m=scene.landmarks_world_m.copy())
    swap_left_right(swapped, [3])
    seen, windows = swapped.observations(scene.camera), scene.windows()
    for rows, corrected in ((np.arange(6), []), (np.array([0, 1, 2, 4, 5]), [3])):
        result = fit_given(body, seen, windows, select_frames(supplied, rows), keep=True)
        assert np.flatnonzero(result.left_right_swapped["whole body"]).tolist() == corrected
        assert result.landmark_error_px.max() < 2.0


def errors_mm(
    scene: SyntheticRecording, body: SmplBody, supplied: SuppliedPoses, clothes_px: int, keep: bool
) -> tuple[float, float]:
    """Joint error, hips aligned and absolute, where the mask reaches this far beyond the body."""
    kernel = np.ones((2 * clothes_px + 1,) * 2, np.uint8)
    windows = [crop_mask_window(cv2.dilate(mask, kernel)) for mask in scene.masks()]
    result = fit_given(body, scene.observations(scene.camera), windows, supplied, keep)
    found = fitted_joints_m(result, scene)
    aligned_m, absolute_m = joint_errors_m(found, scene.joints_m())
    return 1e3 * aligned_m, 1e3 * absolute_m


@pytest.mark.slow
def test_poses_with_three_degrees_error_are_better_kept_with_loose_clothing() -> None:
    """Each joint 3 degrees and the root 1 cm off, anew in every frame; cloth of 0 or 17 mm around the body."""
    body = SmplBody(made_up_arrays(24))
    scene = synthetic_recording(body, 24, shape={"beta_0": 1.0, "beta_1": 1.5, "beta_4": -1.0}, noise_m=0.02)
    generator = torch.Generator().manual_seed(0)
    true = scene.model.all_joint_rotations(scene.state.rotations).float()
    error = np.radians(3.0) / np.sqrt(3.0) * torch.randn(*true.shape[:2], 3, generator=generator)
    root_m = scene.state.root_m.float() + 0.01 / np.sqrt(3.0) * torch.randn(24, 3, generator=generator)
    supplied = SuppliedPoses(np.arange(24), scene.state.shape.float(), axis_angle_to_matrix(error) @ true, root_m)
    for clothes_px, kept_is_better in ((0, False), (3, True)):
        kept, refined = (errors_mm(scene, body, supplied, clothes_px, keep) for keep in (True, False))
        print(f"masks {clothes_px} px wider, aligned and absolute, mm: kept {kept}, refined {refined}")
        assert (kept[1] < refined[1]) == kept_is_better
