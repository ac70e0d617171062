"""Encode a skinned, animated avatar as binary glTF 2.0 (https://registry.khronos.org/glTF/specs/2.0/glTF-2.0.html).

glTF conventions: quaternions xyzw, v pointing down, column-major matrices, cameras looking along -Z with +Y up.
trimesh writes neither skins nor animations; `pipeline.io.glb` reads what is written here.
"""

import math
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
from jaxtyping import Float, Int

from pipeline.avatar.gltf_material import MaterialMaps, add_material
from pipeline.avatar.rig import Rig
from pipeline.body.body import Motion
from pipeline.geometry.camera import Camera
from pipeline.geometry.rotation import continuous_quaternions, matrix_to_quaternion, quaternion_to_matrix
from pipeline.geometry.tangents import vertex_tangents
from pipeline.io.glb_writer import GlbWriter

_ARRAY_BUFFER, _ELEMENT_ARRAY_BUFFER = 34962, 34963
_MIN_ANIMATED_ANGLE_RAD = 1e-4
_MIN_ROTATION_RAD = 1e-6
_MIN_NORM = 1e-12
_MAX_JOINTS = 1 << 16
_SCENE_NAME = "Armature"
"""three.js names the group of all nodes after the scene. Programs for avatars look for a group `Armature` with mesh and
joints, as Blender exports it; a node of this name above a skinned mesh would be against glTF's advice."""


@dataclass(frozen=True)
class MorphTargets:
    """Morph targets of a mesh.

    Attributes:
        names: written as `extras.targetNames`, where Blender, three.js and Unity read them.
        displacements_m: of each vertex at weight 1, in the rest pose.
        normal_changes: of the unit normal of each vertex, from weight 0 to 1; None where viewers keep those at rest.
        eyes_m: centres of the left and the right eyeball in the rest pose, written as nodes `LeftEye` and `RightEye` of
            the head, which programs that direct a gaze look for; None without eyes.
    """

    names: tuple[str, ...]
    displacements_m: Float[np.ndarray, "m t 3"]
    eyes_m: Float[np.ndarray, "2 3"] | None = None
    normal_changes: Float[np.ndarray, "m t 3"] | None = None


@dataclass(frozen=True)
class SkinnedMesh:
    """A mesh in the bind pose with one index per corner: vertices are duplicated along UV seams.

    Attributes:
        positions_m: +Y up.
        normals: not necessarily of unit length.
        uv: origin bottom-left.
        joint_indices: at most four influences per vertex; 0 where the weight is 0.
        joint_weights: rows sum to 1.
        faces: counter-clockwise.
        morphs: morph targets; None without any.
    """

    positions_m: Float[np.ndarray, "t 3"]
    normals: Float[np.ndarray, "t 3"]
    uv: Float[np.ndarray, "t 2"]
    joint_indices: Int[np.ndarray, "t 4"]
    joint_weights: Float[np.ndarray, "t 4"]
    faces: Int[np.ndarray, "f 3"]
    morphs: MorphTargets | None = None


def encode_glb(
    mesh: SkinnedMesh,
    rig: Rig,
    clips: Mapping[str, Motion],
    maps: MaterialMaps,
    camera: Camera | None = None,
    extras: Mapping[str, Any] | None = None,
) -> bytes:
    """Encode one skinned mesh at the scene root, the joints and the clips (animations, by name) as a .glb.

    Args:
        mesh: in the rest pose of `rig`.
        rig: joint names, axes and rest pose.
        clips: in the frame of the scene (+Y up, floor at y = 0); key times are their `time_s`.
        maps: material.
        camera: capture camera, written as a node, so that the filmed images can be shown as a background.
        extras: contents of `asset.extras`.

    Raises:
        ValueError: more than 65536 joints (indices have 16 bits), no frame, times that do not increase, a value that is
            not finite, or a zero quaternion.
    """
    if len(rig.joint_names) >= _MAX_JOINTS:
        raise ValueError(f"glTF joint indices have 16 bits: {len(rig.joint_names)} joints exceed {_MAX_JOINTS}")
    for motion in clips.values():
        _check_motion(motion)
    document = GlbWriter()
    document.json["asset"] = {"version": "2.0", "generator": "instant-human-mesh"}
    if extras:
        document.json["asset"]["extras"] = dict(extras)
    first_joint = 1
    material = add_material(document, maps)
    primitive = _add_primitive(document, mesh, len(rig.joint_names), maps.has_normals) | {"material": material}
    named: dict[str, Any] = {"name": "avatar", "primitives": [primitive]}
    if mesh.morphs is not None:
        names = mesh.morphs.names
        named |= {"weights": [0.0] * len(names), "extras": {"targetNames": list(names)}}
        primitive["targets"] = [
            {"POSITION": document.add_sparse_array(moved.astype(np.float32), bounds=True)}
            for moved in mesh.morphs.displacements_m
        ]
        turns = mesh.morphs.normal_changes if mesh.morphs.normal_changes is not None else ()
        for target, turned in zip(primitive["targets"], turns, strict=False):
            target["NORMAL"] = document.add_sparse_array(turned.astype(np.float32))
    document.add("meshes", named)
    document.add("nodes", {"name": "avatar", "mesh": 0, "skin": 0})
    skeleton_root = _add_skeleton(document, rig, first_joint)
    if mesh.morphs is not None and mesh.morphs.eyes_m is not None:
        _add_eyes(document, mesh.morphs.eyes_m, rig, first_joint)
    document.json |= {"scene": 0, "scenes": [{"name": _SCENE_NAME, "nodes": [0, skeleton_root]}]}
    for name, motion in clips.items():
        _add_animation(document, name, motion, rig, first_joint)
    if camera is not None:
        document.json["scenes"][0]["nodes"].append(_add_camera(document, camera))
    return document.to_bytes()


