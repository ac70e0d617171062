"""Differentiable rendering of a mesh.

Vertex attributes are interpolated with perspective-correct barycentric coordinates; silhouettes are antialiased, which
gives gradients of the coverage (Laine et al., "Modular Primitives for High-Performance Differentiable Rendering",
2020).
"""

from collections.abc import Callable
from typing import NamedTuple

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from pipeline.geometry.camera import Camera, project
from pipeline.kernels.interpolate import interpolate
from pipeline.kernels.raster import SilhouetteBlends, antialias, rasterize, silhouette_blends


def face_adjacency(faces: Int[Tensor, "f 3"]) -> Int[Tensor, "f 3"]:
    """Return the neighbour of every face across edge k = (corner k, corner k + 1).

    The neighbour is -1 at a border and at edges with more than two faces. `igl.triangle_triangle_adjacency` is not used
    because it returns one of the neighbours at edges with more than two faces.
    """
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
    return neighbour.view(-1, 3).to(torch.int32)


def render_shaded(
    vertices_world: Float[Tensor, "v 3"],
    faces: Int[Tensor, "f 3"],
    camera: Camera,
    attributes: Float[Tensor, "v c"],
    shader: Callable[[Float[Tensor, "n c"]], Float[Tensor, "n d"]],
    adjacency: Int[Tensor, "f 3"] | None = None,
) -> tuple[Float[Tensor, "h w d"], Float[Tensor, "h w"], Int[Tensor, "h w"]]:
    """Render a mesh with deferred shading.

    Differentiable in `vertices_world` (inside faces through interpolation, at silhouettes through antialiasing), in
    `attributes` and in the parameters of `shader`.

    Args:
        vertices_world: posed vertices, m.
        faces: corners of each face.
        camera: the camera.
        attributes: vertex attributes.
        shader: called once with the interpolated attributes of all covered pixels; returns their colours.
        adjacency: `face_adjacency(faces)`, to be passed if the same mesh is rendered several times.

    Returns:
        The image premultiplied by alpha, alpha in [0, 1], and the face index of each pixel (-1 for none). The image
        composited on white is `image + 1 - alpha`.
    """
    adjacency = face_adjacency(faces) if adjacency is None else adjacency
    size = camera.height, camera.width
    return render_pixels(*project(vertices_world, camera), (faces, adjacency), size, attributes, shader).image()


class RenderedPixels(NamedTuple):
    """Some pixels of a render.

    pixel: row-major indices, increasing. values: premultiplied colours, and alpha in the last column. at_silhouette:
    pixels whose coverage depends on the vertices. face_id, depth_m: of every pixel of the image; -1 and inf for none.
    """

    pixel: Int[Tensor, "n"]
    values: Float[Tensor, "n d"]
    at_silhouette: Bool[Tensor, "n"]
    face_id: Int[Tensor, "h w"]
    depth_m: Float[Tensor, "h w"]

    def image(self) -> tuple[Float[Tensor, "h w c"], Float[Tensor, "h w"], Int[Tensor, "h w"]]:
        """Return the image premultiplied by alpha, alpha, and the face index of each pixel, as `render_shaded`."""
        blank = torch.zeros(self.face_id.numel(), self.values.shape[1]).to(self.values)
        image = blank.index_copy(0, self.pixel, self.values).view(*self.face_id.shape, -1)
        return image[..., :-1], image[..., -1], self.face_id


def render_pixels(
    vertices_px: Float[Tensor, "v 2"],
    depth_m: Float[Tensor, "v"],
    topology: tuple[Int[Tensor, "f 3"], Int[Tensor, "f 3"]],
    size: tuple[int, int],
    attributes: Float[Tensor, "v c"],
    shader: Callable[[Float[Tensor, "n c"]], Float[Tensor, "n d"]],
    wanted: Bool[Tensor, "h w"] | None = None,
) -> RenderedPixels:
    """Do `render_shaded` at the silhouettes, and at those other covered pixels that are wanted (default: all).

    Of a closed mesh, whose faces are counter-clockwise seen from outside, only those that face the camera are drawn.

    Args:
        vertices_px, depth_m: projected vertices, from `project` or `project_skinned`.
        topology: corners of each face, and `face_adjacency` of them.
        size: height and width of the image.
        attributes, shader: as for `render_shaded`.
        wanted: pixels to draw.
    """
    faces, adjacency = topology
    is_closed = len(faces) > 0 and int(adjacency.min()) >= 0
    face_id, _, depth = rasterize(vertices_px, depth_m, faces, *size, cull_backfaces=is_closed)
    blends = silhouette_blends(face_id, depth, vertices_px, depth_m, faces, adjacency)
    flat_face_id = face_id.reshape(-1)
    is_covered, at_silhouette = flat_face_id >= 0, torch.zeros(face_id.numel(), dtype=torch.bool, device=face_id.device)
    at_silhouette[blends.near], at_silhouette[blends.far] = True, True
    is_drawn = is_covered if wanted is None else is_covered & wanted.reshape(-1)
    pixel = torch.nonzero(is_drawn | at_silhouette).squeeze(1)
    covered = torch.nonzero(is_covered[pixel]).squeeze(1)
    covered_pixel = pixel[covered]
    shaded = shader(
        interpolate(covered_pixel, flat_face_id[covered_pixel], size[1], vertices_px, depth_m, faces, attributes)
    )
    with_alpha = torch.cat([shaded, shaded.new_ones(len(shaded), 1)], dim=1)
    values = torch.zeros(len(pixel), with_alpha.shape[1]).to(with_alpha).index_copy(0, covered, with_alpha)
    row_of_pixel = torch.empty(face_id.numel(), dtype=torch.int64, device=face_id.device)
    row_of_pixel[pixel] = torch.arange(len(pixel), device=pixel.device)
    target, near, far = (row_of_pixel[part] for part in (blends.target, blends.near, blends.far))
    rows = SilhouetteBlends(target, near, far, blends.fraction)
    return RenderedPixels(pixel, antialias(values, rows), at_silhouette[pixel], face_id, depth)


def render_attributes(
    vertices_world: Float[Tensor, "v 3"],
    faces: Int[Tensor, "f 3"],
    camera: Camera,
    attributes: Float[Tensor, "v c"],
    adjacency: Int[Tensor, "f 3"] | None = None,
) -> tuple[Float[Tensor, "h w c"], Float[Tensor, "h w"]]:
    """Render interpolated attributes: the image premultiplied by alpha, and alpha; see `render_shaded`."""
    image, alpha, _ = render_shaded(vertices_world, faces, camera, attributes, lambda values: values, adjacency)
    return image, alpha
