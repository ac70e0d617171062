"""Finished runs for tests: the ground truth of the sample as an in-memory run, with known errors."""

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import torch

from data_tools.evaluate import files
from data_tools.evaluate.comparison import Comparison
from data_tools.evaluate.truth import load_ground_truth
from data_tools.synthetic.scene.capture import SyntheticCapture
from pipeline.avatar.finished_run import FinishedRun
from pipeline.avatar.textured_avatar import TexturedAvatar
from pipeline.body.body import Motion, canonical_to_world
from pipeline.capture.capture import Capture, image_path, mask_path
from pipeline.capture.frame_selection import assign_splits
from pipeline.core.manifest import MANIFEST_FILE, Manifest, digest_files, write_manifest
from pipeline.geometry.alpha import unpremultiply_to_uint8
from pipeline.geometry.rotation import axis_angle_to_matrix, axis_angle_to_quaternion, quaternion_multiply
from pipeline.geometry.skinning import forward_kinematics, skinning_transforms, top_k_weights
from pipeline.io.image import write_gray, write_rgb


def write_fake_report(run_dir: Path, fingerprint: str = "print") -> None:
    """Write an empty report with a manifest."""
    report = run_dir / "report"
    report.mkdir(parents=True, exist_ok=True)
    manifest = Manifest("report", 1, fingerprint, {}, {}, digest_files(report), {}, 1.0, 1.0)
    write_manifest(manifest, report / MANIFEST_FILE)


def write_fake_comparison(run_dir: Path) -> None:
    """Write a report, and a complete comparison of it with a Chamfer distance of 6.5 mm."""
    write_fake_report(run_dir)
    files.save_comparison(run_dir, {"mesh_matched": {"chamfer_mm": 6.5}}, "a page", "print")


def ground_truth_run(sample: Path, folder: Path) -> Comparison:
    """Return a run with the true person, texture, poses and camera; its frames are written to `folder`."""
    truth = load_ground_truth(sample)
    subject = truth.subject
    _write_frames(truth, folder, unpremultiply_to_uint8)
    indices, weights = top_k_weights(subject.body.skin_weights)
    avatar = TexturedAvatar(
        vertices=torch.from_numpy(subject.body.vertices),
        faces=torch.from_numpy(subject.body.faces),
        joint_indices=torch.from_numpy(indices.astype(np.int64)),
        joint_weights=torch.from_numpy(weights),
        uv=torch.from_numpy(subject.uv),
        faces_uv=torch.from_numpy(subject.faces_uv),
        diffuse=subject.texture_tensor(),
    )
    run = FinishedRun(
        capture=_capture(folder, truth.motion, truth.camera.width, truth.fps),
        camera=truth.camera,
        body=subject.body,
        motion=truth.motion,
        avatar=avatar,
        field_renderer=lambda pose: np.zeros((truth.camera.height, truth.camera.width, 4), dtype=np.float32),
        refined_canonical_to_world=canonical_to_world(subject.body, truth.motion),
        fitted_canonical_to_world=canonical_to_world(subject.body, truth.motion),
    )
    coverage = np.ones(subject.texture.shape[:2], dtype=np.float32)
    return Comparison(run, coverage, truth, sample / "truth")


def with_frames(comparison: Comparison, folder: Path, change: Callable[[np.ndarray], np.ndarray]) -> Comparison:
    """Replace the frames by `change` (8 bits, straight RGBA) of the true person (premultiplied, in [0, 1])."""
    side_px = _write_frames(comparison.truth, folder, change)
    camera = comparison.run.camera.scaled(side_px / comparison.run.camera.width)
    capture = replace(comparison.run.capture, folder=folder, width=side_px, height=side_px)
    return replace(comparison, run=replace(comparison.run, capture=capture, camera=camera))


