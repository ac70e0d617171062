"""Meshes in and out of MeshLab.

pymeshlab is imported in the functions, because the import takes 0.25 s and few stages need it.
"""

from typing import Any

import numpy as np
from jaxtyping import Bool

from pipeline.geometry.mesh import Mesh


def to_meshset(mesh: Mesh, selected: Bool[np.ndarray, "f"] | None = None) -> Any:
    """Return a set of one mesh, some of its faces selected."""
    import pymeshlab

    meshes = pymeshlab.MeshSet()
    add_to_meshset(meshes, mesh, selected)
    return meshes


def add_to_meshset(meshes: Any, mesh: Mesh, selected: Bool[np.ndarray, "f"] | None = None) -> None:
    """Add a mesh to a set, some of its faces selected; it becomes the current one."""
    import pymeshlab

    extra = {} if selected is None else {"f_scalar_array": selected.astype(np.float64)}
    meshes.add_mesh(pymeshlab.Mesh(mesh.vertices.astype(np.float64), mesh.faces.astype(np.int32), **extra))
    if selected is not None:
        meshes.compute_selection_by_condition_per_face(condselect="fq > 0.5")


def from_meshset(meshes: Any) -> Mesh:
    """Return the current mesh of a set."""
    current = meshes.current_mesh()
    return Mesh(current.vertex_matrix().astype(np.float32), current.face_matrix().astype(np.int32))
