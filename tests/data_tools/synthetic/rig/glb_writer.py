"""A tiny rigged person as a .glb: one box per limb, positions as normalised 16-bit integers, scale in the matrices."""

import json
import struct
from pathlib import Path

import cv2
import numpy as np

# Name, parent, position in the T-pose (metres).
RIG = [
    ("Hips", None, (0.0, 1.0, 0.0)),
    ("Spine", "Hips", (0.0, 1.2, 0.0)),
    ("Head", "Spine", (0.0, 1.5, 0.0)),
    ("HeadEnd", "Head", (0.0, 1.7, 0.0)),
    *((f"{s}Arm", "Spine", (0.2 * x, 1.45, 0.0)) for s, x in (("Left", 1), ("Right", -1))),
    *((f"{s}ForeArm", f"{s}Arm", (0.45 * x, 1.45, 0.0)) for s, x in (("Left", 1), ("Right", -1))),
    *((f"{s}Hand", f"{s}ForeArm", (0.7 * x, 1.45, 0.0)) for s, x in (("Left", 1), ("Right", -1))),
    *((f"{s}UpLeg", "Hips", (0.1 * x, 0.95, 0.0)) for s, x in (("Left", 1), ("Right", -1))),
    *((f"{s}Leg", f"{s}UpLeg", (0.1 * x, 0.5, 0.0)) for s, x in (("Left", 1), ("Right", -1))),
    *((f"{s}Foot", f"{s}Leg", (0.1 * x, 0.1, 0.0)) for s, x in (("Left", 1), ("Right", -1))),
    *((f"{s}ToeBase", f"{s}Foot", (0.1 * x, 0.05, 0.12)) for s, x in (("Left", 1), ("Right", -1))),
]
ARMATURE_SCALE = 0.01
BOX_M = 0.05
POSITION_RANGE_M = 2.0
"""Positions are stored as fractions of this range."""

COLOUR = (30, 120, 210)


def box_vertices() -> np.ndarray:
    """Return the eight corners of a box around each joint, metres, T-pose."""
    corners = np.array(np.meshgrid([-1, 1], [-1, 1], [-1, 1], indexing="ij")).reshape(3, -1).T * BOX_M
    return np.concatenate([np.array(place) + corners for _, _, place in RIG])


def write_test_glb(path: Path, prefix: str = "", drop: str = "") -> None:
    """Write the person. drop: name of a joint that is renamed, so that it is missing."""
    names = [name for name, _, _ in RIG]
    places = {name: np.array(place) for name, _, place in RIG}
    stored = np.rint(box_vertices() / POSITION_RANGE_M * 32767).astype("<i2")
    padded = np.concatenate([stored, np.zeros((len(stored), 1), "<i2")], axis=1)  # stride 8, as alignment asks
    joints = np.zeros((len(stored), 4), "u1")
    joints[:, 0] = np.repeat(np.arange(len(RIG)), 8)
    weights = np.zeros((len(stored), 4), "u1")
    weights[:, 0] = 255
    uv = np.tile(np.array([[0.25, 0.75]], "<f4"), (len(stored), 1))
    quads = np.array([[0, 1, 3, 2], [4, 6, 7, 5], [0, 4, 5, 1], [2, 3, 7, 6], [0, 2, 6, 4], [1, 5, 7, 3]])
    box = np.concatenate([quads[:, [0, 1, 2]], quads[:, [0, 2, 3]]])
    faces = (box[None] + 8 * np.arange(len(RIG))[:, None, None]).reshape(-1).astype("<u2")
    bind = np.tile(np.eye(4, dtype="<f4"), (len(RIG), 1, 1))
    for index, name in enumerate(names):
        bind[index, :3, :3] *= POSITION_RANGE_M / ARMATURE_SCALE
        bind[index, :3, 3] = -places[name] / ARMATURE_SCALE
    picture = cv2.imencode(".png", np.full((4, 4, 3), COLOUR[::-1], np.uint8))[1].tobytes()
    blobs = [padded.tobytes(), joints.tobytes(), weights.tobytes(), uv.tobytes(), faces.tobytes()]
    blobs += [bind.transpose(0, 2, 1).tobytes(), picture]
    _write(path, blobs, _tree(blobs, names, places, len(stored), len(faces), prefix, drop))


def _tree(
    blobs: list[bytes],
    names: list[str],
    places: dict[str, np.ndarray],
    vertex_count: int,
    index_count: int,
    prefix: str,
    drop: str,
) -> dict:
    nodes = []
    for name, parent, place in RIG:
        offset = np.array(place) - (places[parent] if parent else 0.0)
        scale = ARMATURE_SCALE if parent else 1.0
        node = {"name": prefix + (name if name != drop else "Tail"), "translation": (offset / scale).tolist()}
        if parent is None:
            node["scale"] = [ARMATURE_SCALE] * 3
        children = [names.index(child) for child, its_parent, _ in RIG if its_parent == name]
        nodes.append({**node, "children": children} if children else node)
    nodes.append({"name": "person", "mesh": 0, "skin": 0})
    starts = np.cumsum([0, *(len(blob) + -len(blob) % 4 for blob in blobs[:-1])]).tolist()
    views = [{"buffer": 0, "byteOffset": s, "byteLength": len(b)} for s, b in zip(starts, blobs, strict=True)]
    views[0]["byteStride"] = 8
    kinds = [(5122, "VEC3", True), (5121, "VEC4", False), (5121, "VEC4", True), (5126, "VEC2", False)]
    accessors = [
        {"bufferView": i, "componentType": c, "type": t, "normalized": n, "count": vertex_count}
        for i, (c, t, n) in enumerate(kinds)
    ]
    accessors.append({"bufferView": 4, "componentType": 5123, "type": "SCALAR", "count": index_count})
    accessors.append({"bufferView": 5, "componentType": 5126, "type": "MAT4", "count": len(RIG)})
    attributes = {"POSITION": 0, "JOINTS_0": 1, "WEIGHTS_0": 2, "TEXCOORD_0": 3}
    return {
        "asset": {"version": "2.0"},
        "scenes": [{"nodes": [0, len(RIG)]}],
        "nodes": nodes,
        "meshes": [{"primitives": [{"attributes": attributes, "indices": 4, "material": 0}]}],
        "skins": [{"joints": list(range(len(RIG))), "inverseBindMatrices": 5}],
        "materials": [{"pbrMetallicRoughness": {"baseColorTexture": {"index": 0}, "baseColorFactor": [1, 0.5, 1, 1]}}],
        "textures": [{"source": 0}],
        "images": [{"bufferView": 6, "mimeType": "image/png"}],
        "accessors": accessors,
        "bufferViews": views,
        "buffers": [{"byteLength": starts[-1] + len(blobs[-1])}],
    }


def _write(path: Path, blobs: list[bytes], gltf: dict) -> None:
    text = json.dumps(gltf).encode()
    text += b" " * (-len(text) % 4)
    binary = b"".join(blob + b"\0" * (-len(blob) % 4) for blob in blobs)
    chunks = struct.pack("<II", len(text), 0x4E4F534A) + text + struct.pack("<II", len(binary), 0x004E4942) + binary
    path.write_bytes(b"glTF" + struct.pack("<II", 2, 12 + len(chunks)) + chunks)
