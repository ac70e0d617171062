"""Score the frames and body stages of a run against the ground truth of its synthetic capture."""

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np
import torch
from jaxtyping import Bool, Float

from data_tools.evaluate.truth import load_ground_truth, load_true_mask
from data_tools.synthetic.scene.capture import SyntheticCapture
from pipeline.body.body import Body, Motion, canonical_to_world
from pipeline.body.files import load_body, load_camera, load_motion
from pipeline.body.fit.vertical.gravity import camera_tilt_deg
from pipeline.core.errors import UserError
from pipeline.geometry.camera import Camera, project, transform_world_to_camera
from pipeline.geometry.mesh import Mesh
from pipeline.geometry.skinning import linear_blend_skinning
from pipeline.geometry.surface import closest_points_on_mesh
from pipeline.io.image import read_gray
from pipeline.io.npz import load_npz
from pipeline.metrics.images import foreground_mask, mask_iou
from pipeline.metrics.surfaces import mpjpe_m, sample_surface

CORRECTED_JOINTS = (
    *("Hips", "Spine", "Spine1", "Spine2", "Neck", "Head"),
    *(f"{side}{part}" for side in ("Left", "Right") for part in ("Arm", "ForeArm", "Hand", "UpLeg", "Leg", "Foot")),
)
TRUNK_JOINTS = ("LeftUpLeg", "RightUpLeg", "Neck")
SURFACE_FRAMES = 8


def compare_masks(out: Path, frames: Path) -> dict[str, float]:
    """Return median and minimum over frames of the IoU of the frames stage's masks and the true masks of their size."""
    scores = []
    for index in load_npz(frames / "frames.npz")["frame_index"].tolist():
        mask = read_gray(frames / "masks" / f"{index:06d}.png")
        height, width = mask.shape
        true_mask = load_true_mask(out, index, (width, height))
        scores.append(mask_iou(foreground_mask(mask), foreground_mask(true_mask)))
    return {"mask_iou_median": float(np.median(scores)), "mask_iou_worst": float(np.min(scores))}


def compare_body(out: Path, body_folder: Path) -> dict[str, float]:
    """Score the body stage; errors are means over frames and joints. Joints that the true rig lacks are left out.

    Joint errors are in camera axes, so that they do not contain errors of the vertical.

    Returns:
        joint_error_mm: MPJPE after aligning the hips.
        scaled_joint_error_mm: MPJPE after aligning the hips and scaling to the true distance of neck and hips.
        absolute_joint_error_mm: MPJPE without alignment.
        joint_error_px: reprojection error in pixels of the true camera.
        acceleration_error_ratio: mean acceleration error over mean true acceleration.
        jitter_ratio: mean acceleration over mean true acceleration.
        left_right_swapped_frames: number of frames, see `left_right_swapped_frames`.
        focal_ratio, scale_ratio: estimated over true focal length and body size.
        silhouette_iou: median over frames, as reported by the stage.
        lean_median_deg, lean_worst_deg: over frames, angle between the fitted and the true axis of the trunk in the
            world, see `trunk_axes`; absent if the true rig lacks hip joints or neck.
        camera_pitch_error_deg, camera_roll_error_deg: estimated minus true.

    Raises:
        UserError: a frame of the run is not in the ground truth.
    """
    truth = load_ground_truth(out)
    body, motion = load_body(body_folder / "body.npz"), load_motion(body_folder / "motion.npz")
    camera = load_camera(body_folder / "camera.npz")
    if motion.frame_index.max() >= len(truth.motion.frame_index):
        raise UserError(
            f"{body_folder} contains frame {motion.frame_index.max()}, but {out} has fewer frames; "
            "name the capture that this run was made from"
        )
    names = [name for name in CORRECTED_JOINTS if name in truth.subject.body.joint_names and name in body.joint_names]
    true_body, true_motion = truth.subject.body, truth.motion.select(motion.frame_index)
    fitted, true = (
        transform_world_to_camera(torch.from_numpy(joint_positions(rig, poses, names)), viewing_camera).numpy()
        for rig, poses, viewing_camera in ((body, motion, camera), (true_body, true_motion, truth.camera))
    )
    root_relative_m, true_root_relative_m = fitted - fitted[:, :1], true - true[:, :1]
    neck = names.index("Neck") if "Neck" in names else names.index("Head")
    scale = (
        np.linalg.norm(true_root_relative_m[:, neck], axis=1).mean()
        / np.linalg.norm(root_relative_m[:, neck], axis=1).mean()
    )
    fitted_px, true_px = (
        project(torch.from_numpy(positions).float(), replace(viewing_camera, world_to_camera=np.eye(4)))[0].numpy()
        for positions, viewing_camera in ((fitted, camera), (true, truth.camera))
    )
    size_ratio = camera.width / truth.camera.width
    fitted_acceleration, true_acceleration = (
        joint_accelerations(positions, motion.time_s) for positions in (fitted, true)
    )
    mean_true_acceleration = np.linalg.norm(true_acceleration, axis=2).mean()
    return {
        "joint_error_mm": 1000.0 * mpjpe_m(root_relative_m, true_root_relative_m),
        "scaled_joint_error_mm": 1000.0 * mpjpe_m(scale * root_relative_m, true_root_relative_m),
        "absolute_joint_error_mm": 1000.0 * mpjpe_m(fitted, true),
        "joint_error_px": float(np.linalg.norm(fitted_px / size_ratio - true_px, axis=2).mean()),
        "acceleration_error_ratio": float(
            np.linalg.norm(fitted_acceleration - true_acceleration, axis=2).mean() / mean_true_acceleration
        ),
        "jitter_ratio": float(np.linalg.norm(fitted_acceleration, axis=2).mean() / mean_true_acceleration),
        "left_right_swapped_frames": float(
            left_right_swapped_frames(names, root_relative_m, true_root_relative_m).sum()
        ),
        "focal_ratio": camera.fx / size_ratio / truth.camera.fx,
        "scale_ratio": float(1.0 / scale),
        "silhouette_iou": float(np.nanmedian(load_npz(body_folder / "scores.npz")["silhouette_iou"])),
        **_vertical_errors(body, motion, camera, truth),
    }


