"""Rasterisation of triangle meshes by z-buffer, and differentiable antialiasing of silhouettes."""

from typing import Any

import torch
from jaxtyping import Float, Int
from torch import Tensor

from pipeline.kernels.common.dispatch import runs_on_numba
from pipeline.kernels.raster import reference
from pipeline.kernels.raster.cpu import rasterize_cpu, silhouette_edges_cpu
from pipeline.kernels.raster.reference import SilhouetteBlends, rasterize_reference, silhouette_edges
from pipeline.kernels.raster.silhouette_cpu import add_fraction_gradient, silhouette_blends_cpu


def rasterize(
    vertices_px: Float[Tensor, "v 2"],
    depth_m: Float[Tensor, "v"],
    faces: Int[Tensor, "f 3"],
    height: int,
    width: int,
    near_m: float = 0.01,
    cull_backfaces: bool = False,
) -> tuple[Int[Tensor, "h w"], Float[Tensor, "h w 3"], Float[Tensor, "h w"]]:
    """Find the visible face at every pixel centre.

    Not differentiable: gradients come from interpolation with the face ids (`pipeline.geometry.differentiable_raster`).

    Args:
        vertices_px: image position, pixel centres at +0.5.
        depth_m: distance along the camera axis, > 0 in front of the camera.
        near_m: faces with a corner nearer than this, or with a NaN, are dropped.

    Returns:
        face_id (h, w) int32: the nearest face, the lower index if two are equal in float32; -1 where there is none.
        barycentric (h, w, 3): perspective-correct; 0 where there is no face.
        depth (h, w): metres; inf where there is no face.

    Raises IndexError if a face refers to a vertex that does not exist.

    >>> corners = torch.tensor([[0.0, 0.0], [0.0, 4.0], [4.0, 0.0]])
    >>> rasterize(corners, torch.ones(3), torch.tensor([[0, 1, 2]]), 2, 2)[0].tolist()
    [[0, 0], [0, 0]]
    """
    low, high = (int(faces.min()), int(faces.max())) if len(faces) else (0, -1)
    if low < 0 or high >= len(vertices_px):
        raise IndexError(f"faces refer to vertices {low}..{high}, the mesh has {len(vertices_px)}")
    vertices_px, depth_m = vertices_px.detach(), depth_m.detach()
    if not runs_on_numba(vertices_px, depth_m):
        return rasterize_reference(vertices_px, depth_m, faces, height, width, near_m, cull_backfaces)
    arrays = (
        vertices_px.contiguous().numpy(),
        depth_m.contiguous().numpy(),
        faces.to(torch.int32).contiguous().numpy(),
    )
    face_id, barycentric, depth = rasterize_cpu(*arrays, height, width, near_m, cull_backfaces)
    return torch.from_numpy(face_id), torch.from_numpy(barycentric), torch.from_numpy(depth)


def silhouette_blends(
    face_id: Int[Tensor, "h w"],
    depth: Float[Tensor, "h w"],
    vertices_px: Float[Tensor, "v 2"],
    depth_m: Float[Tensor, "v"],
    faces: Int[Tensor, "f 3"],
    adjacency: Int[Tensor, "f 3"],
) -> SilhouetteBlends:
    """Find neighbouring pixels to blend by the position where a silhouette edge crosses the line between their centres.

    The blend gives the coverage at silhouettes, and it is the only path for gradients of the silhouette's position
    (after Laine et al., "Modular primitives for high-performance differentiable rendering", 2020, section 3.4).
    Laine et al. search the silhouette edge in the faces visible at the two pixels. With faces of a few pixels, the face
    of that edge is often a sliver that covers no pixel centre: on a sphere of 5120 faces and 50 px radius all but 8
    border pixels were missed. This function therefore visits every silhouette edge.

    Args:
        face_id, depth: from `rasterize` of the same mesh.
        adjacency: face across edge k = (corner k, corner k + 1), -1 if there is none
            (`pipeline.geometry.differentiable_raster.face_adjacency`).
    """
    if not runs_on_numba(vertices_px, depth_m):
        edges = silhouette_edges(vertices_px.detach(), faces.long(), adjacency.long())
        return reference.silhouette_blends(face_id, depth, vertices_px, depth_m, edges)
    topology = (part.to(torch.int32).contiguous().numpy() for part in (faces, adjacency))
    edges = silhouette_edges_cpu(vertices_px.detach().contiguous().numpy(), *topology)
    fraction, pixels = _Fractions.apply(vertices_px, depth_m, face_id, depth, edges)
    target, near, far = pixels.unbind(1)
    return SilhouetteBlends(target, near, far, fraction)


class _Fractions(torch.autograd.Function):
    """Fractions of the blends, differentiable in the vertices, and their pixels (target, near, far)."""

    @staticmethod
    def forward(
        context: Any, vertices_px: Tensor, depth_m: Tensor, face_id: Tensor, depth: Tensor, edges: Any
    ) -> tuple[Tensor, Tensor]:
        arrays = [tensor.detach().contiguous().numpy() for tensor in (face_id, depth, vertices_px, depth_m)]
        pixels, fraction, *context.linear = silhouette_blends_cpu(*arrays, edges)
        context.vertex_count = len(vertices_px)
        result = torch.from_numpy(fraction), torch.from_numpy(pixels)
        context.mark_non_differentiable(result[1])
        return result

    @staticmethod
    def backward(context: Any, gradient: Tensor, _: Tensor) -> tuple[Tensor | None, ...]:
        total = add_fraction_gradient(*context.linear, gradient.contiguous().numpy(), context.vertex_count)
        return torch.from_numpy(total), None, None, None, None


def antialias(values: Float[Tensor, "n c"], blends: SilhouetteBlends) -> Float[Tensor, "n c"]:
    """Blend the values of pixels at silhouettes; differentiable in the values and, by `blends`, in the vertices.

    Args:
        values: any attributes of the pixels to which the indices of `blends` refer, 0 outside the mesh.
    """
    return values.index_add(0, blends.target, blends.fraction[:, None] * (values[blends.near] - values[blends.far]))
