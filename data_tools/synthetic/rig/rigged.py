"""Read a rigged, textured person from a .glb file as a `Subject`: Mixamo joint names, T-pose rebound in the A-pose."""

from pathlib import Path

import cv2
import numpy as np
import torch
from jaxtyping import Float, Int

from data_tools.synthetic.rig.labels import body_part_names, labels_from_names
from data_tools.synthetic.rig.subject import Subject
from pipeline.body.body import Body
from pipeline.core.errors import UserError
from pipeline.geometry.rotation import rotation_between
from pipeline.geometry.skinning import forward_kinematics, linear_blend_skinning, skinning_transforms
from pipeline.io.glb import GlbFile, Primitive

_SIDED_JOINTS = ("Shoulder", "Arm", "ForeArm", "Hand", "UpLeg", "Leg", "Foot", "ToeBase")
_FINGERS = tuple(f"Hand{finger}{k}" for finger in ("Thumb", "Index", "Middle", "Ring", "Pinky") for k in (1, 2, 3))
JOINT_NAMES = frozenset(
    (
        "Hips",
        "Spine",
        "Spine1",
        "Spine2",
        "Neck",
        "Head",
        *(s + n for s in ("Left", "Right") for n in _SIDED_JOINTS + _FINGERS),
    )
)
"""The 52 joints that are kept; the weights of other joints are added to their nearest kept ancestor."""

_REQUIRED_JOINTS = frozenset(
    ("Hips", "Spine", "Head", *(s + n for s in ("Left", "Right") for n in _SIDED_JOINTS if n != "Shoulder"))
)
_A_POSE_ARM_DIRECTION = (0.66, -0.75, 0.0)


def read_rigged_person(path: Path) -> Subject:
    """Read a person into the canonical frame: +Y up, facing +Z, metres, feet on y = 0, A-pose.

    Inverse bind matrices may contain a scale and positions may be normalised integers, so skinning is applied first.

    Raises:
        UserError: the file has no skin, or its rig lacks a required joint.
    """
    glb = GlbFile(path)
    with glb.checked():
        return _rigged_person(glb)


def _rigged_person(glb: GlbFile) -> Subject:
    primitives = glb.skinned_primitives()
    kept_joint_of_node, joint_nodes, parents = _select_joints(glb, primitives[0].skin)
    joint_names = tuple(_node_name(glb, node) for node in joint_nodes)
    node_to_world = glb.node_to_world()
    vertices, weights = zip(
        *(_apply_rest_skinning(glb, p, node_to_world, kept_joint_of_node, len(joint_names)) for p in primitives),
        strict=True,
    )
    uv, texture = _merge_textures(glb, primitives)
    faces = _concatenated_faces(primitives)
    body = Body(
        joint_names=joint_names,
        parents=parents,
        joints_m=node_to_world[joint_nodes, :3, 3].astype(np.float32),
        vertices=np.concatenate(vertices).astype(np.float32),
        faces=faces,
        skin_weights=np.concatenate(weights).astype(np.float32),
        shape={},
    )
    labels = labels_from_names(body_part_names(body))
    return Subject(_rebind_in_a_pose(body), uv, faces.copy(), texture, labels)


def _select_joints(glb: GlbFile, skin: int) -> tuple[Int[np.ndarray, "n"], list[int], Int[np.ndarray, "j"]]:
    """Return the kept joint of each node, and the node and parent of each joint.

    The kept joint of a node is its own or that of its nearest ancestor; -1 above the hips. Parents precede children.
    """
    nodes = glb.gltf["nodes"]
    names = [_node_name(glb, node) for node in range(len(nodes))]
    missing = sorted(_REQUIRED_JOINTS - {names[node] for node in glb.gltf["skins"][skin]["joints"]})
    if missing:
        raise UserError(
            f"{glb.path} has no joint named {', '.join(missing[:3])}; rename its joints to the Mixamo names"
        )
    kept_joint_of_node = np.full(len(nodes), -1)
    joint_nodes: list[int] = []
    parents: list[int] = []
    pending = [(names.index("Hips"), -1)]
    while pending:
        node, ancestor = pending.pop()
        kept_joint_of_node[node] = ancestor
        if names[node] in JOINT_NAMES and names[node] not in (names[joint] for joint in joint_nodes):
            kept_joint_of_node[node] = len(joint_nodes)
            joint_nodes.append(node)
            parents.append(ancestor)
        pending += [(child, int(kept_joint_of_node[node])) for child in reversed(nodes[node].get("children", ()))]
    return kept_joint_of_node, joint_nodes, np.array(parents, dtype=np.int32)


