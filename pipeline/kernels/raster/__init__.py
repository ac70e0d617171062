"""Visibility of a triangle mesh: z-buffer rasterisation, and silhouette antialiasing that carries gradients to the
vertices."""

import torch
from jaxtyping import Float, Int
from torch import Tensor

from pipeline.kernels.common.dispatch import runs_on_numba
from pipeline.kernels.raster.cpu import rasterize_cpu
from pipeline.kernels.raster.reference import antialias_reference, rasterize_reference


def rasterize(
    vertices_px: Float[Tensor, "v 2"],
    depth_m: Float[Tensor, "v"],
    faces: Int[Tensor, "f 3"],
    height: int,
    width: int,
    near_m: float = 0.01,
    cull_backfaces: bool = False,
) -> tuple[Int[Tensor, "h w"], Float[Tensor, "h w 3"], Float[Tensor, "h w"]]:
    """The face seen at every pixel centre.

    vertices_px: image position (pixel centres at +0.5); depth_m: distance along the camera axis, > 0 in front. Faces
    with a corner nearer than ``near_m`` (or NaN) are dropped whole. Nearer wins; on a tie (within float32) the lower
    face index. Nothing here is differentiable: gradients come from interpolating with the face ids again
    (``pipeline.geometry.differentiable_raster``).

    Returns face_id (h, w) int32, -1 where empty; barycentric (h, w, 3), perspective-correct, 0 where empty; depth (h,
    w) m, inf where empty. Raises IndexError when a face names a vertex that does not exist.

    >>> corners = torch.tensor([[0.0, 0.0], [0.0, 4.0], [4.0, 0.0]])
    >>> rasterize(corners, torch.ones(3), torch.tensor([[0, 1, 2]]), 2, 2)[0].tolist()
    [[0, 0], [0, 0]]
    """
    if len(faces) and not 0 <= int(faces.min()) <= int(faces.max()) < len(vertices_px):
        raise IndexError(f"faces name vertices {int(faces.min())}..{int(faces.max())}, the mesh has {len(vertices_px)}")
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


def antialias(
    image: Float[Tensor, "h w c"],
    face_id: Int[Tensor, "h w"],
    depth: Float[Tensor, "h w"],
    vertices_px: Float[Tensor, "v 2"],
    depth_m: Float[Tensor, "v"],
    faces: Int[Tensor, "f 3"],
    adjacency: Int[Tensor, "f 3"],
) -> Float[Tensor, "h w c"]:
    """Blends neighbouring pixels by where a silhouette cuts the line between their centres: coverage at borders, and
    the only way in which a silhouette's position reaches a loss (after Laine et al., "Modular primitives for
    high-performance differentiable rendering", 2020, section 3.4).

    There the silhouette edge is looked for in the faces seen at the two pixels. With faces of a few pixels the face
    that owns it is a sliver that covers no pixel centre (on a sphere of 5120 faces and 50 px radius all but 8 border
    pixels were missed), so here every silhouette edge is walked instead.

    image: any attributes, 0 outside. face_id, depth: from ``rasterize`` of vertices_px, depth_m (m), faces. adjacency:
    face across edge k = (corner k, corner k + 1), -1 if none
    (``pipeline.geometry.differentiable_raster.face_adjacency``).
    Differentiable in image and vertices_px.
    """
    return antialias_reference(image, face_id, depth, vertices_px, depth_m, faces.long(), adjacency.long())
