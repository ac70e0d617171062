"""A skinned, animated avatar as one binary glTF 2.0 file (https://registry.khronos.org/glTF/specs/2.0/glTF-2.0.html).

glTF wants quaternions as xyzw, v pointing down, matrices column by column, cameras that look along -Z with +Y up.
"""

import json
import math
import struct
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
import torch
from jaxtyping import Float, Int, UInt8

from pipeline.body.body import Body, Motion
from pipeline.geometry.camera import Camera
from pipeline.geometry.rotation import continuous_quaternions, matrix_to_quaternion

_FLOAT, _U8, _U16, _U32 = 5126, 5121, 5123, 5125
_ARRAY_BUFFER, _ELEMENT_ARRAY_BUFFER = 34962, 34963
_ACCESSOR_TYPES = {1: "SCALAR", 2: "VEC2", 3: "VEC3", 4: "VEC4", 16: "MAT4"}
_COMPONENT_TYPES = {"float32": _FLOAT, "uint8": _U8, "uint16": _U16, "uint32": _U32}
_MIN_ANIMATED_ANGLE_RAD = 1e-4
_MIN_NORM = 1e-12
_MAX_JOINTS = 1 << 16


@dataclass(frozen=True)
class SkinnedMesh:
    """One corner list for all attributes, in the bind pose; uv has its origin bottom-left, faces are counter-clockwise.

    At most four influences a corner: weights sum to 1, the joint is 0 where the weight is 0.
    """

    positions_m: Float[np.ndarray, "t 3"]
    normals: Float[np.ndarray, "t 3"]
    uv: Float[np.ndarray, "t 2"]
    joint_indices: Int[np.ndarray, "t 4"]
    joint_weights: Float[np.ndarray, "t 4"]
    faces: Int[np.ndarray, "f 3"]


@dataclass(frozen=True)
class MaterialMaps:
    """PNG files' bytes and what else describes the surface.

    diffuse_png: RGB, sRGB. specular_png: what `pack_specular_factor` makes, or None for a matte surface. unlit: the
    diffuse
    map is shown as it is, whatever lamps a scene has; there are no highlights then.
    """

    diffuse_png: bytes
    specular_png: bytes | None = None
    roughness: float = 0.9
    unlit: bool = False


@dataclass
class _GlbBuilder:
    """The JSON part and the binary part while they grow."""

    json: dict[str, Any] = field(default_factory=dict)
    binary: bytearray = field(default_factory=bytearray)

    def add(self, kind: str, value: dict[str, Any]) -> int:
        self.json.setdefault(kind, []).append(value)
        return len(self.json[kind]) - 1

    def add_bytes(self, data: bytes, target: int | None = None) -> int:
        self.binary.extend(b"\0" * (-len(self.binary) % 4))
        view = {"buffer": 0, "byteOffset": len(self.binary), "byteLength": len(data)}
        self.binary.extend(data)
        return self.add("bufferViews", view | ({"target": target} if target else {}))

    def add_array(self, values: np.ndarray, target: int | None = None, bounds: bool = False) -> int:
        """An accessor for a scalar or vector array, one element a row."""
        values = np.ascontiguousarray(values)
        accessor: dict[str, Any] = {
            "bufferView": self.add_bytes(values.tobytes(), target),
            "componentType": _COMPONENT_TYPES[values.dtype.name],
            "count": len(values),
            "type": _ACCESSOR_TYPES[values[0].size],
        }
        if bounds:
            rows = values.reshape(len(values), -1)
            accessor |= {"min": rows.min(axis=0).tolist(), "max": rows.max(axis=0).tolist()}
        return self.add("accessors", accessor)

    def pack(self) -> bytes:
        self.json["buffers"] = [{"byteLength": len(self.binary)}]
        text = json.dumps(self.json, separators=(",", ":"), ensure_ascii=True).encode()
        text += b" " * (-len(text) % 4)
        binary = bytes(self.binary) + b"\0" * (-len(self.binary) % 4)
        chunks = struct.pack("<I4s", len(text), b"JSON") + text + struct.pack("<I4s", len(binary), b"BIN\0") + binary
        return struct.pack("<4sII", b"glTF", 2, 12 + len(chunks)) + chunks


def encode_glb(
    mesh: SkinnedMesh,
    body: Body,
    motion: Motion,
    maps: MaterialMaps,
    camera: Camera | None = None,
    extras: Mapping[str, Any] | None = None,
) -> bytes:
    """The bytes of a .glb: one skinned mesh at the scene's root, the body's joints, the motion as animation "capture".

    motion: in the frame of the scene (+Y up, floor at y = 0); key times are its `time_s`, which must increase.
    camera: becomes a node of the scene, so that the picture that was filmed can be laid under the avatar.
    extras: what `asset.extras` says about the file.

    Raises ValueError when there are more than 65536 joints (indices have 16 bits), no frame, times that do not
    increase, a pose that is not finite, or a quaternion without length.
    """
    if len(body.joint_names) > _MAX_JOINTS:
        raise ValueError(f"glTF counts joints in 16 bits: {len(body.joint_names)} are more than {_MAX_JOINTS}")
    _check_motion(motion)
    document = _GlbBuilder()
    document.json["asset"] = {"version": "2.0", "generator": "instant-human-mesh"}
    if extras:
        document.json["asset"]["extras"] = dict(extras)
    first_joint = 1
    document.json |= {"scene": 0, "scenes": [{"name": "scene", "nodes": [0, first_joint]}]}
    material = _add_material(document, maps)
    primitive = _add_primitive(document, mesh, len(body.joint_names)) | {"material": material}
    document.add("meshes", {"name": "avatar", "primitives": [primitive]})
    document.add("nodes", {"name": "avatar", "mesh": 0, "skin": 0})
    _add_skeleton(document, body, first_joint)
    _add_animation(document, motion, first_joint)
    if camera is not None:
        document.json["scenes"][0]["nodes"].append(_add_camera(document, camera))
    return document.pack()


