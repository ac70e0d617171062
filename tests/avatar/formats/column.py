"""A wavy column with a texture seam, three joints and a clip: an avatar whose texture coordinates are a formula."""

from pathlib import Path

import numpy as np

from pipeline.avatar.gltf import SkinnedMesh, encode_glb
from pipeline.avatar.rig import build_rig
from pipeline.geometry.skinning import top_k_weights
from pipeline.io.glb import GlbFile
from pipeline.io.glb_writer import GlbWriter
from tests.avatar.avatar_sample import sample_body, sample_camera, sample_maps, sample_motion

AROUND, ALONG = 96, 120
RADIUS_M, HEIGHT_M = 0.2, 1.8
FRAMES = np.arange(0, 41, 4)


def column_mesh() -> SkinnedMesh:
    """An open column around y: u is the azimuth, v the height; the vertices at u = 0 and u = 1 coincide."""
    u, v = (values.ravel() for values in np.meshgrid(np.linspace(0, 1, AROUND + 1), np.linspace(0, 1, ALONG)))
    angle = 2.0 * np.pi * np.where(u == 1.0, 0.0, u)
    radius = RADIUS_M * (1.0 + 0.05 * np.sin(8.0 * v) * np.sin(3.0 * angle))
    positions = np.stack([radius * np.sin(angle), HEIGHT_M * v, radius * np.cos(angle)], axis=1).astype(np.float32)
    corner = np.arange(len(u)).reshape(ALONG, AROUND + 1)
    a, b, c, d = (corner[i : i + ALONG - 1, j : j + AROUND].ravel() for i, j in ((0, 0), (0, 1), (1, 1), (1, 0)))
    faces = np.concatenate([np.stack([a, b, c], 1), np.stack([a, c, d], 1)]).astype(np.int32)
    normals = np.stack([np.sin(angle), np.zeros_like(angle), np.cos(angle)], axis=1).astype(np.float32)
    closeness = np.exp(-((positions[:, 1, None] - sample_body().joints_m[:, 1]) ** 2) / 0.02)
    indices, weights = top_k_weights((closeness / closeness.sum(axis=1, keepdims=True)).astype(np.float32))
    pad = ((0, 0), (0, 4 - indices.shape[1]))
    uv = np.stack([u, v], axis=1).astype(np.float32)
    return SkinnedMesh(positions, normals, uv, np.pad(indices, pad), np.pad(weights, pad), faces)


def add_root_joint(file: GlbFile) -> GlbFile:
    """Add a joint without weights above the first one, last in the skin, as rigs for Unreal have it."""
    document = GlbWriter.from_file(file)
    (skin,) = document.json["skins"]
    matrices = file.accessor(skin["inverseBindMatrices"])
    document.replace_array(
        skin["inverseBindMatrices"], np.concatenate([matrices, np.eye(4, dtype=np.float32).reshape(1, 16)])
    )
    first = skin["joints"][0]
    document.json["nodes"].append(document.json["nodes"][-1])  # the camera stays last
    root = len(document.json["nodes"]) - 2
    document.json["nodes"][root] = {"name": "root", "children": [first]}
    skin["joints"].append(root)
    document.json["scenes"][0]["nodes"] = [0, root, root + 1]
    path = file.path.with_name("rooted.glb")
    path.write_bytes(document.to_bytes())
    return GlbFile(path)


def column_glb(folder: Path) -> GlbFile:
    """The column as the export stage writes an avatar: two maps, one clip, a camera."""
    path = folder / "avatar.glb"
    clips = {"capture": sample_motion(FRAMES)}
    path.write_bytes(encode_glb(column_mesh(), build_rig(sample_body()), clips, sample_maps(), sample_camera()))
    return GlbFile(path)
