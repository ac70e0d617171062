"""Scores of a finished avatar: zero error for the ground truth itself, and known errors."""

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest
import torch
import trimesh
from scipy.spatial import cKDTree
from scipy.spatial.transform import Rotation

from data_tools.evaluate import compare_avatar
from data_tools.evaluate.compare_avatar import (
    compare_heldout_images,
    compare_heldout_surfaces,
    compare_matched_surfaces,
    compare_novel_poses,
    compare_novel_views,
    compare_rest_surfaces,
    compare_texture,
    render_under_light,
)
from data_tools.evaluate.comparison import Comparison, retarget_motion
from data_tools.evaluate.truth import load_true_mask
from data_tools.evaluate.upper_bound import render_upper_bound, unpose_true_vertices
from pipeline.body.body import Body, Motion, canonical_to_world
from pipeline.body.files import save_motion
from pipeline.capture.frame_selection import HELDOUT, TRAIN
from pipeline.core.errors import UserError
from pipeline.core.progress import take_warnings
from pipeline.geometry.alpha import unpremultiply_to_uint8
from pipeline.geometry.mesh import Mesh
from pipeline.geometry.similarity import SimilarityTransform
from pipeline.geometry.texture_rendering import blur_coverage
from pipeline.io.image import write_rgba
from pipeline.metrics.images import composite_on_white, frame_scores
from pipeline.texture.light import VideoLight
from tests.data_tools.ground_truth_run import (
    bent_arm,
    with_frames,
    with_longer_focal,
    with_motion,
    with_raised_rest_arm,
    with_scale,
)


@pytest.fixture(scope="module")
def perfect_upper_bound(perfect: Comparison) -> dict[str, float]:
    return compare_heldout_images(perfect)["upper_bound"]


def test_ground_truth_has_no_error(perfect: Comparison) -> None:
    for scores in (compare_rest_surfaces(perfect), compare_heldout_surfaces(perfect)):
        assert scores["chamfer_mm"] < 0.2  # four joints a vertex are kept in the export
        assert scores["f_score"] > 0.999
        assert scores["normal_angle_deg"] < 1.0
        assert scores["far_area_share"] == 0.0
        assert scores["scale_to_truth"] == pytest.approx(1.0, abs=1e-3)
    texture = compare_texture(perfect)
    assert texture["coverage"] == 1.0
    assert texture["colour_error"] < 1.0


@pytest.mark.slow
def test_heldout_surfaces_depend_on_held_out_frames_only(perfect: Comparison) -> None:
    """A wrong arm pose has an effect in held-out frames only."""
    heldout, train = (perfect.run.capture.positions(kind) for kind in (HELDOUT, TRAIN))
    wrong, trained = (
        compare_heldout_surfaces(with_motion(perfect, bent_arm(perfect, rows, 0.3))) for rows in (heldout, train)
    )
    assert wrong["chamfer_mm"] > 1.0
    assert trained["chamfer_mm"] < 0.2


@pytest.mark.slow
def test_scale_is_aligned(perfect: Comparison) -> None:
    scores = compare_rest_surfaces(with_scale(perfect, 0.9))
    assert scores["chamfer_mm"] < 0.2
    assert scores["scale_to_truth"] == pytest.approx(1 / 0.9, abs=1e-3)


@pytest.mark.slow
def test_novel_poses_of_the_true_rig(perfect: Comparison) -> None:
    scores, pictures = compare_novel_poses(perfect)
    assert scores["novel_poses"]["chamfer_mm"] < 1.0
    assert scores["novel_poses_matched"]["chamfer_mm"] < 1.0
    assert len(pictures) == 2
    assert min(picture.scores()["mask_iou"] for picture in pictures) > 0.97


