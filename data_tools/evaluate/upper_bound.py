"""The upper bound of the image scores: the true mesh and texture, posed and viewed as the run estimated.

The errors of these renders are caused by the estimated poses and camera alone.
"""

from collections.abc import Iterator
from dataclasses import replace

import numpy as np
import torch
from jaxtyping import Float, Int
from torch import Tensor

from data_tools.evaluate.comparison import Comparison
from data_tools.synthetic.scene.renderer import pose_vertices, render_subject
from pipeline.body.body import Body, canonical_to_world
from pipeline.capture.frame_selection import TRAIN
from pipeline.core.progress import track
from pipeline.geometry.camera import Camera, transform_world_to_camera
from pipeline.geometry.mesh import Mesh

DEPTH_WEIGHT = 0.05
"""Weight of errors along the optical axis, which an image hardly constrains; 1 across it."""
BACK_FACING_WEIGHT = 0.02
"""Weight of a frame in which a vertex faces away from the camera."""


def render_upper_bound(comparison: Comparison, positions: Int[np.ndarray, "k"]) -> Iterator[Float[np.ndarray, "h w 4"]]:
    """Render the true mesh with true texture and lighting in the refined poses by the estimated camera.

    Edges are sharp. Errors that another shape of the A-pose could compensate are removed: see `unpose_true_vertices`.

    Args:
        positions: of the frames, in the order of the run.

    Yields:
        Premultiplied RGBA in [0, 1].
    """
    run, subject = comparison.run, comparison.truth.subject
    unposed_subject = replace(subject, body=replace(subject.body, vertices=unpose_true_vertices(comparison)))
    joint = _fitted_joint_of(subject.body, run.body)
    camera = replace(run.camera, world_to_camera=comparison.truth.camera.world_to_camera)
    for position in track(positions.tolist(), "held-out frames"):
        posed = pose_vertices(unposed_subject, run.refined_canonical_to_world[position, joint])
        vertices = map_between_worlds(posed, run.camera, comparison.truth.camera)
        yield render_subject(unposed_subject, vertices, camera, comparison.truth.light, comparison.truth.samples)


def unpose_true_vertices(comparison: Comparison) -> Float[np.ndarray, "v 3"]:
    """Solve for the canonical vertices that best explain the true vertices under the refined poses.

    Per vertex v, minimise sum_t w_t |P (B_t v - y_t)|^2 over the training frames: B_t is the blended skinning matrix,
    y_t the true position, P weights the optical axis by `DEPTH_WEIGHT`, and w_t is the cosine between normal and
    viewing direction (0 if back-facing) plus `BACK_FACING_WEIGHT`.

    Returns:
        Positions in the canonical frame of the run, metres.
    """
    run, truth = comparison.run, comparison.truth
    body, positions = truth.subject.body, run.capture.positions(TRAIN)
    joint, weights = _fitted_joint_of(body, run.body), torch.from_numpy(body.skin_weights)
    motion = truth.motion.select(run.capture.frame_index[positions])
    scale = 1.0 / comparison.alignment.scale
    true_to_fitted = _true_to_fitted_world(torch.from_numpy(motion.root_translation_m), scale, truth.camera, run.camera)
    rotation_matrix = torch.from_numpy(run.camera.world_to_camera[:3, :3])
    view_weights = rotation_matrix.T @ torch.diag(torch.tensor([1.0, 1.0, DEPTH_WEIGHT])) @ rotation_matrix
    normal_matrix, normal_rhs = torch.zeros(len(body.vertices), 3, 3), torch.zeros(len(body.vertices), 3)
    for matrix, position, pose in zip(
        true_to_fitted, positions.tolist(), canonical_to_world(body, motion), strict=True
    ):
        true_vertices = pose_vertices(truth.subject, (matrix @ pose.double()).float())
        blended = torch.einsum("vj,jab->vab", weights, run.refined_canonical_to_world[position, joint])
        view_cosine = _view_cosine(true_vertices, body.faces, run.camera)[:, None, None]
        linear = view_cosine * (blended[:, :3, :3].mT @ view_weights)
        normal_matrix += linear @ blended[:, :3, :3]
        normal_rhs += (linear @ (true_vertices - blended[:, :3, 3])[..., None]).squeeze(-1)
    return torch.linalg.solve(normal_matrix, normal_rhs).numpy()


def _view_cosine(vertices: Float[Tensor, "v 3"], faces: np.ndarray, camera: Camera) -> Float[Tensor, "v"]:
    """Return the cosine between vertex normal and viewing direction, clamped at 0, plus `BACK_FACING_WEIGHT`."""
    normals = torch.from_numpy(Mesh(vertices.numpy(), faces).vertex_normals()).float()
    towards = torch.nn.functional.normalize(torch.from_numpy(camera.centre_m()) - vertices, dim=1)
    return (normals * towards).sum(1).clamp_min(0.0) + BACK_FACING_WEIGHT


def _fitted_joint_of(body: Body, fitted: Body) -> Int[np.ndarray, "j"]:
    """Return the index of the fitted joint for each joint of another rig: by name, or that of its parent."""
    joint = np.zeros(len(body.joint_names), dtype=np.int64)
    for number, (name, parent) in enumerate(zip(body.joint_names, body.parents, strict=True)):
        joint[number] = fitted.joint(name) if name in fitted.joint_names else joint[max(parent, 0)]
    return joint


def _true_to_fitted_world(
    roots_m: Float[Tensor, "n 3"], scale: float, camera: Camera, fitted: Camera
) -> Float[Tensor, "n 4 4"]:
    """Return the transforms from the true to the fitted world that preserve the image of the person.

    In the fitted world the person may be smaller and nearer: each transform scales the person about its root and moves
    the root to the depth at which the person has the same size in the image, on the ray of its pixel.
    """
    roots, ratio = transform_world_to_camera(roots_m.double(), camera), fitted.width / camera.width
    depth_m = scale * fitted.fx / (ratio * camera.fx) * roots[:, 2:]
    pixels_px = ratio * (roots[:, :2] / roots[:, 2:] * torch.tensor([camera.fx, camera.fy], dtype=torch.float64))
    pixels_px += torch.tensor([ratio * camera.cx - fitted.cx, ratio * camera.cy - fitted.cy], dtype=torch.float64)
    in_camera = torch.cat([pixels_px / torch.tensor([fitted.fx, fitted.fy]) * depth_m, depth_m], dim=1)
    moved = torch.linalg.inv(torch.from_numpy(fitted.world_to_camera).double())
    rotation_matrix = moved[:3, :3] @ torch.from_numpy(camera.world_to_camera).double()[:3, :3]
    targets = in_camera @ moved[:3, :3].T + moved[:3, 3]
    matrices = torch.eye(4, dtype=torch.float64).repeat(len(roots_m), 1, 1)
    matrices[:, :3, :3] = scale * rotation_matrix
    matrices[:, :3, 3] = targets - scale * roots_m.double() @ rotation_matrix.T
    return matrices


def map_between_worlds(vertices: Float[Tensor, "v 3"], camera: Camera, target: Camera) -> Float[Tensor, "v 3"]:
    """Transform points from the world of one camera to that of another, with equal camera coordinates."""
    matrix = torch.from_numpy(np.linalg.inv(target.world_to_camera) @ camera.world_to_camera).to(vertices)
    return vertices @ matrix[:3, :3].T + matrix[:3, 3]