def _check_motion(motion: Motion) -> None:
    """Raise ValueError for a motion that a viewer cannot play correctly."""
    times = motion.time_s.astype(np.float32)  # the stored precision
    if not len(times) or not np.all(np.diff(times) > 0):
        raise ValueError("an animation needs at least one frame, and times that increase")
    if not all(np.isfinite(values).all() for values in (times, motion.rotations_wxyz, motion.root_translation_m)):
        raise ValueError("an animation needs finite times, rotations and translations")
    if np.linalg.norm(motion.rotations_wxyz, axis=-1).min() < _MIN_NORM:
        raise ValueError("an animation needs quaternions of non-zero length")


def _add_primitive(document: GlbWriter, mesh: SkinnedMesh, joint_count: int, has_tangents: bool) -> dict[str, Any]:
    joints = mesh.joint_indices.astype(np.uint8 if joint_count <= 256 else np.uint16)
    uv = np.stack([mesh.uv[:, 0], 1.0 - mesh.uv[:, 1]], axis=1).astype(np.float32)
    # 65535 is the primitive restart value of 16-bit indices and is not allowed as an index
    faces = mesh.faces.astype(np.uint16 if len(mesh.positions_m) < 65535 else np.uint32)
    attributes = {
        "POSITION": document.add_array(mesh.positions_m.astype(np.float32), _ARRAY_BUFFER, bounds=True),
        "NORMAL": document.add_array(_unit_normals(mesh.normals), _ARRAY_BUFFER),
        "TEXCOORD_0": document.add_array(uv, _ARRAY_BUFFER),
        "JOINTS_0": document.add_array(joints, _ARRAY_BUFFER),
        "WEIGHTS_0": document.add_array(normalise_weights(mesh.joint_weights), _ARRAY_BUFFER),
    }
    if has_tangents:
        tangents = vertex_tangents(mesh.positions_m, _unit_normals(mesh.normals), mesh.uv, mesh.faces)
        attributes["TANGENT"] = document.add_array(tangents, _ARRAY_BUFFER)
    return {"attributes": attributes, "indices": document.add_array(faces.reshape(-1), _ELEMENT_ARRAY_BUFFER)}


def _add_skeleton(document: GlbWriter, rig: Rig, first_joint: int) -> int:
    """Add the joint nodes in the rest pose, which is the bind pose, without scale; return the node of the root."""
    count, root = len(rig.joint_names), first_joint
    children: list[list[int]] = [[] for _ in rig.joint_names]
    for joint, parent in enumerate(rig.body.parents):
        if parent >= 0:
            children[parent].append(first_joint + joint)
    local = rig.local_rest_matrices()
    rotations_wxyz = matrix_to_quaternion(torch.from_numpy(local[:, :3, :3])).numpy()
    is_turned = _angle_rad(rotations_wxyz) > _MIN_ROTATION_RAD
    for joint, name in enumerate(rig.joint_names):
        node: dict[str, Any] = {"name": name, "translation": _float_list(local[joint, :3, 3])}
        if is_turned[joint]:
            node["rotation"] = _float_list(rotations_wxyz[joint, [1, 2, 3, 0]])
        document.add("nodes", node | ({"children": children[joint]} if children[joint] else {}))
    inverse_bind = np.linalg.inv(rig.rest_matrices()).astype(np.float32)
    inverse_bind[:, 3] = (0.0, 0.0, 0.0, 1.0)
    joints = [first_joint + joint for joint in range(count)]
    if rig.root_name is not None:
        root = document.add("nodes", {"name": rig.root_name, "children": [first_joint]})
        joints.append(root)
        inverse_bind = np.concatenate([inverse_bind, np.eye(4, dtype=np.float32)[None]])
    columns = inverse_bind.transpose(0, 2, 1).reshape(-1, 16)
    skin = {"inverseBindMatrices": document.add_array(columns), "joints": joints, "skeleton": root}
    document.add("skins", {"name": "skeleton", **skin})
    return root