def pack_specular_factor(factor: UInt8[np.ndarray, "h w"]) -> UInt8[np.ndarray, "h w 4"]:
    """A picture with the specular factor where KHR_materials_specular reads it: linear, in alpha; the rest is white.

    factor: 255 reflects as any dielectric does (4 % seen along the normal), 0 not at all.
    """
    return np.concatenate([np.full((*factor.shape, 3), 255, dtype=np.uint8), factor[..., None]], axis=2)


def write_glb(path: Path, data: bytes) -> None:
    """Write the bytes of `encode_glb`."""
    path.write_bytes(data)


def read_glb(path: Path) -> tuple[dict[str, Any], bytes]:
    """JSON part and binary part of a .glb; ValueError when it is none."""
    data = path.read_bytes()
    if len(data) < 20 or data[:4] != b"glTF":
        raise ValueError(f"{path} is no binary glTF file")
    (length,) = struct.unpack_from("<I", data, 12)
    document: dict[str, Any] = json.loads(data[20 : 20 + length])
    (binary_length,) = struct.unpack_from("<I", data, 20 + length)
    start = 28 + length
    return document, data[start : start + binary_length]


def read_accessor(document: Mapping[str, Any], binary: bytes, index: int) -> np.ndarray:
    """The values of an accessor as `encode_glb` writes them, one element a row."""
    accessor = document["accessors"][index]
    view = document["bufferViews"][accessor["bufferView"]]
    name = next(name for name, code in _COMPONENT_TYPES.items() if code == accessor["componentType"])
    width = next(width for width, kind in _ACCESSOR_TYPES.items() if kind == accessor["type"])
    start = view["byteOffset"]
    values = np.frombuffer(binary[start : start + view["byteLength"]], dtype=name)
    return values.reshape(accessor["count"], width) if width > 1 else values


def _check_motion(motion: Motion) -> None:
    """Raises ValueError for what would play as something else than was filmed."""
    times = motion.time_s.astype(np.float32)  # as they are stored
    if not len(times) or not np.all(np.diff(times) > 0):
        raise ValueError("an animation needs frames whose times increase")
    if not all(np.isfinite(values).all() for values in (times, motion.rotations_wxyz, motion.root_translation_m)):
        raise ValueError("an animation needs times, rotations and translations that are finite")
    if np.linalg.norm(motion.rotations_wxyz, axis=-1).min() < _MIN_NORM:
        raise ValueError("an animation needs quaternions with a length")


def _add_primitive(document: _GlbBuilder, mesh: SkinnedMesh, joint_count: int) -> dict[str, Any]:
    joints = mesh.joint_indices.astype(np.uint8 if joint_count <= 256 else np.uint16)
    uv = np.stack([mesh.uv[:, 0], 1.0 - mesh.uv[:, 1]], axis=1).astype(np.float32)
    # 65535 restarts a strip in the 16-bit type and may not be used
    faces = mesh.faces.astype(np.uint16 if len(mesh.positions_m) < 65535 else np.uint32)
    attributes = {
        "POSITION": document.add_array(mesh.positions_m.astype(np.float32), _ARRAY_BUFFER, bounds=True),
        "NORMAL": document.add_array(_unit_normals(mesh.normals), _ARRAY_BUFFER),
        "TEXCOORD_0": document.add_array(uv, _ARRAY_BUFFER),
        "JOINTS_0": document.add_array(joints, _ARRAY_BUFFER),
        "WEIGHTS_0": document.add_array(_normalise_weights(mesh.joint_weights), _ARRAY_BUFFER),
    }
    return {"attributes": attributes, "indices": document.add_array(faces.reshape(-1), _ELEMENT_ARRAY_BUFFER)}


def _add_material(document: _GlbBuilder, maps: MaterialMaps) -> int:
    document.add("samplers", {"magFilter": 9729, "minFilter": 9987, "wrapS": 33071, "wrapT": 33071})
    surface = {
        "name": "avatar",
        "pbrMetallicRoughness": {
            "baseColorTexture": {"index": _add_texture(document, "diffuse", maps.diffuse_png)},
            "metallicFactor": 0.0,
            "roughnessFactor": maps.roughness,
        },
    }
    extensions: dict[str, Any] = {"KHR_materials_specular": {"specularFactor": 0.0}}
    if maps.unlit:  # KHR_materials_specular must not stand beside it
        extensions = {"KHR_materials_unlit": {}}
    elif maps.specular_png is not None:
        texture = {"index": _add_texture(document, "specular", maps.specular_png)}
        extensions = {"KHR_materials_specular": {"specularTexture": texture}}
    document.json["extensionsUsed"] = list(extensions)
    return document.add("materials", surface | {"extensions": extensions})


