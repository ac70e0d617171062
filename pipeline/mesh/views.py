"""Views of the canonical mesh: cropped video frames with their poses, renders in these poses, and image errors."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Float, Int, UInt8
from torch import Tensor

from pipeline.capture.masks.matting import resize_premultiplied
from pipeline.geometry.camera import Camera
from pipeline.geometry.differentiable_raster import render_pixels
from pipeline.geometry.mesh import Mesh
from pipeline.geometry.skinning import linear_blend_skinning
from pipeline.kernels.common.thread_pool import shared_thread_pool
from pipeline.kernels.raster import rasterize
from pipeline.kernels.skinned_projection import project_skinned
from pipeline.mesh.skin_transfer import SkinnedTopology
from pipeline.metrics.images import composite_on_white, composite_premultiplied_on_white, validation_psnr_db

Shader = Callable[[Float[Tensor, "n 3"]], Float[Tensor, "n 3"]]
"""Colours (n, 3) in [0, 1] at canonical points (n, 3) in m."""

CROP_MARGIN_RATIO = 0.06
"""Margin of a crop around the mask, as a fraction of the height of the mask."""
HUBER_DELTA = 0.1
COLOUR_LOSS_SCALE = 1.0 / HUBER_DELTA


@dataclass(frozen=True)
class PosedView:
    """A crop of a frame around the person, with the pose of the person in that frame.

    image, mask: straight colours and alpha, 0 to 255. camera: camera of the crop. canonical_to_world: skinning matrix
    of each joint.
    """

    image: UInt8[Tensor, "h w 3"]
    mask: UInt8[Tensor, "h w"]
    camera: Camera
    canonical_to_world: Float[Tensor, "j 4 4"]

    def pose_vertices(self, vertices: Float[Tensor, "v 3"], weights: Float[Tensor, "v j"]) -> Float[Tensor, "v 3"]:
        """Return the vertices in the pose of this view (m, world) by linear blend skinning."""
        return linear_blend_skinning(vertices, weights, self.canonical_to_world[None])[0]

    def project_vertices(
        self, vertices: Float[Tensor, "v 3"], skin: SkinnedTopology
    ) -> tuple[Float[Tensor, "v 2"], Float[Tensor, "v"]]:
        """Return pixel positions and depths (m) of the vertices in the pose of this view; differentiable in them."""
        world_to_camera = torch.from_numpy(np.asarray(self.camera.world_to_camera)).to(self.canonical_to_world)
        canonical_to_camera = world_to_camera @ self.canonical_to_world
        return project_skinned(vertices, skin.sparse_weights, canonical_to_camera, self.camera.intrinsics_px)

    def scaled(self, factor: float) -> "PosedView":
        """Return the view with its picture resized by `factor` (at most 1), by area averaging."""
        camera = self.camera.scaled(factor)
        image, mask = (part.numpy().astype(np.float32) / 255.0 for part in (self.image, self.mask))
        resized = _quantise(resize_premultiplied(image, mask, (camera.width, camera.height)))
        return PosedView(*resized, camera, self.canonical_to_world)


def crop_posed_view(
    image: Float[np.ndarray, "h w 3"],
    mask: Float[np.ndarray, "h w"],
    camera: Camera,
    canonical_to_world: Float[Tensor, "j 4 4"],
    max_person_px: int,
) -> PosedView:
    """Crop a frame to the mask with a margin, and downsample it until the person is at most `max_person_px` high.

    A frame with an empty mask is not cropped.

    Args:
        image, mask: colours and alpha in [0, 1]; colours outside the mask are not kept.
        camera: camera of the frame.
        canonical_to_world: skinning matrices of the frame.
        max_person_px: largest height of the mask in the result.
    """
    rows, columns = (np.flatnonzero((mask > 0.5).any(axis=axis)) for axis in (1, 0))
    rows = rows if len(rows) else np.array([0, camera.height - 1])
    columns = columns if len(columns) else np.array([0, camera.width - 1])
    mask_height_px = int(rows[-1] - rows[0]) + 1
    margin = 4 + round(CROP_MARGIN_RATIO * mask_height_px)
    top, left = max(0, rows[0] - margin), max(0, columns[0] - margin)
    bottom, right = min(camera.height, rows[-1] + 1 + margin), min(camera.width, columns[-1] + 1 + margin)
    crop_camera = camera.cropped(int(left), int(top), int(right - left), int(bottom - top))
    crop_camera = crop_camera.scaled(min(1.0, max_person_px / mask_height_px))
    size_px = (crop_camera.width, crop_camera.height)
    resized = _quantise(resize_premultiplied(image[top:bottom, left:right], mask[top:bottom, left:right], size_px))
    return PosedView(*resized, crop_camera, canonical_to_world)


def _quantise(
    parts: tuple[Float[np.ndarray, "h w 3"], Float[np.ndarray, "h w"]],
) -> tuple[UInt8[Tensor, "h w 3"], UInt8[Tensor, "h w"]]:
    """Return colours and alpha in [0, 1] as bytes."""
    image, alpha = (torch.from_numpy(np.round(255.0 * np.clip(part, 0.0, 1.0)).astype(np.uint8)) for part in parts)
    return image, alpha


def render_posed_view(
    vertices: Float[Tensor, "v 3"], skin: SkinnedTopology, view: PosedView, shader: Shader
) -> tuple[Float[Tensor, "h w 3"], Float[Tensor, "h w"], Int[Tensor, "h w"]]:
    """Render the canonical mesh in the pose of a view: premultiplied colours, alpha and face indices.

    The shader is evaluated at canonical points. Differentiable as `render_shaded`.
    """
    topology, size = (skin.faces, skin.adjacency), (view.camera.height, view.camera.width)
    return render_pixels(*view.project_vertices(vertices, skin), topology, size, vertices, shader).image()


def composite_target(
    view: PosedView, background: Float[Tensor, "3"]
) -> tuple[Float[Tensor, "h w 3"], Float[Tensor, "h w"]]:
    """Return the image of a view composited on a background, and its mask, both in [0, 1]."""
    return _composite(view.image, view.mask, background)


def _composite(
    image: UInt8[Tensor, "*p 3"], mask: UInt8[Tensor, "*p"], background: Float[Tensor, "3"]
) -> tuple[Float[Tensor, "*p 3"], Float[Tensor, "*p"]]:
    """Do `composite_target` for some pixels of a view."""
    alpha = mask.float() / 255.0
    return image.float() / 255.0 * alpha[..., None] + (1.0 - alpha[..., None]) * background, alpha


def sampled_losses(
    vertices: Float[Tensor, "v 3"],
    skin: SkinnedTopology,
    view: PosedView,
    shader: Shader,
    background: Float[Tensor, "3"],
    lattice: tuple[int, int],
) -> tuple[Float[Tensor, ""], Float[Tensor, ""]]:
    """Render a part of the pixels of a view; return estimates of its colour loss and its silhouette loss.

    The colour loss is a multiple of the mean Huber loss of all pixels on the given background; like the silhouette
    loss, it is close to the mean absolute error for large errors. Both lack a constant: pixels that the mesh does not
    cover do not count. All pixels at silhouettes do, and of the others one of each `stride`, `stride` times.

    lattice: stride and phase; in all phases of a stride each pixel is used once.
    """
    stride, phase = lattice
    size = height, width = view.camera.height, view.camera.width
    rows, columns = torch.arange(height)[:, None], torch.arange(width)
    wanted = (columns + (1 if stride == 2 else 2) * rows + phase) % stride == 0
    topology = skin.faces, skin.adjacency
    drawn = render_pixels(*view.project_vertices(vertices, skin), topology, size, vertices, shader, wanted)
    pixels = view.image.reshape(-1, 3)[drawn.pixel], view.mask.reshape(-1)[drawn.pixel]
    target, mask = _composite(*pixels, background)
    alpha = drawn.values[:, -1]
    composited = drawn.values[:, :-1] + (1.0 - alpha[:, None]) * background
    weight = torch.where(drawn.at_silhouette, 1.0, float(stride)) / (height * width)
    error = torch.nn.functional.huber_loss(composited, target, delta=HUBER_DELTA, reduction="none").mean(1)
    return COLOUR_LOSS_SCALE * (weight * error).sum(), (weight * (alpha - mask).abs()).sum()


def accumulate_face_errors(
    mesh: Mesh, skin: SkinnedTopology, views: Sequence[PosedView], shader: Shader
) -> Float[np.ndarray, "f"]:
    """Return the image error of each face: the absolute colour difference on white, summed over channels and views."""
    vertices, white = torch.from_numpy(mesh.vertices), torch.ones(3)

    @torch.no_grad()
    def errors_of(view: PosedView) -> Float[np.ndarray, "f"]:
        image, alpha, face_id = render_posed_view(vertices, skin, view, shader)
        error = (image + (1.0 - alpha[..., None]) - composite_target(view, white)[0]).abs().sum(2)
        covered = face_id >= 0
        return np.bincount(face_id[covered].numpy(), error[covered].numpy(), minlength=len(mesh.faces))

    return np.sum(shared_thread_pool(torch.get_num_threads()).map(errors_of, views), axis=0)


def mesh_psnr_db(mesh: Mesh, skin: SkinnedTopology, views: Sequence[PosedView], shader: Shader) -> float:
    """Return the validation PSNR (dB) of the shaded mesh over whole crops; NaN without views."""
    vertices = torch.from_numpy(mesh.vertices)

    @torch.no_grad()
    def render(view: PosedView) -> UInt8[np.ndarray, "h w 3"]:
        image, alpha, _ = render_posed_view(vertices, skin, view, shader)
        return composite_premultiplied_on_white(torch.cat([image, alpha[..., None]], dim=2).numpy())

    renders = shared_thread_pool(torch.get_num_threads()).map(render, views)
    targets = [composite_on_white(view.image.numpy(), view.mask.numpy()) for view in views]
    return validation_psnr_db(renders, targets)


@torch.no_grad()
def silhouette_iou(mesh: Mesh, skin: SkinnedTopology, views: Sequence[PosedView]) -> float:
    """Return the intersection over union of rendered silhouettes and masks of all views, in [0, 1]; NaN without any."""
    if not views:
        return float("nan")
    intersection_px = union_px = 0
    vertices = torch.from_numpy(mesh.vertices)
    for view in views:
        projected, camera = view.project_vertices(vertices, skin), view.camera
        covered = rasterize(*projected, skin.faces, camera.height, camera.width)[0] >= 0
        mask = view.mask > 127
        intersection_px += int((covered & mask).sum())
        union_px += int((covered | mask).sum())
    return intersection_px / union_px if union_px else 0.0
