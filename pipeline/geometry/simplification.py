"""Reduction of the faces of a textured mesh: vertices are some of the full mesh, with all attributes.

Vertices are duplicated along the seams of the texture, as in glTF; the collapse joins them: seams stay closed.
"""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float, Int
from scipy.spatial import cKDTree

_UV_SCALE = 1e-6
"""Weight of a texture coordinate against a metre where duplicates of a vertex are told apart."""

_SHAPE_WEIGHT = 0.1
"""Weight of well-shaped triangles. 0.3, VCGlib's default, costs 1 dB in renders of the reduced mesh; 0 tears it."""

_MESHLAB_DEFAULTS = {
    "planarquadric": False,
    "preserveboundary": False,
    "boundaryweight": 1.0,
    "extratcoordw": 1.0,
    "selected": False,
}
"""Parameters whose defaults are, in MeshLab, the values of the last call in the process."""


@dataclass(frozen=True)
class ReducedFaces:
    """A part of the vertices of a mesh with fewer faces between them.

    Attributes:
        source_vertex: vertex of the full mesh from which each vertex takes position, normal, skin and morphs.
        uv: texture coordinates. Of most vertices those of the source; where a collapse met a seam, other ones.
        faces: indices into `source_vertex`; counter-clockwise as before.
    """

    source_vertex: Int[np.ndarray, "n"]
    uv: Float[np.ndarray, "n 2"]
    faces: Int[np.ndarray, "g 3"]


def collapse_textured_edges(
    positions_m: Float[np.ndarray, "v 3"], uv: Float[np.ndarray, "v 2"], faces: Int[np.ndarray, "f 3"], face_count: int
) -> ReducedFaces:
    """Collapse edges onto one of their ends, those first that change surface and texture coordinates least.

    The error is a quadric of position and texture coordinates (Garland and Heckbert, "Simplifying surfaces with color
    and texture using quadric error metrics", 1998; VCGlib). Vertices at the same position are one vertex of the
    surface. Vertices that may move would be closer to the full mesh, but their skin and morphs would have to be
    interpolated.

    Args:
        positions_m: with one row for each combination of position and texture coordinate.
        uv: in [0, 1].
        faces: triangles.
        face_count: number of faces to reach; a few less or more are possible.
    """
    import pymeshlab  # imported here because the import takes 0.25 s and few stages need it

    meshes = pymeshlab.MeshSet()
    mesh = pymeshlab.Mesh(
        positions_m.astype(np.float64), faces.astype(np.int32), v_tex_coords_matrix=uv.astype(np.float64)
    )
    meshes.add_mesh(mesh)
    meshes.compute_texcoord_transfer_vertex_to_wedge()
    meshes.meshing_remove_duplicate_vertices()
    meshes.meshing_decimation_quadric_edge_collapse_with_texture(
        targetfacenum=face_count,
        optimalplacement=False,
        preservenormal=True,
        qualitythr=_SHAPE_WEIGHT,
        **_MESHLAB_DEFAULTS,
    )
    reduced = meshes.current_mesh()
    corner_uv = reduced.wedge_tex_coord_matrix()
    corners = np.c_[reduced.vertex_matrix()[reduced.face_matrix().reshape(-1)], _UV_SCALE * corner_uv]
    _, source_vertex = cKDTree(np.c_[positions_m, _UV_SCALE * uv].astype(np.float64)).query(corners)
    vertices, corner_vertex = np.unique(np.c_[source_vertex, corner_uv], axis=0, return_inverse=True)
    return ReducedFaces(
        vertices[:, 0].astype(np.int64),
        vertices[:, 1:].astype(np.float32),
        corner_vertex.reshape(-1, 3).astype(np.int32),
    )
