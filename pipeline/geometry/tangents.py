"""Tangent frames of a mesh with texture coordinates, as normal maps of glTF need them.

Reference: Mikkelsen, "Simulation of wrinkled surfaces revisited", 2008, and his MikkTSpace: the tangent of a vertex is
the mean of the directions of growing u in the faces around it, each projected into the vertex's tangent plane, of unit
length, weighted by the face's angle there. The bitangent is `sign * cross(normal, tangent)` and points to growing v.
"""

import numpy as np
from jaxtyping import Float, Int

_TINY = 1e-20


def vertex_tangents(
    positions_m: Float[np.ndarray, "t 3"],
    normals: Float[np.ndarray, "t 3"],
    uv: Float[np.ndarray, "t 2"],
    faces: Int[np.ndarray, "f 3"],
) -> Float[np.ndarray, "t 4"]:
    """Return the unit tangent and the sign of the bitangent (1 or -1: mirrored chart) of each vertex.

    Vertices are duplicated along UV seams, with the same normal. MikkTSpace would also divide a vertex whose faces are
    partly mirrored; here the larger angle decides. A vertex without a direction of u gets any in its tangent plane.

    Args:
        positions_m: +Y up.
        normals: unit length.
        uv: origin bottom-left; glTF's bitangent points up in the image.
        faces: counter-clockwise.
    """
    unit = _normalised(normals.astype(np.float64))
    edge_1, edge_2 = (positions_m[faces[:, k]].astype(np.float64) - positions_m[faces[:, 0]] for k in (1, 2))
    du_1, dv_1 = (uv[faces[:, 1]].astype(np.float64) - uv[faces[:, 0]]).T
    du_2, dv_2 = (uv[faces[:, 2]].astype(np.float64) - uv[faces[:, 0]]).T
    orientation = np.sign(du_1 * dv_2 - du_2 * dv_1)
    along_u = orientation[:, None] * (dv_2[:, None] * edge_1 - dv_1[:, None] * edge_2)
    total, balance = np.zeros((len(uv), 3)), np.zeros(len(uv))
    for corner in range(3):
        here = faces[:, corner]
        to_next, to_last = (
            _in_plane(positions_m[faces[:, (corner + step) % 3]].astype(np.float64) - positions_m[here], unit[here])
            for step in (1, 2)
        )
        angle_rad = np.arccos(np.clip(np.sum(to_next * to_last, axis=1), -1.0, 1.0))
        direction = angle_rad[:, None] * _in_plane(along_u, unit[here])
        for axis in range(3):
            total[:, axis] += np.bincount(here, direction[:, axis], minlength=len(uv))
        balance += np.bincount(here, angle_rad * orientation, minlength=len(uv))
    tangent = _in_plane(total, unit)
    is_lost = np.linalg.norm(tangent, axis=1) < 0.5
    tangent[is_lost] = _any_tangent(unit[is_lost])
    return np.column_stack([tangent, np.where(balance < 0.0, -1.0, 1.0)]).astype(np.float32)


def tangent_frames(normals: Float[np.ndarray, "n 3"], tangents: Float[np.ndarray, "n 4"]) -> Float[np.ndarray, "n 3 3"]:
    """Return the matrices from tangent space, columns tangent, bitangent, normal, of interpolated vertex attributes.

    Normal and tangent are of unit length; the interpolated tangent is not quite perpendicular to the normal (glTF 2.0,
    3.7.2.1; the shaders of three.js and of Khronos' viewer do the same).
    """
    normal, tangent = _normalised(normals.astype(np.float64)), _normalised(tangents[:, :3].astype(np.float64))
    bitangent = np.where(tangents[:, 3:] < 0.0, -1.0, 1.0) * np.cross(normal, tangent)
    return np.stack([tangent, bitangent, normal], axis=2)


def _normalised(vectors: Float[np.ndarray, "n 3"]) -> Float[np.ndarray, "n 3"]:
    return vectors / np.maximum(np.linalg.norm(vectors, axis=1, keepdims=True), _TINY)


def _in_plane(vectors: Float[np.ndarray, "n 3"], normals: Float[np.ndarray, "n 3"]) -> Float[np.ndarray, "n 3"]:
    """Return the unit directions of vectors in the planes with these unit normals; 0 where there is none."""
    return _normalised(vectors - np.sum(vectors * normals, axis=1, keepdims=True) * normals)


def _any_tangent(normals: Float[np.ndarray, "n 3"]) -> Float[np.ndarray, "n 3"]:
    """Return a unit vector perpendicular to each normal."""
    axis = np.eye(3)[np.argmin(np.abs(normals), axis=1)]
    return _normalised(np.cross(normals, axis))
