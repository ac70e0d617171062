"""A sheet with a sharp edge, as the hem of a coat has."""

import numpy as np
import trimesh

from pipeline.geometry.atlas import Atlas
from pipeline.geometry.mesh import Mesh
from pipeline.mesh.files import MeshArtifact


def wedge() -> Mesh:
    """Return a closed sheet, 1 m wide and high, that is 2 cm thick above and ends in a sharp edge below."""
    corners = [[x, y, z] for x in (0.0, 1.0) for y, z in ((0.0, 0.0), (1.0, 0.01), (1.0, -0.01))]
    faces = [[0, 3, 4], [0, 4, 1], [0, 2, 5], [0, 5, 3], [1, 4, 5], [1, 5, 2], [0, 1, 2], [3, 5, 4]]
    closed = trimesh.Trimesh(np.array(corners), np.array(faces)).subdivide().subdivide()
    return Mesh(np.asarray(closed.vertices, dtype=np.float32), np.asarray(closed.faces, dtype=np.int32))


def skinned(mesh: Mesh) -> MeshArtifact:
    count = len(mesh.vertices)
    weights = np.linspace(0.0, 1.0, count, dtype=np.float32)
    pairs = np.stack([weights, 1.0 - weights, 0.0 * weights, 0.0 * weights], axis=1)
    joints, colours = np.tile(np.arange(4, dtype=np.int32), (count, 1)), np.stack([weights] * 3, axis=1)
    return MeshArtifact(mesh, joints, pairs, colours)


def one_chart(mesh: Mesh) -> Atlas:
    """Return a layout in which every vertex has one place."""
    return Atlas(mesh.vertices[:, :2].copy(), mesh.faces, np.arange(len(mesh.vertices), dtype=np.int32))


def worst_cosine(mesh: Mesh, corner_normals: np.ndarray, faces: np.ndarray) -> float:
    """Return the smallest cosine between the normal of a face and those of its corners, of some faces."""
    return float(np.sum(mesh.face_normals()[faces, None] * corner_normals[faces], axis=2).min())


def sheet_faces(mesh: Mesh) -> np.ndarray:
    """Return the faces of both sides of the sheet, without those at its other edges, whose angles are right ones."""
    x, y = mesh.vertices[mesh.faces, 0], mesh.vertices[mesh.faces, 1]
    return np.flatnonzero((x.min(axis=1) > 0.0) & (x.max(axis=1) < 1.0) & (y.max(axis=1) < 1.0))
