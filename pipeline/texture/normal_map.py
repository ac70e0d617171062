"""Bake the detail of a dense mesh into a normal map in the tangent space of the mesh that is exported.

Conventions of glTF 2.0: red, green and blue are the components (from -1 to 1) along tangent, bitangent and normal;
green points up in the image. The tangent frames are those that are exported (`pipeline.geometry.tangents`).

Reference: Cignoni et al., "A general method for preserving attribute values on simplified meshes", 1998.
"""

import numpy as np
import torch
from jaxtyping import Bool, Float, Float32

from pipeline.geometry.atlas import Atlas, Texels, rasterize_texels
from pipeline.geometry.mesh import Mesh
from pipeline.geometry.surface import closest_points_on_mesh
from pipeline.geometry.tangents import tangent_frames, vertex_tangents
from pipeline.geometry.texture_rendering import sample_texture
from pipeline.texture.edge_padding import fill_unknown_texels
from pipeline.texture.files import FLAT_NORMAL

MAX_DISTANCE_M = 0.01
"""A texel farther from the dense mesh stays flat: another sheet of the surface may be nearer than its own."""

MIN_COSINE = 0.5
"""Between the normals of the two meshes; below, the nearest point is on another sheet, as between fingers."""


def bake_normal_map(mesh: Mesh, atlas: Atlas, dense: Mesh, size_px: int) -> Float32[np.ndarray, "s s 3"]:
    """Return the map whose normals are those of the dense mesh at the closest point of each texel; gutters filled.

    Args:
        mesh: that is exported, m.
        atlas: of that mesh.
        dense: in the same pose.
        size_px: side of the map.
    """
    texels = rasterize_texels(atlas, size_px)
    corners = mesh.faces[texels.face]
    frames = texel_frames(mesh, atlas, texels)
    points_m = np.einsum("tk,tkc->tc", texels.barycentric, mesh.vertices[corners])
    distance_m, face, weights = closest_points_on_mesh(points_m, dense)
    detail = np.einsum("tk,tkc->tc", weights, dense.vertex_normals()[dense.faces[face]])
    is_same_sheet = (distance_m < MAX_DISTANCE_M) & (np.sum(detail * frames[..., 2], axis=1) > MIN_COSINE)
    encoded = encode_normals(frames, detail, is_same_sheet)
    return fill_unknown_texels(texels.to_texture(encoded), texels.coverage_mask())


def texel_frames(mesh: Mesh, atlas: Atlas, texels: Texels) -> Float[np.ndarray, "n 3 3"]:
    """Return the matrix from tangent space to the frame of the mesh at each texel."""
    normals = mesh.vertex_normals()[atlas.vertex_of_uv]
    tangents = vertex_tangents(mesh.vertices[atlas.vertex_of_uv], normals, atlas.uv, atlas.faces_uv)
    return tangent_frames(
        texels.interpolate(atlas.faces_uv, normals), texels.interpolate(atlas.faces_uv, tangents.astype(np.float64))
    )


def decode_normals(
    normal_map: Float32[np.ndarray, "h w 3"], uv: Float[np.ndarray, "n 2"], frames: Float[np.ndarray, "n 3 3"]
) -> Float[np.ndarray, "n 3"]:
    """Return the unit normals that a viewer shades with: bilinear samples of the map in the frames of the points.

    uv: origin bottom-left. frames: from tangent space.
    """
    samples = sample_texture(torch.from_numpy(normal_map), torch.from_numpy(uv.astype(np.float32))).numpy()
    normals = np.einsum("nij,nj->ni", frames, 2.0 * samples.astype(np.float64) - 1.0)
    return normals / np.linalg.norm(normals, axis=1, keepdims=True)


def encode_normals(
    frames: Float[np.ndarray, "n 3 3"], normals: Float[np.ndarray, "n 3"], known: Bool[np.ndarray, "n"]
) -> Float[np.ndarray, "n 3"]:
    """Return the texels, in [0, 1], with which frames from tangent space give unit normals; flat where not known."""
    local = np.where(known[:, None], _solve(frames, normals), (0.0, 0.0, 1.0))
    return np.asarray(0.5 + 0.5 * local / np.linalg.norm(local, axis=1, keepdims=True))


def widen_flat(normal_map: Float32[np.ndarray, "s s 3"]) -> Float32[np.ndarray, "s w 3"]:
    """Return a map of twice the width whose right half is flat."""
    return np.concatenate([normal_map, np.full_like(normal_map, FLAT_NORMAL)], axis=1)


def _solve(frames: Float[np.ndarray, "n 3 3"], vectors: Float[np.ndarray, "n 3"]) -> Float[np.ndarray, "n 3"]:
    """Return the components of vectors along the columns of frames, which are not quite perpendicular.

    By Cramer's rule: a third of the time of `numpy.linalg.solve` on many small systems.
    """
    tangent, bitangent, normal = (frames[..., k] for k in range(3))
    rows = np.stack([np.cross(bitangent, normal), np.cross(normal, tangent), np.cross(tangent, bitangent)], axis=1)
    volume = np.sum(rows[:, 0] * tangent, axis=1)
    return np.einsum("nij,nj->ni", rows, vectors) / volume[:, None]