def _vertical_errors(body: Body, motion: Motion, camera: Camera, truth: SyntheticCapture) -> dict[str, float]:
    """Return the errors of the lean of the trunk and of pitch and roll of the camera; see `compare_body`."""
    pitch_deg, roll_deg = (
        fitted - true for fitted, true in zip(camera_tilt_deg(camera), camera_tilt_deg(truth.camera), strict=True)
    )
    errors = {"camera_pitch_error_deg": pitch_deg, "camera_roll_error_deg": roll_deg}
    if not set(TRUNK_JOINTS) <= set(truth.subject.body.joint_names):
        return errors
    fitted_axis = trunk_axes(body, motion, truth.subject.body)
    true_axis = trunk_axes(truth.subject.body, truth.motion.select(motion.frame_index), truth.subject.body)
    lean_deg = np.degrees(np.arccos(np.clip((fitted_axis * true_axis).sum(1), -1.0, 1.0)))
    return {"lean_median_deg": float(np.median(lean_deg)), "lean_worst_deg": float(lean_deg.max()), **errors}


def trunk_axes(body: Body, motion: Motion, reference: Body) -> Float[np.ndarray, "n 3"]:
    """Return unit vectors from the middle of the hip joints to the base of the neck, in the world.

    Rigs place these joints differently inside the body: the difference of the slopes of body and `reference` in the
    rest pose, about the axis through the hip joints, is removed.
    """
    left, right, neck = np.moveaxis(joint_positions(body, motion, TRUNK_JOINTS), 1, 0)
    axis, across = neck - 0.5 * (left + right), left - right
    forward = np.cross(across, axis)
    forward *= np.linalg.norm(axis, axis=1, keepdims=True) / np.linalg.norm(forward, axis=1, keepdims=True)
    angle_rad = rest_slope_rad(reference) - rest_slope_rad(body)
    turned = np.cos(angle_rad) * axis + np.sin(angle_rad) * forward
    return turned / np.linalg.norm(turned, axis=1, keepdims=True)


