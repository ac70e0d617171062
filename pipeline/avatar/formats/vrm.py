"""Convert the avatar's .glb to VRM 1.0 or VRM 0.x, the formats of humanoid avatars in VR and streaming programs.

A VRM is a .glb with an extension that names the bones and the licence; its rest pose is a T-pose without animations
and cameras. VRM 1.0 keeps the mesh in the A-pose and moves only the joints, so that A-poses deform as in the .glb;
VRM 0.x wants the mesh itself in the T-pose, facing -Z.

Expressions and look-at use the avatar's morph targets; without them the files have no expressions, and look-at has only
its origin. A skirt or long hair gets chains of joints that swing (`vrm_springs`).

References: https://github.com/vrm-c/vrm-specification, VRMC_vrm-1.0 and 0.0.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from jaxtyping import Float, Int

from pipeline.avatar.formats.vrm_expressions import (
    GAZE_FULL_DEG,
    expressions_vrm1,
    gaze_range_vrm1,
    groups_vrm0,
    morph_names,
)
from pipeline.avatar.formats.vrm_springs import (
    LooseParts,
    RestColliders,
    SpringJoints,
    add_spring_joints,
    place_colliders,
    remove_cameras,
    springs_vrm0,
    springs_vrm1,
)
from pipeline.avatar.t_pose import t_pose_transforms
from pipeline.avatar.vrm_bones import human_bones
from pipeline.geometry.skinning import inverse_skinning_matrices
from pipeline.io.glb import GlbFile
from pipeline.io.glb_writer import GlbWriter

VRM_1_LICENCE_URL = "https://vrm.dev/licenses/1.0/"
GAZE_INPUT_DEG, GAZE_OUTPUT_DEG = 90.0, 10.0
EYE_IN_HEAD_BOX = (0.61, 0.81)
"""The eyes in the bounding box of the head: fraction of its height from below, of its depth from behind."""

_FACE_BACKWARDS = np.diag([-1.0, 1.0, -1.0, 1.0])
_GAZE_RANGES = ("HorizontalInner", "HorizontalOuter", "VerticalDown", "VerticalUp")
NOTHING_LOOSE = LooseParts()
_LINEAR_CURVE = [0.0, 0.0, 0.0, 1.0, 1.0, 1.0, 1.0, 0.0]


@dataclass(frozen=True)
class VrmMeta:
    """Name, authors and licence of a VRM. What is not stated here is not permitted (the defaults of VRM).

    name: of the avatar. author: who holds the rights, not empty. licence_url: a licence that grants more; may be empty.
    """

    name: str
    author: str
    licence_url: str


@dataclass(frozen=True)
class _RestPose:
    """Skin joints: nodes, names, parents (-1: root), bind positions, transforms of their rigid parts to the T-pose."""

    nodes: list[int]
    joint_names: tuple[str, ...]
    parents: Int[np.ndarray, "j"]
    joints_m: Float[np.ndarray, "j 3"]
    bind_to_rest: Float[np.ndarray, "j 4 4"]


def encode_vrm1(file: GlbFile, joint_names: Sequence[str], meta: VrmMeta, loose: LooseParts = NOTHING_LOOSE) -> bytes:
    """Return the avatar as VRM 1.0.

    Args:
        file: one skinned mesh, facing +Z, +Y up.
        joint_names: Mixamo's names of the skin's joints, in its order; the nodes may have others. A joint that follows
            them in the skin, a root above the hips, stays at the origin.
        meta: name and licence.
        loose: skirts and hair, which get spring bones; the file has none without them.

    Raises:
        UserError: the file's arrays cannot be read.
        ValueError: a bone that VRM requires is missing.
    """
    springs = add_spring_joints(file, joint_names, loose)
    file = springs.file
    document, rest = GlbWriter.from_file(file), _rest_pose(file, joint_names)
    inverse_bind = _translations(-_rest_joints_m(rest)) @ rest.bind_to_rest
    _write_rest_pose(file, document, rest, inverse_bind)
    bones = {bone: {"node": rest.nodes[joint]} for bone, joint in human_bones(joint_names, "1.0").items()}
    names, mesh_nodes = morph_names(file), _mesh_nodes(document)
    gaze = gaze_range_vrm1() if names else {"inputMaxValue": GAZE_INPUT_DEG, "outputScale": GAZE_OUTPUT_DEG}
    extension = {
        "specVersion": "1.0",
        "meta": {
            "name": meta.name,
            "authors": [meta.author],
            "licenseUrl": VRM_1_LICENCE_URL,
            **({"otherLicenseUrl": meta.licence_url} if meta.licence_url else {}),
        },
        "humanoid": {"humanBones": bones},
        # three-vrm ignores look-at without this key, which may be empty
        "expressions": {"preset": expressions_vrm1(names, mesh_nodes[0])},
        "firstPerson": {"meshAnnotations": [{"node": node, "type": "auto"} for node in mesh_nodes]},
        "lookAt": {"type": "expression" if names else "bone", "offsetFromHeadBone": _eye_offset_m(file, rest).tolist()}
        | {f"rangeMap{name}": gaze for name in _GAZE_RANGES},
    }
    extensions = {"VRMC_vrm": extension}
    if springs.nodes:
        extensions["VRMC_springBone"] = springs_vrm1(springs, _colliders(springs, rest), _nodes_m(rest))
    return _encode(document, extensions)


def encode_vrm0(file: GlbFile, joint_names: Sequence[str], meta: VrmMeta, loose: LooseParts = NOTHING_LOOSE) -> bytes:
    """Return the avatar as VRM 0.x: mesh and joints are in the T-pose and turned by 180 degrees about y.

    Arguments and errors as of `encode_vrm1`.
    """
    springs = add_spring_joints(file, joint_names, loose)
    file = springs.file
    document, rest = GlbWriter.from_file(file), _rest_pose(file, joint_names)
    turned = _FACE_BACKWARDS @ rest.bind_to_rest
    rest = replace(rest, bind_to_rest=turned)
    _bake_mesh(file, document, turned)
    _write_rest_pose(file, document, rest, _translations(-_rest_joints_m(rest)))
    bones = [
        {"bone": bone, "node": rest.nodes[joint], "useDefaultValues": True}
        for bone, joint in human_bones(joint_names, "0.x").items()
    ]
    names = morph_names(file)
    input_deg, output = (GAZE_FULL_DEG, 1.0) if names else (GAZE_INPUT_DEG, GAZE_OUTPUT_DEG)
    gaze = {"curve": _LINEAR_CURVE, "xRange": input_deg, "yRange": output}
    x, y, z = _eye_offset_m(file, rest).tolist()
    annotations = [{"mesh": mesh, "firstPersonFlag": "Auto"} for mesh in range(len(document.json["meshes"]))]
    first_person = {
        "firstPersonBone": rest.nodes[rest.joint_names.index("Head")],
        "firstPersonBoneOffset": {"x": x, "y": y, "z": -z},  # in Unity's axes, whose z is that of glTF negated
        "meshAnnotations": annotations,
        "lookAtTypeName": "BlendShape" if names else "Bone",
    }
    licence = {"licenseName": "Other", "otherLicenseUrl": meta.licence_url}
    extension = {
        "exporterVersion": document.json["asset"].get("generator", ""),
        "specVersion": "0.0",
        "meta": {
            "title": meta.name,
            "author": meta.author,
            "allowedUserName": "OnlyAuthor",
            "violentUssageName": "Disallow",
            "sexualUssageName": "Disallow",
            "commercialUssageName": "Disallow",
            **(licence if meta.licence_url else {"licenseName": "Redistribution_Prohibited"}),
        },
        "humanoid": {"humanBones": bones},
        "firstPerson": first_person | {f"lookAt{name}": gaze for name in _GAZE_RANGES},
        "blendShapeMaster": {"blendShapeGroups": groups_vrm0(names, 0)},
        "secondaryAnimation": springs_vrm0(springs, _colliders(springs, rest), _nodes_m(rest)),
        "materialProperties": [_gltf_material(material["name"]) for material in document.json["materials"]],
    }
    return _encode(document, {"VRM": extension})


def _encode(document: GlbWriter, extensions: dict[str, dict[str, Any]]) -> bytes:
    document.json["extensionsUsed"] = [*document.json.get("extensionsUsed", ()), *extensions]
    document.json["extensions"] = document.json.get("extensions", {}) | extensions
    document.json.pop("animations", None)
    remove_cameras(document)
    document.remove_unused()
    return document.to_bytes()


def _rest_pose(file: GlbFile, joint_names: Sequence[str]) -> _RestPose:
    """Compute the T-pose from the bind pose of the file's skin; the lowest vertex then is at y = 0."""
    skin, nodes = file.gltf["skins"][0], file.gltf["nodes"]
    inverse_bind = file.accessor(skin["inverseBindMatrices"]).reshape(-1, 4, 4).transpose(0, 2, 1)
    joints_m = np.linalg.inv(inverse_bind.astype(np.float64))[:, :3, 3]
    joint_of_node = {node: joint for joint, node in enumerate(skin["joints"])}
    parents = np.full(len(joints_m), -1)
    for node, joint in joint_of_node.items():
        parents[[joint_of_node[child] for child in nodes[node].get("children", ()) if child in joint_of_node]] = joint
    names = (*joint_names, *(nodes[node]["name"] for node in skin["joints"][len(joint_names) :]))
    transforms = t_pose_transforms(names, parents, joints_m)
    lowest_m = min(_posed(file, primitive, transforms)[:, 1].min() for primitive in _primitives(file))
    is_added_root = (parents < 0) & (np.arange(len(names)) >= len(joint_names))
    transforms[~is_added_root, 1, 3] -= lowest_m
    return _RestPose(skin["joints"], names, parents, joints_m, transforms)