@pytest.mark.slow
def test_matched_surfaces_follow_the_motion_of_the_avatar(perfect: Comparison) -> None:
    """An avatar whose arm is raised in every frame of the video is raised so in the A-pose of the true rig."""
    assert compare_matched_surfaces(perfect)["chamfer_mm"] < 0.2
    raised = with_motion(perfect, bent_arm(perfect, np.arange(len(perfect.run.capture)), 0.3))
    assert compare_rest_surfaces(raised)["chamfer_mm"] < 0.2
    assert compare_matched_surfaces(raised)["chamfer_mm"] > 1.0


@pytest.mark.slow
def test_different_rest_pose_is_no_error(perfect: Comparison) -> None:
    """A rig with a raised arm in its rest pose is compared in the A-pose of the true rig.

    Skinning twice shrinks the shoulder by some millimetres; in the rest pose, the hand is 20 cm away.
    """
    other = with_raised_rest_arm(perfect, 0.35)
    assert compare_rest_surfaces(other)["chamfer_mm"] < 1.0
    assert compare_rest_surfaces(other)["hausdorff95_mm"] < 4.0
    assert compare_novel_poses(other)[0]["novel_poses"]["chamfer_mm"] < 1.5
    assert compare_texture(other)["colour_error"] < 2.0


@pytest.mark.slow
def test_novel_views_of_the_true_avatar(perfect: Comparison) -> None:
    """The truth is lit and the avatar is unlit: masks agree, and a black avatar has a lower PSNR."""
    pictures = compare_novel_views(perfect)
    assert len(pictures) == 2
    assert min(picture.scores()["mask_iou"] for picture in pictures) > 0.98
    black = replace(perfect, run=replace(perfect.run, avatar=replace(perfect.run.avatar, diffuse=torch.zeros(4, 4, 3))))
    dark = compare_novel_views(black)
    assert dark[0].scores()["psnr_body"] < pictures[0].scores()["psnr_body"] - 3.0


