"""Reduction of the faces of a mesh: the vertices that are left are vertices of the full mesh, with all attributes."""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float, Int
from scipy.spatial import cKDTree

_SHAPE_WEIGHT = 0.1
"""Weight of well-shaped triangles; 0.3 is VCGlib's default."""

_MESHLAB_DEFAULTS = {
    "preserveboundary": False,
    "preservetopology": False,
    "planarquadric": False,
    "boundaryweight": 1.0,
    "qualityweight": False,
    "autoclean": True,
    "selected": False,
}
"""Parameters whose defaults are, in MeshLab, the values of the last call in the process."""


@dataclass(frozen=True)
class ReducedFaces:
    """A part of the vertices of a mesh with fewer faces between them.

    Attributes:
        source_vertex: vertex of the full mesh from which each vertex takes position, normal, skin and morphs.
        faces: indices into `source_vertex`; counter-clockwise as before.
    """

    source_vertex: Int[np.ndarray, "n"]
    faces: Int[np.ndarray, "g 3"]


def collapse_edges(
    positions_m: Float[np.ndarray, "v 3"], faces: Int[np.ndarray, "f 3"], face_count: int
) -> ReducedFaces:
    """Collapse edges onto one of their ends, those first that change the surface least.

    The error is a quadric of the position (Garland and Heckbert, "Surface simplification using quadric error metrics",
    1997; VCGlib). Vertices at the same position are one vertex. Vertices that may move would be closer to the full
    mesh, but their skin and morphs would have to be interpolated.

    Args:
        positions_m: vertices; duplicates, as along the seams of a texture, are allowed.
        faces: triangles.
        face_count: number of faces to reach; a few less or more are possible.
    """
    import pymeshlab  # imported here because the import takes 0.25 s and few stages need it

    meshes = pymeshlab.MeshSet()
    meshes.add_mesh(pymeshlab.Mesh(positions_m.astype(np.float64), faces.astype(np.int32)))
    meshes.meshing_remove_duplicate_vertices()
    meshes.meshing_decimation_quadric_edge_collapse(
        targetfacenum=face_count,
        targetperc=0.0,
        optimalplacement=False,
        preservenormal=True,
        qualitythr=_SHAPE_WEIGHT,
        **_MESHLAB_DEFAULTS,
    )
    reduced = meshes.current_mesh()
    _, source_vertex = cKDTree(positions_m.astype(np.float64)).query(reduced.vertex_matrix())
    return ReducedFaces(source_vertex.astype(np.int64), reduced.face_matrix().astype(np.int32))