def _rest_joints_m(rest: _RestPose) -> Float[np.ndarray, "j 3"]:
    return np.einsum("jab,jb->ja", rest.bind_to_rest[:, :3, :3], rest.joints_m) + rest.bind_to_rest[:, :3, 3]


def _nodes_m(rest: _RestPose) -> dict[int, np.ndarray]:
    return dict(zip(rest.nodes, _rest_joints_m(rest), strict=True))


def _colliders(springs: SpringJoints, rest: _RestPose) -> RestColliders:
    nodes_m = _nodes_m(rest)
    place = {name: (node, nodes_m[node]) for name, node in zip(rest.joint_names, rest.nodes, strict=True)}
    return place_colliders(springs, place, nodes_m)


def _write_rest_pose(
    file: GlbFile, document: GlbWriter, rest: _RestPose, inverse_bind: Float[np.ndarray, "j 4 4"]
) -> None:
    """Give the joints' nodes, and those of the eyes, a translation only, and the skin its inverse bind matrices."""
    joints_m, node_to_world, nodes = _rest_joints_m(rest), file.node_to_world(), document.json["nodes"]

    def place(node: int, position_m: np.ndarray, origin_m: np.ndarray) -> None:
        for key in ("rotation", "scale", "matrix"):
            nodes[node].pop(key, None)
        nodes[node]["translation"] = (position_m - origin_m).astype(np.float32).tolist()

    for joint, (node, parent) in enumerate(zip(rest.nodes, rest.parents, strict=True)):
        place(node, joints_m[joint], joints_m[parent] if parent >= 0 else np.zeros(3))
        for child in set(nodes[node].get("children", ())) - set(rest.nodes):
            place(child, (rest.bind_to_rest[joint] @ node_to_world[child])[:3, 3], joints_m[joint])
    columns = inverse_bind.transpose(0, 2, 1).reshape(-1, 16).astype(np.float32)
    document.replace_array(document.json["skins"][0]["inverseBindMatrices"], columns)


