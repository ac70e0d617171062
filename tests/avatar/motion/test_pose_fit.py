"""The pose fit recovers poses that were perturbed; other frames and correct poses do not change."""

from dataclasses import dataclass, replace

import cv2
import numpy as np
import pytest
import torch

from pipeline.avatar.motion.pose_fit import fit_poses
from pipeline.avatar.textured_avatar import TexturedAvatar
from pipeline.body.body import Body, Motion, canonical_to_world
from pipeline.geometry.camera import Camera
from pipeline.geometry.rotation import axis_angle_to_quaternion, quaternion_multiply
from pipeline.mesh.views import PosedView, crop_posed_view
from pipeline.metrics.images import frame_scores
from tests.avatar.avatar_sample import sample_body, sample_motion
from tests.stages.report_run import make_avatar

CAMERA = Camera(660.0, 660.0, 216.0, 288.0, 432, 576)
SHIFT_M = np.array([0.03, -0.02, 0.0], dtype=np.float32)


@dataclass(frozen=True)
class Bent:
    """A column of three joints in two poses, its images, and the fit from perturbed poses."""

    avatar: TexturedAvatar
    body: Body
    true: Motion
    moved: Motion
    fitted: Motion
    views: list[PosedView]
    images: list[np.ndarray]


@pytest.fixture(scope="module")
def bent() -> Bent:
    body, true = sample_body(), sample_motion(np.array([0, 5]))
    avatar = replace(make_avatar(body), diffuse=speckles())
    poses = canonical_to_world(body, true)
    images = [avatar.render(avatar.pose_vertices(pose), CAMERA, supersampling=3) for pose in poses]
    views = [
        crop_posed_view(rgba[..., :3] / np.maximum(rgba[..., 3:], 1e-6), rgba[..., 3], CAMERA, pose, 320)
        for rgba, pose in zip(images, poses, strict=True)
    ]
    turn = axis_angle_to_quaternion(torch.tensor([[0.0, 0.1, 0.0], [0.0, 0.0, 0.1], [0.0, 0.0, -0.1]]))
    rotations = quaternion_multiply(torch.from_numpy(true.rotations_wxyz), turn.expand(2, 3, 4))
    moved = true.with_pose(rotations.numpy(), true.root_translation_m + SHIFT_M)
    return Bent(avatar, body, true, moved, fit_poses(avatar, body, moved, views), views, images)


def speckles() -> torch.Tensor:
    """Coloured spots of some centimetres: the fit compares details, without the local mean of the colours."""
    noise = cv2.GaussianBlur(np.random.default_rng(0).normal(size=(256, 256, 3)), (0, 0), 4.0)
    return torch.from_numpy(np.clip(0.5 + 0.15 * noise / noise.std(), 0.0, 1.0).astype(np.float32))


def joints_m(bent: Bent, motion: Motion) -> np.ndarray:
    transforms = canonical_to_world(bent.body, motion).numpy()
    points = np.concatenate([bent.body.joints_m, np.ones((3, 1), dtype=np.float32)], axis=1)
    return np.einsum("njab,jb->nja", transforms, points)[..., :3]


def test_joints_return_to_their_positions(bent: Bent):
    before = np.linalg.norm(joints_m(bent, bent.moved) - joints_m(bent, bent.true), axis=2)
    after = np.linalg.norm((joints_m(bent, bent.fitted) - joints_m(bent, bent.true))[..., :2], axis=2)
    assert before.min() > 0.02
    # perpendicular to the viewing direction, because depth is poorly observed; without the head, which is small
    assert after[:, :2].max() < 0.006


def test_the_render_matches_the_image(bent: Bent):
    scores = []
    for motion in (bent.moved, bent.fitted):
        for pose, rgba in zip(canonical_to_world(bent.body, motion), bent.images, strict=True):
            image = np.rint(255 * rgba[..., :3] / np.maximum(rgba[..., 3:], 1e-6)).clip(0, 255).astype(np.uint8)
            drawn = bent.avatar.render(bent.avatar.pose_vertices(pose), CAMERA, supersampling=3)
            mask = np.rint(255 * rgba[..., 3]).astype(np.uint8)
            scores.append(frame_scores(drawn, image, mask)["psnr_body"])
    assert min(scores[2:]) > max(scores[:2]) + 6.0


def test_frames_are_independent(bent: Bent):
    alone = fit_poses(bent.avatar, bent.body, bent.moved.select(np.array([1])), bent.views[1:])
    assert alone.rotations_wxyz[0] == pytest.approx(bent.fitted.rotations_wxyz[1], abs=1e-4)
    assert alone.root_translation_m[0] == pytest.approx(bent.fitted.root_translation_m[1], abs=1e-4)
    assert alone.frame_index.tolist() == [bent.true.frame_index[1]]


def test_a_correct_pose_does_not_change(bent: Bent):
    again = fit_poses(bent.avatar, bent.body, bent.true, bent.views)
    assert np.abs(again.root_translation_m - bent.true.root_translation_m)[:, :2].max() < 0.003
