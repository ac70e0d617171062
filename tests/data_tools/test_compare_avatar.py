"""The comparison of a finished avatar: nothing is found wrong with the truth itself, and known errors are found."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch

from data_tools.compare_avatar import (
    Comparison,
    absorbed,
    ceiling,
    compare_filmed,
    compare_novel_poses,
    compare_novel_views,
    compare_shape,
    compare_texture,
    taken_over,
)
from pipeline.avatar.body import Body
from pipeline.avatar.selection import HELDOUT, TRAIN
from pipeline.geometry.mesh import Mesh
from pipeline.metrics.images import mean_scores
from tests.data_tools.finished import bent_arm, perfect_run, resting_otherwise, seen_from_afar, shrunk, with_motion


@pytest.fixture(scope="module")
def perfect(sample: Path, tmp_path_factory: pytest.TempPathFactory) -> Comparison:
    return perfect_run(sample, tmp_path_factory.mktemp("perfect"))


@pytest.fixture(scope="module")
def perfect_ceiling(perfect: Comparison) -> dict[str, float]:
    return mean_scores(ceiling(perfect))


def test_the_truth_has_no_error(perfect: Comparison) -> None:
    for scores in (compare_shape(perfect), compare_filmed(perfect)):
        assert scores["chamfer_mm"] < 0.2  # four joints a vertex are kept in the export
        assert scores["f_score"] > 0.999
        assert scores["scale_to_truth"] == pytest.approx(1.0, abs=1e-3)
    texture = compare_texture(perfect)
    assert texture["coverage"] == 1.0
    assert texture["colour_error"] < 1.0


def test_filmed_poses_are_those_of_held_out_frames(perfect: Comparison) -> None:
    """A wrong arm counts where it is held out, and nowhere else."""
    heldout, train = (perfect.run.capture.positions(kind) for kind in (HELDOUT, TRAIN))
    wrong, trained = (compare_filmed(with_motion(perfect, bent_arm(perfect, rows, 0.3))) for rows in (heldout, train))
    assert wrong["chamfer_mm"] > 1.0
    assert trained["chamfer_mm"] < 0.2


def test_a_smaller_person_has_the_same_shape(perfect: Comparison) -> None:
    scores = compare_shape(shrunk(perfect, 0.9))
    assert scores["chamfer_mm"] < 0.2
    assert scores["scale_to_truth"] == pytest.approx(1 / 0.9, abs=1e-3)


def test_a_motion_that_was_never_filmed(perfect: Comparison) -> None:
    scores, pictures = compare_novel_poses(perfect)
    assert scores["chamfer_mm"] < 1.0
    assert len(pictures) == 2
    assert min(picture.scores()["mask_iou"] for picture in pictures) > 0.97


def test_another_a_pose_is_no_error(perfect: Comparison) -> None:
    """A rig that rests with a raised arm (as those of other makers do) is compared in the true rig's A-pose.

    Blending twice squeezes the shoulder by some millimetres; left as it rests, the hand is 20 cm away.
    """
    other = resting_otherwise(perfect, 0.35)
    assert compare_shape(other)["chamfer_mm"] < 1.0
    assert compare_shape(other)["hausdorff95_mm"] < 4.0
    assert compare_novel_poses(other)[0]["chamfer_mm"] < 1.5
    assert compare_texture(other)["colour_error"] < 2.0


def test_cameras_that_never_filmed(perfect: Comparison) -> None:
    """The truth is lit and the avatar is not: colours that are made brighter by a fifth cost what that is in dB."""
    pictures = compare_novel_views(perfect)
    assert len(pictures) == 2
    assert min(picture.scores()["mask_iou"] for picture in pictures) > 0.98
    black = replace(perfect, run=replace(perfect.run, avatar=replace(perfect.run.avatar, diffuse=torch.zeros(4, 4, 3))))
    dark = compare_novel_views(black)
    assert dark[0].scores()["psnr_body"] < pictures[0].scores()["psnr_body"] - 3.0


def test_a_texture_of_known_error(perfect: Comparison) -> None:
    """Darker by a fifth, and only its left half seen."""
    avatar = perfect.run.avatar
    darker = replace(perfect.run, avatar=replace(avatar, diffuse=0.8 * avatar.diffuse))
    half = perfect.coverage.copy()
    half[:, half.shape[1] // 2 :] = 0.0
    scores = compare_texture(replace(perfect, run=darker, coverage=half))
    whole = compare_texture(perfect)
    assert 0.2 < scores["coverage"] < 0.8
    assert scores["colour_error"] > whole["colour_error"] + 10.0
    assert scores["balanced_colour_error"] < 1.0


def test_true_poses_leave_nothing_to_miss(perfect: Comparison, perfect_ceiling: dict[str, float]) -> None:
    assert np.abs(absorbed(perfect) - perfect.truth.subject.body.vertices).max() < 1e-3
    # With the true vertices it is 66 dB; the alignment finds their scale to 0.015 %, a third of a millimetre.
    assert perfect_ceiling["psnr_body"] > 36.0
    assert perfect_ceiling["mask_iou"] > 0.99


def test_size_and_distance_are_no_error_of_the_pose(perfect: Comparison, perfect_ceiling: dict[str, float]) -> None:
    smaller = mean_scores(ceiling(shrunk(perfect, 0.9)))
    assert smaller["psnr_body"] == pytest.approx(perfect_ceiling["psnr_body"], abs=0.5)


def test_a_longer_lens_costs_its_perspective_alone(perfect: Comparison) -> None:
    """A person who is taken for a fifth farther away, by a lens a fifth longer, keeps size, place and shape."""
    afar = seen_from_afar(perfect, 1.2)
    apart_m = np.linalg.norm(absorbed(afar) - perfect.truth.subject.body.vertices, axis=1)
    assert apart_m.max() < 1e-3
    assert mean_scores(ceiling(afar))["mask_iou"] > 0.97


def test_an_arm_that_is_always_off_belongs_to_the_shape(perfect: Comparison, perfect_ceiling: dict[str, float]) -> None:
    """The same error in all frames can be made good in the A-pose; in the held-out frame alone it cannot."""
    frames = np.arange(len(perfect.run.motion.frame_index))
    always = mean_scores(ceiling(with_motion(perfect, bent_arm(perfect, frames, 0.15))))
    once = mean_scores(ceiling(with_motion(perfect, bent_arm(perfect, frames[:1], 0.15))))
    assert always["psnr_body"] > perfect_ceiling["psnr_body"] - 4.0
    assert once["psnr_body"] < always["psnr_body"] - 4.0


def test_a_frame_moves_what_it_sees_across_the_view(perfect: Comparison) -> None:
    """One training frame 3 cm off: sideways it moves what faces the camera there; in depth it moves hardly anything."""
    motion, camera, true = perfect.run.motion, perfect.run.camera, perfect.truth.subject.body.vertices
    frame = int(perfect.run.capture.positions(TRAIN)[0])
    moved = []
    for axis in (0, 2):
        root_m = motion.root_translation_m.copy()
        root_m[frame] += 0.03 * camera.world_to_camera[axis, :3]
        wrong = with_motion(perfect, motion.with_pose(motion.rotations_wxyz, root_m))
        moved.append(np.linalg.norm(absorbed(wrong) - true, axis=1))
    sideways, deeper = moved
    posed = Mesh(perfect.run.avatar.posed(perfect.run.refined[frame]).numpy(), perfect.run.avatar.faces.numpy())
    towards = posed.vertex_normals() @ -camera.world_to_camera[2, :3]
    assert deeper.mean() < 0.3 * sideways.mean()
    assert sideways[towards < -0.9].mean() < 0.3 * sideways[towards > 0.9].mean()


def test_joints_that_the_fit_lacks_are_carried_by_their_parent(perfect: Comparison) -> None:
    """A thumb's tip follows the thumb, which never bends here, wherever the hand goes."""
    body, true = perfect.run.body, perfect.truth.subject.body.vertices
    names = tuple("Tail" if name == "LeftHandThumb3" else name for name in body.joint_names)
    lacking = replace(perfect, run=replace(perfect.run, body=replace(body, joint_names=names)))
    assert np.abs(absorbed(lacking) - true).max() < 1e-3


def test_rotations_go_by_name(bare: Body, perfect: Comparison) -> None:
    """Joints that the actor lacks keep still."""
    motion = perfect.truth.motion
    renamed = replace(bare, joint_names=tuple("Tail" if name == "Head" else name for name in bare.joint_names))
    taken = taken_over(renamed, perfect.truth.subject.body, motion)
    head, arm = renamed.joint("Tail"), renamed.joint("LeftArm")
    assert np.allclose(taken.rotations_wxyz[:, head], [1.0, 0.0, 0.0, 0.0], atol=1e-6)
    assert np.allclose(np.abs(taken.rotations_wxyz[:, arm]), np.abs(motion.rotations_wxyz[:, arm]), atol=1e-5)
