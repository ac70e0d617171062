"""Any rigged, textured person in a .glb file as a `Subject`: Mixamo's joint names, T-pose lowered to the A-pose."""

from pathlib import Path

import cv2
import numpy as np
import torch
from jaxtyping import Float, Int

from data_tools.synthetic.rig.directions import shortest_arc
from data_tools.synthetic.rig.glb import Glb, Primitive
from data_tools.synthetic.rig.subject import Subject
from pipeline.body.body import Body
from pipeline.core.errors import UserError
from pipeline.geometry.skinning import forward_kinematics, linear_blend_skinning, skinning_transforms

_SIDE = ("Shoulder", "Arm", "ForeArm", "Hand", "UpLeg", "Leg", "Foot", "ToeBase")
_FINGERS = tuple(f"Hand{finger}{k}" for finger in ("Thumb", "Index", "Middle", "Ring", "Pinky") for k in (1, 2, 3))
JOINT_NAMES = frozenset(
    ("Hips", "Spine", "Spine1", "Spine2", "Neck", "Head", *(s + n for s in ("Left", "Right") for n in _SIDE + _FINGERS))
)
"""The 52 joints that are kept; the weights of all others go to their nearest kept ancestor."""

_NEEDED = frozenset(("Hips", "Spine", "Head", *(s + n for s in ("Left", "Right") for n in _SIDE if n != "Shoulder")))
_A_POSE_ARM = (0.66, -0.75, 0.0)


def read_rigged(path: Path) -> Subject:
    """Read a person; canonical frame (+Y up, facing +Z, metres, feet on y = 0, A-pose).

    The inverse bind matrices may carry scale and positions may be normalised integers: skinning is applied first.

    Raises:
        UserError: no skin, or a rig without the joints that a person needs.
    """
    glb = Glb(path)
    primitives = glb.skinned_primitives()
    keep, joint_nodes, parents = _kept_joints(glb, primitives[0].skin)
    joint_names = tuple(_name(glb, node) for node in joint_nodes)
    node_to_world = glb.node_to_world()
    vertices, weights = zip(*(_skinned(glb, p, node_to_world, keep, len(joint_names)) for p in primitives), strict=True)
    uv, texture = _atlas(glb, primitives)
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
    return Subject(_in_a_pose(body), uv, faces.copy(), texture)


def _kept_joints(glb: Glb, skin: int) -> tuple[Int[np.ndarray, "n"], list[int], Int[np.ndarray, "j"]]:
    """Kept joint of every node (its own, or its nearest ancestor's; -1 above the hips), node and parent of each joint.

    Joints are numbered from the hips outwards, so that parents come first.
    """
    nodes = glb.tree["nodes"]
    names = [_name(glb, node) for node in range(len(nodes))]
    missing = sorted(_NEEDED - {names[node] for node in glb.tree["skins"][skin]["joints"]})
    if missing:
        raise UserError(f"{glb.path} has no joint named {', '.join(missing[:3])}; rename its rig to Mixamo's names")
    keep = np.full(len(nodes), -1)
    joint_nodes: list[int] = []
    parents: list[int] = []
    pending = [(names.index("Hips"), -1)]
    while pending:
        node, ancestor = pending.pop()
        keep[node] = ancestor
        if names[node] in JOINT_NAMES and names[node] not in (names[joint] for joint in joint_nodes):
            keep[node] = len(joint_nodes)
            joint_nodes.append(node)
            parents.append(ancestor)
        pending += [(child, int(keep[node])) for child in reversed(nodes[node].get("children", ()))]
    return keep, joint_nodes, np.array(parents, dtype=np.int32)


def _name(glb: Glb, node: int) -> str:
    """A node's name without its namespace (`mixamorig:Hips` is `Hips`)."""
    return str(glb.tree["nodes"][node].get("name", "")).split(":")[-1]


def _skinned(
    glb: Glb, primitive: Primitive, node_to_world: np.ndarray, keep: np.ndarray, joint_count: int
) -> tuple[Float[np.ndarray, "v 3"], Float[np.ndarray, "v j"]]:
    """World positions of the rest pose, and weights on the kept joints."""
    skin = glb.tree["skins"][primitive.skin]
    nodes = np.array(skin["joints"])
    if "inverseBindMatrices" in skin:
        inverse_bind = glb.accessor(skin["inverseBindMatrices"]).reshape(-1, 4, 4).transpose(0, 2, 1)
    else:
        inverse_bind = np.tile(np.eye(4), (len(nodes), 1, 1))
    to_world = (node_to_world[nodes] @ inverse_bind)[primitive.joints]
    blended = (primitive.weights[:, :, None, None] * to_world).sum(axis=1)
    vertices = (blended[:, :3, :3] @ primitive.positions[:, :, None])[:, :, 0] + blended[:, :3, 3]
    weights = np.zeros((len(vertices), joint_count))
    targets = np.maximum(keep[nodes], 0)[primitive.joints]
    np.add.at(weights, (np.arange(len(vertices))[:, None], targets), primitive.weights)
    return vertices, weights


def _concatenated_faces(primitives: list[Primitive]) -> Int[np.ndarray, "f 3"]:
    starts = np.cumsum([0, *(len(p.positions) for p in primitives[:-1])])
    return np.concatenate([p.faces + start for p, start in zip(primitives, starts, strict=True)]).astype(np.int32)


def _atlas(glb: Glb, primitives: list[Primitive]) -> tuple[Float[np.ndarray, "v 2"], np.ndarray]:
    """One texture for all materials (side by side when there are several) and UVs in it, origin bottom-left."""
    materials = sorted({p.material for p in primitives})
    pictures = [glb.base_colour(material) for material in materials]
    height = max(len(picture) for picture in pictures)
    if len(pictures) > 1:
        pictures = [cv2.resize(p, (height, height), interpolation=cv2.INTER_CUBIC) for p in pictures]
    uv = []
    for primitive in primitives:
        across = (primitive.uv[:, 0] + materials.index(primitive.material)) / len(materials)
        uv.append(np.stack([across, 1.0 - primitive.uv[:, 1]], axis=1))
    return np.concatenate(uv).astype(np.float32), np.ascontiguousarray(np.concatenate(pictures, axis=1))


def _in_a_pose(body: Body) -> Body:
    """Lower both arms to the A-pose, stand on y = 0 over the origin, and make that the bind pose."""
    rotations = torch.eye(3).repeat(1, len(body.joint_names), 1, 1)
    for side, sign in (("Left", 1.0), ("Right", -1.0)):
        arm, forearm = body.joint(f"{side}Arm"), body.joint(f"{side}ForeArm")
        along = torch.from_numpy(body.joints_m[forearm] - body.joints_m[arm])
        rotations[0, arm] = shortest_arc(along, torch.tensor(_A_POSE_ARM) * torch.tensor([sign, 1.0, 1.0]))
    joints_m = torch.from_numpy(body.joints_m)
    joint_to_world = forward_kinematics(rotations, joints_m[:1], joints_m, body.parents)
    transforms = skinning_transforms(joint_to_world, joints_m)
    posed = linear_blend_skinning(torch.from_numpy(body.vertices), torch.from_numpy(body.skin_weights), transforms)
    vertices, joints = posed[0].numpy(), joint_to_world[0, :, :3, 3].numpy()
    origin = np.array([joints[0, 0], vertices[:, 1].min(), joints[0, 2]], dtype=np.float32)
    return Body(
        body.joint_names, body.parents, joints - origin, vertices - origin, body.faces, body.skin_weights, body.shape
    )
