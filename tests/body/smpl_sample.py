"""A sample model in SMPL's format, derived from the built-in body: T-pose, ten smooth shape directions, a regressor."""

from functools import lru_cache

import cv2
import fast_simplification
import numpy as np
import torch
from scipy.spatial import cKDTree

from pipeline.body.body import AnnyBody, load_anny
from pipeline.body.smpl import JOINT_NAMES, SmplArrays, SmplBody
from pipeline.geometry.rotation import axis_angle_to_matrix, matrix_to_quaternion, quaternion_to_axis_angle
from pipeline.geometry.skinning import forward_kinematics, linear_blend_skinning, skinning_transforms

CHANGES = (
    ("scale", 0.04),
    ("weight", 0.08),
    ("gender", -0.1),
    ("muscle", 0.1),
    ("upperleg-length", 0.15),
    ("waist-girth", 0.2),
    ("shoulder-width", 0.2),
    ("hips-girth", 0.2),
    ("upperarm-length", 0.15),
    ("nape-to-waist", 0.15),
)
"""Change of the built-in body's shape parameters by one unit of each beta."""

COARSE_FACES = 5000


@lru_cache(maxsize=2)
def sample_arrays(joint_count: int) -> SmplArrays:
    """Return a small model with 24, 52 or 55 joints."""
    anny = load_anny()
    names = JOINT_NAMES[joint_count]
    base_vertices, base_joints = _t_pose(anny, anny.shape_defaults)
    faces, kept = _coarse(base_vertices, anny.faces)
    parents = np.array([_parent(anny, names, name) for name in names], dtype=np.int32)
    joints = np.stack([base_joints[_stand_in(anny, name)] for name in names])
    template = base_vertices[kept]
    directions = []
    for name, step in CHANGES:
        shape = anny.shape_defaults.clone()
        shape[anny.shape_names.index(name)] += step
        directions.append(_t_pose(anny, shape)[0][kept] - template)
    return SmplArrays(
        template_m=template,
        shape_directions_m=np.stack(directions, axis=-1),
        joint_regressor=_regressor(template, joints),
        parents=parents,
        skin_weights=_merged_weights(anny, names)[kept],
        faces=faces,
    )


def _t_pose(anny: AnnyBody, shape: torch.Tensor) -> tuple[np.ndarray, np.ndarray]:
    """Return the built-in body with horizontal arms."""
    vertices, joints = anny.rest_pose(shape)
    rotations = torch.eye(3).repeat(1, len(joints), 1, 1)
    for side, sign in (("Left", 1.0), ("Right", -1.0)):
        above = torch.eye(3)
        for name, child in (("Arm", "ForeArm"), ("ForeArm", "Hand")):
            joint, end = anny.joint_names.index(side + name), anny.joint_names.index(side + child)
            bone = torch.nn.functional.normalize(above @ (joints[end] - joints[joint]), dim=0)
            axis = torch.linalg.cross(bone, torch.tensor([sign, 0.0, 0.0]))
            angle = torch.acos(bone[0] * sign)
            turned = axis_angle_to_matrix(axis / axis.norm() * angle) @ above
            rotations[0, joint] = above.T @ turned
            above = turned
    joint_to_world = forward_kinematics(rotations, joints[None, 0], joints, anny.parents)
    weights = torch.from_numpy(anny.skin_weights)
    posed = linear_blend_skinning(vertices, weights, skinning_transforms(joint_to_world, joints))
    return posed[0].double().numpy(), joint_to_world[0, :, :3, 3].double().numpy()