def _add_eyes(document: GlbWriter, eyes_m: Float[np.ndarray, "2 3"], rig: Rig, first_joint: int) -> None:
    """Add a node for each eyeball to the head; no vertex follows it."""
    head = rig.body.joint("Head")
    to_head = np.linalg.inv(rig.rest_matrices()[head])
    for name, centre_m in zip(("LeftEye", "RightEye"), eyes_m, strict=True):
        local_m = to_head[:3, :3] @ centre_m + to_head[:3, 3]
        node = document.add("nodes", {"name": name, "translation": _float_list(local_m)})
        document.json["nodes"][first_joint + head].setdefault("children", []).append(node)


def _angle_rad(rotations_wxyz: np.ndarray) -> np.ndarray:
    return 2.0 * np.arctan2(np.linalg.norm(rotations_wxyz[..., 1:], axis=-1), np.abs(rotations_wxyz[..., 0]))


def _add_animation(document: GlbWriter, name: str, motion: Motion, rig: Rig, first_joint: int) -> None:
    """Add a clip; joints that stay in the rest pose have no channel."""
    times = document.add_array(motion.time_s.astype(np.float32), bounds=True)
    samplers: list[dict[str, Any]] = []
    channels: list[dict[str, Any]] = []

    def add_channel(node: int, path: str, values: np.ndarray) -> None:
        samplers.append({"input": times, "output": document.add_array(values), "interpolation": "LINEAR"})
        channels.append({"sampler": len(samplers) - 1, "target": {"node": node, "path": path}})

    add_channel(first_joint, "translation", motion.root_translation_m.astype(np.float32))
    rest = rig.local_rest_matrices()[:, :3, :3]
    continuous = continuous_quaternions(torch.from_numpy(rig.local_rotations_wxyz(motion).astype(np.float64))).numpy()
    for joint in range(continuous.shape[1]):
        rotations = continuous[:, joint] / np.linalg.norm(continuous[:, joint], axis=1, keepdims=True)
        from_rest = quaternion_to_matrix(torch.from_numpy(rotations)).numpy() @ rest[joint].T
        if _angle_rad(matrix_to_quaternion(torch.from_numpy(from_rest)).numpy()).max() > _MIN_ANIMATED_ANGLE_RAD:
            add_channel(first_joint + joint, "rotation", rotations[:, [1, 2, 3, 0]].astype(np.float32))
    document.add("animations", {"name": name, "samplers": samplers, "channels": channels})


def _add_camera(document: GlbWriter, camera: Camera) -> int:
    """Add the camera as a node.

    glTF cameras have a centred principal point; the full intrinsics are written to the extras of the node.
    """
    axes = np.diag([1.0, -1.0, -1.0])
    rotation = torch.from_numpy(camera.world_to_camera[:3, :3].T.astype(np.float64) @ axes)
    wxyz = matrix_to_quaternion(rotation[None])[0]
    perspective = {
        "yfov": 2.0 * math.atan2(0.5 * camera.height, camera.fy),
        "aspectRatio": camera.width / camera.fx * camera.fy / camera.height,
        "znear": 0.05,
    }
    extras = {
        "intrinsics_px": [float(value) for value in camera.intrinsics_px],
        "size_px": [camera.width, camera.height],
    }
    index = document.add("cameras", {"name": "capture_camera", "type": "perspective", "perspective": perspective})
    node = {
        "name": "capture_camera",
        "camera": index,
        "translation": _float_list(camera.centre_m()),
        "rotation": _float_list(wxyz.numpy()[[1, 2, 3, 0]]),
        "extras": extras,
    }
    return document.add("nodes", node)


def _unit_normals(normals: np.ndarray) -> np.ndarray:
    """Return unit rows in float32; a zero normal, as of a vertex without area, becomes (0, 1, 0)."""
    normals = normals.astype(np.float64)
    length = np.linalg.norm(normals, axis=1, keepdims=True)
    upright = np.array([0.0, 1.0, 0.0])
    return np.where(length > _MIN_NORM, normals / np.maximum(length, _MIN_NORM), upright).astype(np.float32)


def normalise_weights(weights: np.ndarray) -> np.ndarray:
    """Return float32 weights whose rows sum to 1 within one unit of precision: the largest takes the rounding error."""
    weights = (weights.astype(np.float64) / weights.sum(axis=1, keepdims=True, dtype=np.float64)).astype(np.float32)
    rows, largest = np.arange(len(weights)), weights.argmax(axis=1)
    weights[rows, largest] += np.float32(1.0) - weights.sum(axis=1, dtype=np.float32)
    return weights


def _float_list(values: np.ndarray) -> list[float]:
    return [float(value) for value in np.asarray(values, dtype=np.float32)]