def _add_texture(document: _GlbBuilder, name: str, png: bytes) -> int:
    view = document.add_bytes(png)
    image = document.add("images", {"name": name, "mimeType": "image/png", "bufferView": view})
    return document.add("textures", {"name": name, "source": image, "sampler": 0})


def _add_skeleton(document: _GlbBuilder, body: Body, first_joint: int) -> None:
    """Joints without rotation or scale: their rest is the bind pose, and the inverse bind matrix is a translation."""
    children: list[list[int]] = [[] for _ in body.joint_names]
    for joint, parent in enumerate(body.parents):
        if parent >= 0:
            children[parent].append(first_joint + joint)
    for joint, (name, parent) in enumerate(zip(body.joint_names, body.parents, strict=True)):
        origin = body.joints_m[parent] if parent >= 0 else np.zeros(3)
        node: dict[str, Any] = {"name": name, "translation": _float_list(body.joints_m[joint] - origin)}
        document.add("nodes", node | ({"children": children[joint]} if children[joint] else {}))
    inverse_bind = np.tile(np.eye(4, dtype=np.float32), (len(body.joints_m), 1, 1))
    inverse_bind[:, 3, :3] = -body.joints_m  # stored by columns: the translation is the last four numbers
    document.add(
        "skins",
        {
            "name": "skeleton",
            "inverseBindMatrices": document.add_array(inverse_bind.reshape(-1, 16)),
            "joints": [first_joint + joint for joint in range(len(body.joint_names))],
            "skeleton": first_joint,
        },
    )


def _add_animation(document: _GlbBuilder, motion: Motion, first_joint: int) -> None:
    times = document.add_array(motion.time_s.astype(np.float32), bounds=True)
    samplers: list[dict[str, Any]] = []
    channels: list[dict[str, Any]] = []

    def add_channel(node: int, path: str, values: np.ndarray) -> None:
        samplers.append({"input": times, "output": document.add_array(values), "interpolation": "LINEAR"})
        channels.append({"sampler": len(samplers) - 1, "target": {"node": node, "path": path}})

    add_channel(first_joint, "translation", motion.root_translation_m.astype(np.float32))
    continuous = continuous_quaternions(torch.from_numpy(motion.rotations_wxyz.astype(np.float64))).numpy()
    for joint in range(continuous.shape[1]):
        rotations = continuous[:, joint] / np.linalg.norm(continuous[:, joint], axis=1, keepdims=True)
        angle = 2.0 * np.arctan2(np.linalg.norm(rotations[:, 1:], axis=1), np.abs(rotations[:, 0]))
        if angle.max() > _MIN_ANIMATED_ANGLE_RAD:
            add_channel(first_joint + joint, "rotation", rotations[:, [1, 2, 3, 0]].astype(np.float32))
    document.add("animations", {"name": "capture", "samplers": samplers, "channels": channels})


def _add_camera(document: _GlbBuilder, camera: Camera) -> int:
    """The camera as a node; what glTF's symmetric pinhole cannot say (principal point, fx) stays in its extras."""
    axes = np.diag([1.0, -1.0, -1.0])
    rotation = torch.from_numpy(camera.world_to_camera[:3, :3].T.astype(np.float64) @ axes)
    wxyz = matrix_to_quaternion(rotation[None])[0]
    perspective = {
        "yfov": 2.0 * math.atan2(0.5 * camera.height, camera.fy),
        "aspectRatio": camera.width / camera.fx * camera.fy / camera.height,
        "znear": 0.05,
    }
    extras = {
        "intrinsics_px": [float(value) for value in (camera.fx, camera.fy, camera.cx, camera.cy)],
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
    """Rows of length 1 in float32; a normal without length, as of a vertex without area, becomes (0, 1, 0)."""
    normals = normals.astype(np.float64)
    length = np.linalg.norm(normals, axis=1, keepdims=True)
    upright = np.array([0.0, 1.0, 0.0])
    return np.where(length > _MIN_NORM, normals / np.maximum(length, _MIN_NORM), upright).astype(np.float32)


def _normalise_weights(weights: np.ndarray) -> np.ndarray:
    """Weights whose float32 sum is 1 to the last bit but one: the rounding goes to the largest."""
    weights = (weights.astype(np.float64) / weights.sum(axis=1, keepdims=True, dtype=np.float64)).astype(np.float32)
    rows, largest = np.arange(len(weights)), weights.argmax(axis=1)
    weights[rows, largest] += np.float32(1.0) - weights.sum(axis=1, dtype=np.float32)
    return weights


def _float_list(values: np.ndarray) -> list[float]:
    return [float(value) for value in np.asarray(values, dtype=np.float32)]