def _node_name(glb: GlbFile, node: int) -> str:
    """Return the name of a node without its namespace (`mixamorig:Hips` is `Hips`)."""
    return str(glb.gltf["nodes"][node].get("name", "")).split(":")[-1]


def _apply_rest_skinning(
    glb: GlbFile, primitive: Primitive, node_to_world: np.ndarray, kept_joint_of_node: np.ndarray, joint_count: int
) -> tuple[Float[np.ndarray, "v 3"], Float[np.ndarray, "v j"]]:
    """Return world positions of the rest pose, and skin weights on the kept joints."""
    skin = glb.gltf["skins"][primitive.skin]
    nodes = np.array(skin["joints"])
    if "inverseBindMatrices" in skin:
        inverse_bind = glb.accessor(skin["inverseBindMatrices"]).reshape(-1, 4, 4).transpose(0, 2, 1)
    else:
        inverse_bind = np.tile(np.eye(4), (len(nodes), 1, 1))
    to_world = (node_to_world[nodes] @ inverse_bind)[primitive.joints]
    blended = (primitive.weights[:, :, None, None] * to_world).sum(axis=1)
    vertices = (blended[:, :3, :3] @ primitive.positions[:, :, None])[:, :, 0] + blended[:, :3, 3]
    weights = np.zeros((len(vertices), joint_count))
    targets = np.maximum(kept_joint_of_node[nodes], 0)[primitive.joints]
    np.add.at(weights, (np.arange(len(vertices))[:, None], targets), primitive.weights)
    return vertices, weights


def _concatenated_faces(primitives: list[Primitive]) -> Int[np.ndarray, "f 3"]:
    starts = np.cumsum([0, *(len(p.positions) for p in primitives[:-1])])
    return np.concatenate([p.faces + start for p, start in zip(primitives, starts, strict=True)]).astype(np.int32)


def _merge_textures(glb: GlbFile, primitives: list[Primitive]) -> tuple[Float[np.ndarray, "v 2"], np.ndarray]:
    """Return UVs (origin bottom-left) and one texture for all materials, which are placed side by side."""
    materials = sorted({p.material for p in primitives})
    textures = [glb.base_colour(material) for material in materials]
    height = max(len(texture) for texture in textures)
    if len(textures) > 1:
        textures = [cv2.resize(texture, (height, height), interpolation=cv2.INTER_CUBIC) for texture in textures]
    uv = []
    for primitive in primitives:
        across = (primitive.uv[:, 0] + materials.index(primitive.material)) / len(materials)
        uv.append(np.stack([across, 1.0 - primitive.uv[:, 1]], axis=1))
    return np.concatenate(uv).astype(np.float32), np.ascontiguousarray(np.concatenate(textures, axis=1))


def _rebind_in_a_pose(body: Body) -> Body:
    """Lower both arms to the A-pose, place the feet on y = 0 below the hips at the origin, and bind in that pose."""
    rotations = torch.eye(3).repeat(1, len(body.joint_names), 1, 1)
    for side, sign in (("Left", 1.0), ("Right", -1.0)):
        arm, forearm = body.joint(f"{side}Arm"), body.joint(f"{side}ForeArm")
        along = torch.from_numpy(body.joints_m[forearm] - body.joints_m[arm])
        rotations[0, arm] = rotation_between(
            along, torch.tensor(_A_POSE_ARM_DIRECTION) * torch.tensor([sign, 1.0, 1.0])
        )
    joints_m = torch.from_numpy(body.joints_m)
    joint_to_world = forward_kinematics(rotations, joints_m[:1], joints_m, body.parents)
    transforms = skinning_transforms(joint_to_world, joints_m)
    posed = linear_blend_skinning(torch.from_numpy(body.vertices), torch.from_numpy(body.skin_weights), transforms)
    vertices, joints = posed[0].numpy(), joint_to_world[0, :, :3, 3].numpy()
    origin = np.array([joints[0, 0], vertices[:, 1].min(), joints[0, 2]], dtype=np.float32)
    return Body(
        body.joint_names, body.parents, joints - origin, vertices - origin, body.faces, body.skin_weights, body.shape
    )