def _write_frames(truth: SyntheticCapture, folder: Path, change: Callable[[np.ndarray], np.ndarray]) -> int:
    """Write straight colours, so that edge pixels do not contain the room; return the side in pixels."""
    for path in (image_path(folder, 0), mask_path(folder, 0)):
        path.parent.mkdir(parents=True)
    for frame in truth.motion.frame_index.tolist():
        person = change(truth.render_person(frame))
        write_rgb(image_path(folder, frame), np.ascontiguousarray(person[..., :3]))
        write_gray(mask_path(folder, frame), np.ascontiguousarray(person[..., 3]))
    return int(person.shape[0])


def _capture(folder: Path, motion: Motion, side_px: int, fps: float) -> Capture:
    count = len(motion.frame_index)
    return Capture(
        folder=folder,
        frame_index=motion.frame_index,
        time_s=motion.time_s,
        split=assign_splits(motion.frame_index),
        fps=fps,
        width=side_px,
        height=side_px,
        landmarks_px=np.zeros((count, 33, 2), dtype=np.float32),
        landmarks_visibility=np.zeros((count, 33), dtype=np.float32),
        landmarks_world_m=np.zeros((count, 33, 3), dtype=np.float32),
        camera=None,
        mask_source="supplied",
        n_video_frames=count,
        scale=1.0,
    )


def with_motion(comparison: Comparison, motion: Motion) -> Comparison:
    """Replace the estimated poses."""
    refined = canonical_to_world(comparison.run.body, motion)
    return replace(comparison, run=replace(comparison.run, motion=motion, refined_canonical_to_world=refined))


def with_scale(comparison: Comparison, factor: float) -> Comparison:
    """Scale the estimated person and its distance."""
    run = comparison.run
    body = replace(run.body, joints_m=run.body.joints_m * factor, vertices=run.body.vertices * factor)
    avatar = replace(run.avatar, vertices=run.avatar.vertices * factor)
    nearer = run.motion.with_pose(run.motion.rotations_wxyz, run.motion.root_translation_m * factor)
    return with_motion(replace(comparison, run=replace(run, body=body, avatar=avatar)), nearer)


def with_longer_focal(comparison: Comparison, factor: float) -> Comparison:
    """Scale the estimated focal length and the distance of the person."""
    camera, motion = comparison.run.camera, comparison.run.motion
    longer = replace(camera, fx=camera.fx * factor, fy=camera.fy * factor)
    turn, shift = camera.world_to_camera[:3, :3], camera.world_to_camera[:3, 3]
    roots = (motion.root_translation_m @ turn.T + shift) * np.array([1.0, 1.0, factor], np.float32)
    farther = motion.with_pose(motion.rotations_wxyz, (roots - shift) @ turn)
    return with_motion(replace(comparison, run=replace(comparison.run, camera=longer)), farther)


def with_raised_rest_arm(comparison: Comparison, angle_rad: float) -> Comparison:
    """Replace the estimated rig by one whose A-pose has the left arm raised by an angle."""
    body, avatar = comparison.run.body, comparison.run.avatar
    turn = torch.eye(3).repeat(1, len(body.joint_names), 1, 1)
    turn[0, body.joint("LeftArm")] = axis_angle_to_matrix(torch.tensor([0.0, 0.0, angle_rad]))
    joints_m = torch.from_numpy(body.joints_m)
    joint_to_world = forward_kinematics(turn, joints_m[:1], joints_m, body.parents)
    raised = avatar.pose_vertices(skinning_transforms(joint_to_world, joints_m)[0])
    rig = replace(body, joints_m=joint_to_world[0, :, :3, 3].numpy(), vertices=raised.numpy())
    return replace(comparison, run=replace(comparison.run, body=rig, avatar=replace(avatar, vertices=raised)))


def bent_arm(comparison: Comparison, frames: np.ndarray, angle_rad: float) -> Motion:
    """Return the motion with the left arm raised by an angle in some frames."""
    motion, joint = comparison.run.motion, comparison.run.body.joint("LeftArm")
    rotations = torch.from_numpy(motion.rotations_wxyz).clone()
    turn = axis_angle_to_quaternion(torch.tensor([0.0, 0.0, angle_rad]))
    rotations[frames, joint] = quaternion_multiply(rotations[frames, joint], turn.expand(len(frames), 4))
    return motion.with_pose(rotations.numpy(), motion.root_translation_m)
