"""A differentiable picture of a mesh: attributes interpolated with perspective-correct barycentrics, silhouettes antialiased."""

import torch
from jaxtyping import Float, Int
from torch import Tensor

from pipeline.geometry.camera import Camera, project
from pipeline.kernels.raster import antialias, rasterize
from pipeline.kernels.reference.raster import pixel_centres_px, weighted_inverse_depth


def face_adjacency(faces: Int[Tensor, "f 3"]) -> Int[Tensor, "f 3"]:
    """Face across edge k = (corner k, corner k + 1) of every face; -1 at a border and at edges shared by more than two faces."""
    faces = faces.long()
    edges = torch.stack([faces, faces.roll(-1, dims=1)], dim=2).view(-1, 2)
    low, high = edges.amin(1), edges.amax(1)
    _, edge, count = torch.unique(
        low * (int(faces.max()) + 1 if len(faces) else 1) + high, return_inverse=True, return_counts=True
    )
    order = torch.argsort(edge, stable=True)
    first = (count.cumsum(0) - count)[count == 2]
    left, right = order[first], order[first + 1]
    neighbour = torch.full((len(edges),), -1, dtype=torch.int64, device=faces.device)
    neighbour[left], neighbour[right] = right // 3, left // 3
    return neighbour.view(-1, 3)


def interpolate(
    face_id: Int[Tensor, "h w"],
    vertices_px: Float[Tensor, "v 2"],
    depth_m: Float[Tensor, "v"],
    faces: Int[Tensor, "f 3"],
    attributes: Float[Tensor, "v c"],
) -> Float[Tensor, "h w c"]:
    """Attributes at every pixel centre, 0 where no face is seen. Differentiable in positions, depth and attributes."""
    height, width = face_id.shape
    covered = torch.nonzero(face_id.reshape(-1) >= 0).squeeze(1)
    corner = faces.long()[face_id.reshape(-1)[covered].long()]
    q = weighted_inverse_depth(
        vertices_px[corner], depth_m[corner], pixel_centres_px(covered, width, vertices_px.dtype)
    )
    values = ((q / q.sum(1, keepdim=True))[..., None] * attributes[corner]).sum(1)
    image = torch.zeros(height * width, attributes.shape[1], dtype=values.dtype, device=values.device)
    return image.index_copy(0, covered, values).view(height, width, -1)


def render_mesh(
    vertices_world: Float[Tensor, "v 3"],
    faces: Int[Tensor, "f 3"],
    camera: Camera,
    attributes: Float[Tensor, "v c"],
    adjacency: Int[Tensor, "f 3"] | None = None,
) -> tuple[Float[Tensor, "h w c"], Float[Tensor, "h w"]]:
    """(attribute image premultiplied by alpha, alpha in [0, 1]) of a mesh in metres; composite on white with ``image + 1 - alpha``.

    Differentiable in ``vertices_world`` (inside faces through interpolation, at silhouettes through antialiasing) and in ``attributes``.
    adjacency: ``face_adjacency(faces)``, to be passed in when the same mesh is rendered many times.
    """
    vertices_px, depth_m = project(vertices_world, camera)
    face_id, _, depth = rasterize(vertices_px, depth_m, faces, camera.height, camera.width)
    adjacency = face_adjacency(faces) if adjacency is None else adjacency
    with_alpha = torch.cat([attributes, torch.ones_like(attributes[:, :1])], dim=1)
    image = interpolate(face_id, vertices_px, depth_m, faces, with_alpha)
    image = antialias(image, face_id, depth, vertices_px, depth_m, faces, adjacency)
    return image[..., :-1], image[..., -1]
