"""A mesh whose vertices are its texels: what is fitted to vertices is sampled like a texture."""

import numpy as np
import torch
from jaxtyping import Float, Float32, Int

from pipeline.geometry.atlas import Texels
from pipeline.geometry.mesh import Mesh
from pipeline.texture.bake import TexturedSurface, texels_to_texture


def texels_at_vertices(faces: Int[np.ndarray, "f 3"], vertex_count: int) -> Texels:
    """Return one "texel" at each vertex that has a face, so that vertices are sampled like texels.

    The column of each texel is its vertex index.
    """
    corners = faces.reshape(-1)
    vertices, first = np.unique(corners, return_index=True)
    barycentric = np.eye(3, dtype=np.float32)[first % 3]
    zeros = np.zeros(len(vertices), dtype=np.int32)
    return Texels(vertex_count, zeros, vertices.astype(np.int32), (first // 3).astype(np.int32), barycentric)


def vertex_surface(mesh: Mesh) -> TexturedSurface:
    """Return the surface whose texels are the vertices of a mesh."""
    faces = torch.from_numpy(mesh.faces)
    count = len(mesh.vertices)
    return TexturedSurface(faces, faces, torch.zeros(count, 2), texels_at_vertices(mesh.faces, count))


def vertex_map(values: Float[np.ndarray, "v"], mesh: Mesh, texels: Texels) -> Float32[np.ndarray, "s s"]:
    """Return a map of values at the vertices, gutters filled."""
    at_texels = torch.from_numpy(texels.interpolate(mesh.faces, values[:, None]))
    return np.ascontiguousarray(texels_to_texture(at_texels, texels)[..., 0])