def _bake_mesh(file: GlbFile, document: GlbWriter, transforms: Float[np.ndarray, "j 4 4"]) -> None:
    """Write the vertices from which the joints' return to the bind pose makes the stored vertices again."""
    for primitive in _primitives(file):
        attributes = primitive["attributes"]
        joints, weights = _array(file, primitive, "JOINTS_0"), _array(file, primitive, "WEIGHTS_0")
        bind_to_rest = inverse_skinning_matrices(joints, weights, transforms)
        positions_m, normals = (_array(file, primitive, name) for name in ("POSITION", "NORMAL"))
        positions_m = np.einsum("vab,vb->va", bind_to_rest[:, :3, :3], positions_m) + bind_to_rest[:, :3, 3]
        normals = np.einsum("vab,vb->va", bind_to_rest[:, :3, :3], normals)
        normals /= np.linalg.norm(normals, axis=1, keepdims=True)
        document.replace_array(attributes["POSITION"], positions_m.astype(np.float32))
        document.replace_array(attributes["NORMAL"], normals.astype(np.float32))
        if "TANGENT" in attributes:
            tangents = _array(file, primitive, "TANGENT")
            turned = np.einsum("vab,vb->va", bind_to_rest[:, :3, :3], tangents[:, :3])
            turned /= np.linalg.norm(turned, axis=1, keepdims=True)
            document.replace_array(attributes["TANGENT"], np.column_stack([turned, tangents[:, 3]]).astype(np.float32))
        for index in (index for target in primitive.get("targets", ()) for index in target.values()):
            moved = np.einsum("vab,vb->va", bind_to_rest[:, :3, :3], file.accessor(index))
            document.replace_array(index, moved.astype(np.float32))


