"""The canonical mesh beside the capture: crops of frames, the mesh rendered into them, and how far both differ."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Float, Int, UInt8
from torch import Tensor

from pipeline.body.body import Body
from pipeline.capture.matting import resize_premultiplied
from pipeline.geometry.camera import Camera, project
from pipeline.geometry.differentiable_raster import face_adjacency, render_shaded
from pipeline.geometry.mesh import Mesh
from pipeline.geometry.skinning import linear_blend_skinning, top_k_weights
from pipeline.kernels.raster import rasterize
from pipeline.mesh.isosurface import transfer_skin_weights

Shader = Callable[[Float[Tensor, "n 3"]], Float[Tensor, "n 3"]]
"""Colours (n, 3) in [0, 1] at canonical points (n, 3) m."""

CROP_MARGIN_RATIO = 0.06


@dataclass(frozen=True)
class PosedView:
    """A crop of a frame around the person: colours and mask 0..255, and the pose that was held then."""

    image: UInt8[Tensor, "h w 3"]
    mask: UInt8[Tensor, "h w"]
    camera: Camera
    canonical_to_world: Float[Tensor, "j 4 4"]


@dataclass(frozen=True)
class SkinnedTopology:
    """A mesh that can be posed and rendered: torch copies of what stays fixed while vertices move."""

    faces: Int[Tensor, "f 3"]
    adjacency: Int[Tensor, "f 3"]
    weights: Float[Tensor, "v j"]


def crop_posed_view(
    image: Float[np.ndarray, "h w 3"],
    mask: Float[np.ndarray, "h w"],
    camera: Camera,
    canonical_to_world: Float[Tensor, "j 4 4"],
    max_person_px: int,
) -> PosedView:
    """The part of a frame around the mask, reduced until the person is at most ``max_person_px`` high.

    image, mask: in [0, 1]; colours beyond the mask are lost. A frame with an empty mask is kept whole.
    """
    rows, columns = (np.flatnonzero((mask > 0.5).any(axis=axis)) for axis in (1, 0))
    rows = rows if len(rows) else np.array([0, camera.height - 1])
    columns = columns if len(columns) else np.array([0, camera.width - 1])
    mask_height_px = int(rows[-1] - rows[0]) + 1
    margin = 4 + round(CROP_MARGIN_RATIO * mask_height_px)
    top, left = max(0, rows[0] - margin), max(0, columns[0] - margin)
    bottom, right = min(camera.height, rows[-1] + 1 + margin), min(camera.width, columns[-1] + 1 + margin)
    small = camera.cropped(int(left), int(top), int(right - left), int(bottom - top))
    small = small.scaled(min(1.0, max_person_px / mask_height_px))
    parts = resize_premultiplied(
        image[top:bottom, left:right], mask[top:bottom, left:right], (small.width, small.height)
    )
    pixels, alpha = (torch.from_numpy(np.round(255.0 * np.clip(part, 0.0, 1.0)).astype(np.uint8)) for part in parts)
    return PosedView(pixels, alpha, small, canonical_to_world)


def pixel_footprint_m(
    view: PosedView, vertices: Float[np.ndarray, "v 3"], skin_weights: Float[np.ndarray, "v j"]
) -> float:
    """What a pixel of the view covers at the middle of the posed vertices' depths, m."""
    posed = linear_blend_skinning(
        torch.from_numpy(vertices), torch.from_numpy(skin_weights), view.canonical_to_world[None]
    )[0]
    _, depth_m = project(posed, view.camera)
    return float(depth_m.median()) / view.camera.fx


def transfer_skin(mesh: Mesh, body: Body) -> SkinnedTopology:
    """Four influences a vertex, as exported, from the body."""
    indices, kept = top_k_weights(transfer_skin_weights(mesh, body))
    dense = np.zeros((len(mesh.vertices), len(body.joint_names)), dtype=np.float32)
    np.add.at(dense, (np.arange(len(dense))[:, None], indices), kept)
    return build_skinned_topology(mesh, torch.from_numpy(dense))