def _coarse(vertices: np.ndarray, faces: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return the faces of a coarser surface, and the indices of its vertices in the fine one."""
    points, corners = fast_simplification.simplify(vertices.astype(np.float32), faces, target_count=COARSE_FACES)
    kept, snapped = np.unique(cKDTree(vertices).query(points)[1], return_inverse=True)
    triangles = snapped[corners]
    whole = np.array([len(set(triangle)) == 3 for triangle in triangles.tolist()])
    return triangles[whole].astype(np.int32), kept


def _stand_in(anny: AnnyBody, name: str) -> int:
    """Return the joint of the built-in body at the position of a joint of the model; jaw and eyes: the head."""
    return anny.joint_names.index(name if name in anny.joint_names else "Head")


def _parent(anny: AnnyBody, names: tuple[str, ...], name: str) -> int:
    if name == "Hips":
        return -1
    joint = anny.joint_names.index("Head") if name not in anny.joint_names else int(anny.parents[_stand_in(anny, name)])
    return names.index(anny.joint_names[joint])


def _merged_weights(anny: AnnyBody, names: tuple[str, ...]) -> np.ndarray:
    """Return skin weights; those of fingers that the model lacks go to the hand."""
    merged = np.zeros((len(anny.skin_weights), len(names)))
    for joint, name in enumerate(anny.joint_names):
        owner = name if name in names else name[: name.index("Hand") + len("Hand")]
        merged[:, names.index(owner)] += anny.skin_weights[:, joint]
    return merged


def _regressor(template: np.ndarray, joints: np.ndarray) -> np.ndarray:
    """Return least-norm weights of the 40 nearest vertices of each joint; rows sum to 1."""
    regressor = np.zeros((len(joints), len(template)))
    for row, joint in enumerate(joints):
        near = np.argsort(np.linalg.norm(template - joint, axis=1))[:40]
        matrix = np.vstack([template[near].T, np.ones(len(near))])
        regressor[row, near] = np.linalg.lstsq(matrix, np.append(joint, 1.0), rcond=None)[0]
    return regressor


def smpl_vertices(
    arrays: SmplArrays, betas: np.ndarray, axis_angle: np.ndarray, transl_m: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Return vertices (v, 3) and joints (j, 3) of one frame by SMPL's formula without pose blend shapes, m."""
    template = arrays.template_m + arrays.shape_directions_m @ betas
    joints = arrays.joint_regressor @ template
    world = np.zeros((len(joints), 4, 4))
    for joint, parent in enumerate(arrays.parents):
        local = np.eye(4)
        local[:3, :3] = cv2.Rodrigues(axis_angle[joint].astype(np.float64))[0]
        local[:3, 3] = joints[joint] - (joints[parent] if parent >= 0 else 0.0)
        world[joint] = world[parent] @ local if parent >= 0 else local
    posed = world[:, :3, 3] + transl_m
    moved = np.einsum("jab,vjb->vja", world[:, :3, :3], template[:, None] - joints) + posed
    weights = arrays.skin_weights / arrays.skin_weights.sum(axis=1, keepdims=True)
    return np.einsum("vj,vja->va", weights, moved), posed


def smpl_pose_of(body: SmplBody, rotations: torch.Tensor) -> np.ndarray:
    """Return SMPL's axis-angles (n, 24, 3) of local rotations (n, j, 3, 3): theta_j = Q_parent^T R_j Q_j.

    The world rotations Q of the A-pose are the inverse of those of SMPL's T-pose in this project.
    """
    still = body.from_smpl_rotations(torch.eye(3).repeat(1, len(body.parents), 1, 1))
    t_pose = forward_kinematics(still, torch.zeros(1, 3), torch.zeros(len(body.parents), 3), body.parents)
    bind = t_pose[0, :, :3, :3].transpose(-1, -2)
    above = torch.cat([torch.eye(3)[None], bind[body.parents[1:].tolist()]])
    theta = above.transpose(-1, -2) @ rotations.float() @ bind
    return quaternion_to_axis_angle(matrix_to_quaternion(theta)).numpy()


def file_contents(arrays: SmplArrays) -> dict[str, np.ndarray]:
    """Return the arrays with the names and data types of a released model."""
    children = np.arange(len(arrays.parents))
    return {
        "v_template": arrays.template_m,
        "shapedirs": arrays.shape_directions_m,
        "J_regressor": arrays.joint_regressor,
        "kintree_table": np.stack([arrays.parents, children]).astype(np.uint32),
        "weights": arrays.skin_weights,
        "f": arrays.faces.astype(np.uint32),
    }