def rest_slope_rad(body: Body) -> float:
    """Return the angle by which the axis of the trunk leans forward in the rest pose."""
    left, right, neck = body.joints_m[[body.joint(name) for name in TRUNK_JOINTS]].astype(np.float64)
    axis = neck - 0.5 * (left + right)
    return float(np.arctan2(axis[2], axis[1]))


def joint_accelerations(
    positions_m: Float[np.ndarray, "n k 3"], time_s: Float[np.ndarray, "n"]
) -> Float[np.ndarray, "t k 3"]:
    """Return accelerations (m/s²) at the inner frames by second differences over non-uniform times."""
    interval = np.diff(time_s)[:, None, None]
    velocity = np.diff(positions_m, axis=0) / interval
    return np.diff(velocity, axis=0) / (0.5 * (interval[1:] + interval[:-1]))


def left_right_swapped_frames(
    names: Sequence[str], fitted_m: Float[np.ndarray, "n k 3"], true_m: Float[np.ndarray, "n k 3"]
) -> Bool[np.ndarray, "n"]:
    """Return frames in which a pair of joints (hips, knees, ...) has a smaller error with left and right swapped."""
    swapped = np.zeros(len(fitted_m), dtype=bool)
    for left, name in enumerate(names):
        if name.startswith("Left") and name.replace("Left", "Right") in names:
            left_right_joints = [left, names.index(name.replace("Left", "Right"))]
            unswapped_error_m, swapped_error_m = (
                np.linalg.norm(fitted_m[:, left_right_joints] - true_m[:, order], axis=2).sum(1)
                for order in (left_right_joints, left_right_joints[::-1])
            )
            swapped |= unswapped_error_m > swapped_error_m
    return swapped


def compare_surface(out: Path, body_folder: Path, count: int = 2000) -> dict[str, float]:
    """Return the median distance of the posed fitted body to the true body surface, over points and 8 frames.

    The true surface is the body without clothes if known, else the clothed person. The centroids are aligned in each
    frame. Hands and head are left out, because the models of fingers and hair differ.

    Args:
        count: surface points per frame.
    """
    truth = load_ground_truth(out)
    bare = out / "truth" / "bare.npz"
    true_body = load_body(bare) if bare.is_file() else truth.subject.body
    body, motion = load_body(body_folder / "body.npz"), load_motion(body_folder / "motion.npz")
    rows = np.linspace(0, len(motion.frame_index) - 1, SURFACE_FRAMES).astype(np.int64)
    fitted = posed_surfaces(body, motion.select(rows))
    true = posed_surfaces(true_body, truth.motion.select(motion.frame_index[rows]))
    trunk = ~np.isin(np.array(body.joint_names)[body.skin_weights.argmax(1)], [*_extremities(body.joint_names)])
    distances = []
    for mesh, target in zip(fitted, true, strict=True):
        points, faces = sample_surface(mesh, count)
        offset_m = sample_surface(target, count)[0].mean(0) - points.mean(0)
        points = points[trunk[mesh.faces[faces]].all(1)] + offset_m
        distances.append(closest_points_on_mesh(points, target)[0])
    return {"surface_median_mm": 1000.0 * float(np.median(np.concatenate(distances)))}


def posed_surfaces(body: Body, motion: Motion) -> list[Mesh]:
    """Return the surface of the body in the world in all frames."""
    vertices, weights = torch.from_numpy(body.vertices), torch.from_numpy(body.skin_weights)
    posed = linear_blend_skinning(vertices, weights, canonical_to_world(body, motion)).numpy()
    return [Mesh(frame, body.faces) for frame in posed]


def _extremities(names: Sequence[str]) -> list[str]:
    return [name for name in names if "Hand" in name or name == "Head"]


def joint_positions(body: Body, motion: Motion, names: Sequence[str]) -> Float[np.ndarray, "n k 3"]:
    """Return the world positions of the named joints in all frames, metres."""
    joints = [body.joint(name) for name in names]
    transforms = canonical_to_world(body, motion)[:, joints].double()
    positions = torch.from_numpy(body.joints_m[joints]).double()
    return ((transforms[..., :3, :3] @ positions[:, :, None]).squeeze(-1) + transforms[..., :3, 3]).numpy()