def test_texture_of_known_error(perfect: Comparison) -> None:
    """Darker by a fifth, and only the left half is observed."""
    avatar = perfect.run.avatar
    darker = replace(perfect.run, avatar=replace(avatar, diffuse=0.8 * avatar.diffuse))
    half = perfect.coverage.copy()
    half[:, half.shape[1] // 2 :] = 0.0
    scores = compare_texture(replace(perfect, run=darker, coverage=half))
    whole = compare_texture(perfect)
    assert 0.2 < scores["coverage"] < 0.8
    assert scores["colour_error"] > whole["colour_error"] + 10.0
    assert scores["balanced_colour_error"] < 1.0


def test_flat_colours_give_the_texture_error_in_closed_form(perfect: Comparison) -> None:
    """A grey person estimated brighter by 10, 20 and 30 of 255; then a person of two greys estimated as one grey."""
    flat = np.array([110.0, 120.0, 130.0], dtype=np.float32) / 255
    left = np.zeros((512, 512), dtype=np.float32)
    left[:, :150] = 1.0
    found = with_textures(perfect, np.full((8, 8, 3), 100, dtype=np.uint8), np.tile(flat, (8, 8, 1)), left)
    share = surface_fraction(perfect, lambda uv: uv[..., 0] < 150 / 512)
    scores = compare_texture(found)
    assert 0.1 < share < 0.45
    assert scores["coverage"] == pytest.approx(share, abs=0.012)
    assert scores["colour_error"] == pytest.approx(20.0, abs=1e-3)
    assert scores["balanced_colour_error"] == pytest.approx(0.0, abs=1e-3)
    greys = np.where(left[..., None] > 0, np.uint8(200), np.uint8(100)).repeat(3, axis=2)
    grey = np.full((8, 8, 3), 200 / 255, dtype=np.float32)
    two = compare_texture(with_textures(perfect, greys, grey, perfect.coverage))
    assert two["coverage"] == 1.0
    assert two["colour_error"] == pytest.approx(100 * (1 - share), abs=1.2)
    assert two["balanced_colour_error"] == pytest.approx(100 * share, abs=1.2)  # the gain is right for the larger part


def with_textures(comparison: Comparison, truth: np.ndarray, found: np.ndarray, coverage: np.ndarray) -> Comparison:
    """Replace the true texture (8 bits), the texture of the avatar ([0, 1]) and the coverage."""
    subject = replace(comparison.truth.subject, texture=truth)
    avatar = replace(comparison.run.avatar, diffuse=torch.from_numpy(found))
    truth_painted, run_painted = replace(comparison.truth, subject=subject), replace(comparison.run, avatar=avatar)
    made = replace(comparison, truth=truth_painted, run=run_painted, coverage=coverage)
    vars(made).update(
        rest_mesh=comparison.rest_mesh, alignment=comparison.alignment
    )  # found for the same surfaces already
    return made


def surface_fraction(comparison: Comparison, inside: Callable[[np.ndarray], np.ndarray]) -> float:
    """Fraction of the A-pose's area whose UV satisfies a predicate, by 21 points per face."""
    subject = comparison.truth.subject
    steps = np.array([(i, j) for i in range(6) for j in range(6 - i)])
    two = (steps + 1 / 3) / 6
    corners = np.concatenate([1 - two.sum(1, keepdims=True), two], axis=1)
    a, b, c = (subject.body.vertices[subject.body.faces[:, k]] for k in range(3))
    areas = np.linalg.norm(np.cross(b - a, c - a), axis=1)
    covered = inside(np.einsum("pk,fkc->fpc", corners, subject.uv[subject.faces_uv])).mean(1)
    return float((areas * covered).sum() / areas.sum())


LOWERED_RAD = 0.7


@pytest.mark.slow
def test_limb_bound_to_the_wrong_joint_has_the_expected_distance(
    perfect: Comparison, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """An arm bound to the collar bone does not move when the true arm is lowered by `LOWERED_RAD`.

    Expected distances are between dense point samples of both surfaces, which are posed here by rotating the arm.
    """
    monkeypatch.setattr(
        compare_avatar, "align_surfaces_icp", lambda *_: SimilarityTransform(1.0, np.eye(3), np.zeros(3))
    )
    body, place = perfect.truth.subject.body, perfect.truth.ground_m
    shoulder = body.joint("LeftArm")
    limb = {shoulder}
    for joint, parent in enumerate(body.parents.tolist()):
        limb |= {joint} if parent in limb else set()
    strength = body.skin_weights[:, sorted(limb)].sum(1)
    turned = (body.vertices - body.joints_m[shoulder]) @ Rotation.from_rotvec([0.0, 0.0, -LOWERED_RAD]).as_matrix().T
    true = body.vertices + strength[:, None] * (turned + body.joints_m[shoulder] - body.vertices)
    avatar, hangs = perfect.run.avatar, torch.from_numpy(strength > 0.5)
    indices, weights = avatar.joint_indices.clone(), avatar.joint_weights.clone()
    indices[hangs], weights[hangs] = int(body.parents[shoulder]), torch.tensor([1.0, 0.0, 0.0, 0.0])
    bound = replace(avatar, joint_indices=indices, joint_weights=weights)
    write_novel_pose(tmp_path, body, shoulder, place)
    comparison = replace(perfect, folder=tmp_path, run=replace(perfect.run, avatar=bound))
    scores = compare_novel_poses(comparison)[0]["novel_poses"]
    wrong = np.where(hangs[:, None], body.vertices, true)
    surfaces = [
        trimesh.Trimesh(vertices, faces, process=False)
        for vertices, faces in ((wrong, comparison.rest_mesh.faces), (true, comparison.true_rest_mesh.faces))
    ]
    dense = [trimesh.sample.sample_surface(surface, 200_000, seed=3)[0] for surface in surfaces]
    for name, (source, target) in {"result_to_truth_mm": dense, "truth_to_result_mm": dense[::-1]}.items():
        apart_mm = 1000 * cKDTree(target).query(source[::2])[0]
        expected = np.where(apart_mm > 4.0, apart_mm, 0.0).mean()  # nearer points lie on both, between the samples
        assert scores[name] == pytest.approx(expected, rel=0.09)  # 20,000 points scatter by 3 %
    assert scores["result_to_truth_mm"] > 2 * scores["truth_to_result_mm"] > 10  # one arm in the air, one at the trunk


def write_novel_pose(folder: Path, body: Body, joint: int, place: np.ndarray) -> None:
    """Write a motion of one frame, the A-pose with one joint rotated, and an empty image of it."""
    (folder / "novel_poses").mkdir()
    rotations = np.tile(np.array([1.0, 0.0, 0.0, 0.0], dtype=np.float32), (1, len(body.joint_names), 1))
    rotations[0, joint] = [np.cos(LOWERED_RAD / 2), 0.0, 0.0, -np.sin(LOWERED_RAD / 2)]
    root_m = (body.joints_m[:1] + place).astype(np.float32)
    save_motion(folder / "novel_poses" / "motion.npz", Motion(np.zeros(1, np.int32), np.zeros(1), rotations, root_m))
    write_rgba(folder / "novel_poses" / "000000.png", np.zeros((200, 200, 4), dtype=np.uint8))


def test_upper_bound_of_true_poses(perfect: Comparison, perfect_upper_bound: dict[str, float]) -> None:
    assert np.abs(unpose_true_vertices(perfect) - perfect.truth.subject.body.vertices).max() < 1e-3
    # With the true vertices it is 66 dB; the alignment finds their scale to 0.015 %, a third of a millimetre.
    assert perfect_upper_bound["psnr_body"] > 36.0
    assert perfect_upper_bound["mask_iou"] > 0.99


@pytest.mark.slow
def test_upper_bound_has_the_edge_blur_of_the_masks(perfect: Comparison, tmp_path: Path) -> None:
    """Edges are blurred by 1.5 px in all frames: a sharp upper bound scores lower than one with equal blur."""
    soft = with_frames(perfect, tmp_path, lambda person: unpremultiply_to_uint8(blur_coverage(person, 1.5)))
    heldout = soft.run.capture.positions(HELDOUT)
    (drawn,) = render_upper_bound(soft, heldout)
    target = unpremultiply_to_uint8(blur_coverage(perfect.truth.render_person(0), 1.5))
    sharp = frame_scores(drawn, target[..., :3], target[..., 3])
    assert compare_heldout_images(soft)["upper_bound"]["psnr_full"] > sharp["psnr_full"] + 6.0


def test_missing_mask_parts_cost_only_in_the_true_mask_scores(perfect: Comparison, tmp_path: Path) -> None:
    """Masks without legs, and a field without legs: white where the true target has legs."""

    def without_legs(person: np.ndarray) -> np.ndarray:
        straight = unpremultiply_to_uint8(person)
        straight[110:, :, 3] = 0
        return straight

    cut = with_frames(perfect, tmp_path, without_legs)
    learnt = perfect.truth.render_person(0) * (np.arange(200) < 110)[:, None, None]
    scores = compare_heldout_images(replace(cut, run=replace(cut.run, field_renderer=lambda pose: learnt)))
    true = unpremultiply_to_uint8(perfect.truth.render_person(0))
    legs = (
        255.0 - composite_on_white(np.ascontiguousarray(true[..., :3]), np.ascontiguousarray(true[..., 3]))[110:]
    ) / 255.0
    expected_db = -10 * np.log10((legs**2).sum() / (200 * 200 * 3))
    kept = (true[:110, :, 3] > 127).sum() / (true[..., 3] > 127).sum()
    assert scores["field_true_mask"]["psnr_full"] == pytest.approx(expected_db, abs=0.02)
    assert scores["field_true_mask"]["mask_iou"] == pytest.approx(kept, abs=1e-6)
    assert scores["upper_bound"]["mask_iou"] == pytest.approx(kept, abs=0.01)  # the found mask blames the truth
    assert scores["upper_bound_true_mask"]["mask_iou"] > 0.99
    assert scores["mesh_true_mask"]["mask_iou"] > 0.97


def test_frame_with_an_empty_true_mask_is_left_out_with_a_warning(
    perfect: Comparison, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The true mask of the first of two held-out frames is empty: only the second is scored; then both are empty."""
    split = perfect.run.capture.split.copy()
    split[:2] = HELDOUT
    two = replace(perfect, run=replace(perfect.run, capture=replace(perfect.run.capture, split=split)))
    nothing = np.zeros((perfect.run.camera.height, perfect.run.camera.width, 4), np.float32)
    monkeypatch.setattr(compare_avatar, "render_upper_bound", lambda comparison, positions: [nothing] * len(positions))
    monkeypatch.setattr(compare_avatar, "load_true_mask", lambda out, k, size: (k > 0) * load_true_mask(out, k, size))
    take_warnings()
    assert compare_heldout_images(two)["mesh_true_mask"]["mask_iou"] > 0.98
    (warning,) = take_warnings()
    assert "held-out frame 0 is not scored" in warning
    monkeypatch.setattr(compare_avatar, "load_true_mask", lambda out, k, size: 0 * load_true_mask(out, k, size))
    with pytest.raises(UserError, match="no held-out frame can be scored"):
        compare_heldout_images(two)


@pytest.mark.slow
def test_true_masks_are_resized_to_the_frames(perfect: Comparison, tmp_path: Path) -> None:
    def halved(person: np.ndarray) -> np.ndarray:
        return unpremultiply_to_uint8(cv2.resize(person, (100, 100), interpolation=cv2.INTER_AREA))

    half = with_frames(perfect, tmp_path, halved)
    learnt = halved(perfect.truth.render_person(0)) / np.float32(255)
    scores = compare_heldout_images(replace(half, run=replace(half.run, field_renderer=lambda pose: learnt)))
    assert scores["field_true_mask"]["mask_iou"] > 0.998
    assert scores["upper_bound_true_mask"]["mask_iou"] > 0.95


@pytest.mark.slow
def test_upper_bound_ignores_scale_and_distance(perfect: Comparison, perfect_upper_bound: dict[str, float]) -> None:
    smaller = compare_heldout_images(with_scale(perfect, 0.9))["upper_bound"]
    assert smaller["psnr_body"] == pytest.approx(perfect_upper_bound["psnr_body"], abs=0.5)


@pytest.mark.slow
def test_upper_bound_of_a_longer_focal_length(perfect: Comparison) -> None:
    """A focal length and a distance that are both 1.2 times too large keep size, position and shape in the image."""
    afar = with_longer_focal(perfect, 1.2)
    apart_m = np.linalg.norm(unpose_true_vertices(afar) - perfect.truth.subject.body.vertices, axis=1)
    assert apart_m.max() < 1e-3
    assert compare_heldout_images(afar)["upper_bound"]["mask_iou"] > 0.97


@pytest.mark.slow
def test_constant_pose_error_is_compensated_by_the_shape(
    perfect: Comparison, perfect_upper_bound: dict[str, float]
) -> None:
    """An error in all frames can be compensated by the A-pose; an error in the held-out frame alone cannot."""
    frames = np.arange(len(perfect.run.motion.frame_index))
    always, once = (
        compare_heldout_images(with_motion(perfect, bent_arm(perfect, rows, 0.15)))["upper_bound"]
        for rows in (frames, frames[:1])
    )
    assert always["psnr_body"] > perfect_upper_bound["psnr_body"] - 4.0
    assert once["psnr_body"] < always["psnr_body"] - 4.0


@pytest.mark.slow
def test_unposed_vertices_ignore_depth_and_back_faces(perfect: Comparison) -> None:
    """One training frame has an error of 3 cm: a lateral error moves front-facing vertices, depth hardly any."""
    motion, camera, true = perfect.run.motion, perfect.run.camera, perfect.truth.subject.body.vertices
    frame = int(perfect.run.capture.positions(TRAIN)[0])
    moved = []
    for axis in (0, 2):
        root_m = motion.root_translation_m.copy()
        root_m[frame] += 0.03 * camera.world_to_camera[axis, :3]
        wrong = with_motion(perfect, motion.with_pose(motion.rotations_wxyz, root_m))
        moved.append(np.linalg.norm(unpose_true_vertices(wrong) - true, axis=1))
    sideways, deeper = moved
    posed = Mesh(
        perfect.run.avatar.pose_vertices(perfect.run.refined_canonical_to_world[frame]).numpy(),
        perfect.run.avatar.faces.numpy(),
    )
    towards = posed.vertex_normals() @ -camera.world_to_camera[2, :3]
    assert deeper.mean() < 0.3 * sideways.mean()
    assert sideways[towards < -0.9].mean() < 0.3 * sideways[towards > 0.9].mean()


@pytest.mark.slow
def test_missing_joints_follow_their_parent(perfect: Comparison) -> None:
    """The tip of the thumb, whose joint the fit lacks, follows the thumb."""
    body, true = perfect.run.body, perfect.truth.subject.body.vertices
    names = tuple("Tail" if name == "LeftHandThumb3" else name for name in body.joint_names)
    lacking = replace(perfect, run=replace(perfect.run, body=replace(body, joint_names=names)))
    assert np.abs(unpose_true_vertices(lacking) - true).max() < 1e-3


def test_motion_is_retargeted_by_joint_name(bare: Body, perfect: Comparison) -> None:
    """Joints that the source rig lacks do not rotate."""
    motion = perfect.truth.motion
    renamed = replace(bare, joint_names=tuple("Tail" if name == "Head" else name for name in bare.joint_names))
    taken = retarget_motion(renamed, perfect.truth.subject.body, motion)
    head, arm = renamed.joint("Tail"), renamed.joint("LeftArm")
    assert np.allclose(taken.rotations_wxyz[:, head], [1.0, 0.0, 0.0, 0.0], atol=1e-6)
    assert np.allclose(np.abs(taken.rotations_wxyz[:, arm]), np.abs(motion.rotations_wxyz[:, arm]), atol=1e-5)


def test_light_is_that_of_the_world_of_the_run(perfect: Comparison) -> None:
    """The run's world is turned by 90 degrees: its lamp at +z shines on the side that the truth has at +x."""
    light = replace(
        VideoLight.uniform(1),
        coefficients=np.zeros((9, 3), dtype=np.float32),
        key_irradiance=np.ones(3, dtype=np.float32),
        key_direction=np.array([0.0, 0.0, 1.0], dtype=np.float32),
    )
    turn = np.eye(4, dtype=np.float32)
    turn[:3, :3] = Rotation.from_euler("y", 90, degrees=True).as_matrix()  # run world to true world: +z to +x
    run = perfect.run
    camera = replace(run.camera, world_to_camera=perfect.truth.camera.world_to_camera @ turn)
    white = replace(run.avatar, light=light, diffuse=torch.ones_like(run.avatar.diffuse))
    turned = replace(perfect, run=replace(run, camera=camera, avatar=white))
    motion = perfect.rigs.match(perfect.truth.motion.select(np.array([0])))
    surface = perfect.avatar_surface(canonical_to_world(run.body, motion)[0])
    drawn = render_under_light(turned, surface, perfect.truth.camera)
    columns = np.flatnonzero(drawn[..., 3].any(axis=0))
    middle = int(columns.mean())
    halves = drawn[:, :middle], drawn[:, middle:]
    left, right = (half[half[..., 3] > 0.5, :3].mean() for half in halves)
    assert right > 1.5 * left