def build_skinned_topology(mesh: Mesh, weights: Float[Tensor, "v j"]) -> SkinnedTopology:
    """The skin of a mesh whose weights are known."""
    faces = torch.from_numpy(mesh.faces.astype(np.int64))
    return SkinnedTopology(faces, face_adjacency(faces), weights)


def render_posed_view(
    vertices: Float[Tensor, "v 3"], skin: SkinnedTopology, view: PosedView, shader: Shader
) -> tuple[Float[Tensor, "h w 3"], Float[Tensor, "h w"], Int[Tensor, "h w"]]:
    """Premultiplied colour, alpha and face ids of the canonical mesh in a view's pose; colours are asked for at
    canonical points."""
    posed = linear_blend_skinning(vertices, skin.weights, view.canonical_to_world[None])[0]
    return render_shaded(posed, skin.faces, view.camera, vertices, shader, skin.adjacency)


def composite_target(
    view: PosedView, background: Float[Tensor, "3"]
) -> tuple[Float[Tensor, "h w 3"], Float[Tensor, "h w"]]:
    """The view's colours over a background, and its mask, both in [0, 1]."""
    mask = view.mask.float() / 255.0
    return view.image.float() / 255.0 * mask[..., None] + (1.0 - mask[..., None]) * background, mask


def view_losses(
    image: Float[Tensor, "h w 3"], alpha: Float[Tensor, "h w"], view: PosedView, background: Float[Tensor, "3"]
) -> tuple[Float[Tensor, ""], Float[Tensor, ""]]:
    """How far a render (premultiplied colours, coverage) is from a view: colours before a background, and outlines.

    Both near the mean absolute error: Huber with delta 0.1 is 0.1 |e| for large errors, hence the factor 10.
    """
    target, mask = composite_target(view, background)
    composited = image + (1.0 - alpha[..., None]) * background
    return 10.0 * torch.nn.functional.huber_loss(composited, target, delta=0.1), (alpha - mask).abs().mean()


@torch.no_grad()
def accumulate_face_errors(
    mesh: Mesh, skin: SkinnedTopology, views: Sequence[PosedView], shader: Shader
) -> Float[np.ndarray, "f"]:
    """Colour error (sum over channels, pixels and views of the absolute difference, white behind) that lands on each
    face."""
    total = np.zeros(len(mesh.faces))
    vertices, white = torch.from_numpy(mesh.vertices), torch.ones(3)
    for view in views:
        image, alpha, face_id = render_posed_view(vertices, skin, view, shader)
        error = (image + (1.0 - alpha[..., None]) - composite_target(view, white)[0]).abs().sum(2)
        seen = face_id >= 0
        total += np.bincount(face_id[seen].numpy(), error[seen].numpy(), minlength=len(total))
    return total


@torch.no_grad()
def validation_psnr_db(mesh: Mesh, skin: SkinnedTopology, views: Sequence[PosedView], shader: Shader) -> float:
    """PSNR of all crops together, white behind; 0 when there is no view."""
    vertices, white = torch.from_numpy(mesh.vertices), torch.ones(3)
    squared, count = 0.0, 0
    for view in views:
        image, alpha, _ = render_posed_view(vertices, skin, view, shader)
        error = image + (1.0 - alpha[..., None]) - composite_target(view, white)[0]
        squared, count = squared + float(error.square().sum()), count + error.numel()
    return -10.0 * float(np.log10(max(squared / count, 1e-12))) if count else 0.0


@torch.no_grad()
def silhouette_iou(mesh: Mesh, skin: SkinnedTopology, views: Sequence[PosedView]) -> float:
    """Overlap of the mesh's silhouettes with the masks over all views together, intersection by union in [0, 1]."""
    intersection_px = union_px = 0
    vertices = torch.from_numpy(mesh.vertices)
    for view in views:
        posed = linear_blend_skinning(vertices, skin.weights, view.canonical_to_world[None])[0]
        camera = view.camera
        seen = rasterize(*project(posed, camera), skin.faces, camera.height, camera.width)[0] >= 0
        mask = view.mask > 127
        intersection_px, union_px = intersection_px + int((seen & mask).sum()), union_px + int((seen | mask).sum())
    return intersection_px / union_px if union_px else 0.0