def _posed(file: GlbFile, primitive: dict[str, Any], transforms: Float[np.ndarray, "j 4 4"]) -> np.ndarray:
    """Return the vertices by linear blend skinning, m."""
    joints, weights = _array(file, primitive, "JOINTS_0"), _array(file, primitive, "WEIGHTS_0")
    blended = np.einsum("vk,vkab->vab", weights, transforms[joints])
    return np.einsum("vab,vb->va", blended[:, :3, :3], _array(file, primitive, "POSITION")) + blended[:, :3, 3]


def _array(file: GlbFile, primitive: dict[str, Any], name: str) -> np.ndarray:
    return file.accessor(primitive["attributes"][name])


def _primitives(file: GlbFile) -> list[dict[str, Any]]:
    return [primitive for mesh in file.gltf["meshes"] for primitive in mesh["primitives"]]


def _eye_offset_m(file: GlbFile, rest: _RestPose) -> Float[np.ndarray, "3"]:
    """Return the position between the eyes relative to the head joint, in the T-pose."""
    head = rest.joint_names.index("Head")
    rows = []
    for primitive in _primitives(file):
        joints, weights = _array(file, primitive, "JOINTS_0"), _array(file, primitive, "WEIGHTS_0")
        on_head = (weights * (joints == head)).sum(axis=1) > 0.5
        rows.append(_array(file, primitive, "POSITION")[on_head])
    low_m, high_m = np.min(np.concatenate(rows), axis=0), np.max(np.concatenate(rows), axis=0)
    up, forward = EYE_IN_HEAD_BOX
    eye_m = np.array([rest.joints_m[head, 0], *(low_m + [0.0, up, forward] * (high_m - low_m))[1:]])
    return rest.bind_to_rest[head, :3, :3] @ (eye_m - rest.joints_m[head])


def _mesh_nodes(document: GlbWriter) -> list[int]:
    return [index for index, node in enumerate(document.json["nodes"]) if "mesh" in node]


def _gltf_material(name: str) -> dict[str, Any]:
    """Return the entry of VRM 0.x that tells an importer to use the glTF material."""
    maps: dict[str, Any] = {
        key: {} for key in ("floatProperties", "vectorProperties", "textureProperties", "keywordMap", "tagMap")
    }
    return {"name": name, "shader": "VRM_USE_GLTFSHADER", "renderQueue": 2000} | maps


def _translations(offsets_m: Float[np.ndarray, "j 3"]) -> Float[np.ndarray, "j 4 4"]:
    matrices = np.tile(np.eye(4), (len(offsets_m), 1, 1))
    matrices[:, :3, 3] = offsets_m
    return matrices
