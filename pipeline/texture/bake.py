"""Bake the diffuse texture from the video: depth-tested projection, then iterative refinement against renders.

Notation: T texture, I_n frame n, R_n(T) the render of T in the pose of frame n.

The initial texture is the weighted mean of all frames at each texel. It is blurred, because poses are wrong by a few
pixels, but unbiased in position. Each round warps every frame onto R_n(T) by optical flow and adds the weighted mean of
the residuals I_n - R_n(T) to T. This aligns frames to the model instead of to each other (Zhou and Koltun, "Color map
optimization", 2014), and back-projects residuals, which also removes the blur of the pixel footprint (Irani and Peleg,
"Improving resolution by image registration", 1991).
"""

from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np
import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from pipeline.core.progress import track
from pipeline.geometry.atlas import Atlas, Texels
from pipeline.geometry.camera import pixel_footprint_m, project
from pipeline.geometry.texture_rendering import apply_shading, render_textured
from pipeline.io.tensors import load_tensors, save_tensors
from pipeline.kernels.common.heap import trim_heap
from pipeline.kernels.common.opencv_threads import single_threaded_opencv
from pipeline.kernels.common.thread_pool import shared_thread_pool
from pipeline.kernels.raster import rasterize
from pipeline.kernels.texel_projection import (
    ImageView,
    ProjectedMesh,
    ProjectionWeights,
    TexelPoints,
    TexelSums,
    add_projections_,
    project_texels,
)
from pipeline.kernels.texture_sampling import supersample_attributes, supersample_texture
from pipeline.metrics.images import (
    composite_on_white,
    composite_premultiplied_on_white,
    foreground_mask,
    validation_psnr_db,
)
from pipeline.texture.edge_padding import dilate_known_texels, fill_unknown_texels
from pipeline.texture.settings import TextureSettings
from pipeline.texture.views import BakeView, align_to_render, pixel_confidence, remove_light

HALF_CONFIDENCE_WEIGHT_RATIO = 0.1
"""A texel whose weight sum is this fraction of the median is blended half and half with the inpainted colour. On a real
recording a tenth of the texels below it have the background's colour, and a thousandth of the well-observed ones."""

MIN_ROUND_VIEWS = 30
"""Of many views each round takes every second or third, others than the round before, but at least this many."""

MAX_ALBEDO = 1.2
"""sRGB; an albedo above 1 is an error of the light, and a limit keeps it from outweighing other frames."""

HIDING = 10.0
"""Weight of a highlight's radiance against the irradiance: one of 0.1 halves the irradiance that counts."""

InpaintFunction = Callable[[Float[np.ndarray, "t 3"], Float[np.ndarray, "t"]], Float[np.ndarray, "t 3"]]
"""Texel colours and their confidence in [0, 1] -> colours for all texels."""


@dataclass(frozen=True)
class TexturedSurface:
    """A mesh with its UV atlas and the surface point of every texel."""

    faces: Int[Tensor, "f 3"]
    faces_uv: Int[Tensor, "f 3"]
    uv: Float[Tensor, "t 2"]
    texels: Texels

    @staticmethod
    def from_arrays(faces: Int[np.ndarray, "f 3"], atlas: Atlas, texels: Texels) -> "TexturedSurface":
        """Convert numpy arrays to tensors that share their memory."""
        tensors = [torch.from_numpy(array) for array in (faces, atlas.faces_uv, atlas.uv)]
        return TexturedSurface(tensors[0], tensors[1], tensors[2], texels)


@dataclass
class WeightedMean:
    """Weighted mean of texel values over frames, accumulated frame by frame."""

    total: Float[Tensor, "t c"]
    weight: Float[Tensor, "t"]

    @staticmethod
    def empty(count: int, channels: int = 3) -> "WeightedMean":
        """Return the mean of no observations."""
        return WeightedMean(torch.zeros(count, channels), torch.zeros(count))

    def value(self) -> Float[Tensor, "t c"]:
        """Return the mean; 0 where the weight is 0."""
        return self.total / self.weight.clamp(min=1e-6)[:, None]


@dataclass(frozen=True)
class FrameValues:
    """Values in the pixels of a view, for the texels that are seen there.

    Attributes:
        mesh: the posed mesh in the pixels of the view.
        image: values of any number of channels, depth of the mesh, and confidence of each pixel in [0, 1].
        weight: of the view.
    """

    mesh: ProjectedMesh
    image: ImageView
    weight: float

    def at_texels(self, texels: Texels, settings: TextureSettings) -> tuple[Float[Tensor, "t c"], Float[Tensor, "t"]]:
        """Sample the values at the projection of every texel.

        Returns:
            The values, and their weights: 0 for hidden texels, else confidence * cosine^power * weight of the view.
        """
        values, seen = project_texels(self.mesh, _points(texels), self.image, settings.depth_tolerance_m)
        return values, seen[:, 0] * seen[:, 1] ** settings.cosine_power * self.weight

    def add_to(self, mean: WeightedMean, texels: Texels, settings: TextureSettings) -> None:
        """Add what `at_texels` returns to a mean."""
        weights = ProjectionWeights(self.weight, settings.cosine_power, settings.depth_tolerance_m)
        add_projections_(TexelSums(mean.total, mean.weight), self.mesh, _points(texels), self.image, weights)


def _points(texels: Texels) -> TexelPoints:
    return TexelPoints(torch.from_numpy(texels.face), torch.from_numpy(texels.barycentric))


def sample_frame_colours(
    view: BakeView, surface: TexturedSurface, settings: TextureSettings
) -> tuple[Float[Tensor, "t 3"], Float[Tensor, "t"]]:
    """Sample the colours of `frame_colours` at every texel; see `FrameValues.at_texels`."""
    return frame_colours(view, surface, settings).at_texels(surface.texels, settings)


def frame_colours(view: BakeView, surface: TexturedSurface, settings: TextureSettings) -> FrameValues:
    """Return the unaligned colours (sRGB) of a view, or albedos (at most `MAX_ALBEDO`) if its shading is known."""
    vertices_px, vertex_depth_m = project(view.vertices_world, view.camera)
    face_id, barycentric, depth_m = rasterize(
        vertices_px, vertex_depth_m, surface.faces, view.camera.height, view.camera.width
    )
    falloff_px = settings.silhouette_falloff_m / pixel_footprint_m(view.vertices_world, view.camera)
    pixel_weights = pixel_confidence(view.mask, depth_m.numpy(), falloff_px)
    image = view.image.astype(np.float32) / 255.0
    if view.shading is not None:
        used = _used_pixels(pixel_weights)
        shading = supersample_attributes(face_id, barycentric, surface.faces, view.shading, 1)
        shading[face_id < 0] = 1.0
        shading = shading[torch.from_numpy(used)]
        image[used] = np.minimum(remove_light(image[used], shading.numpy()), MAX_ALBEDO)
        pixel_weights[used] *= light_confidence(shading).numpy()
    mesh = ProjectedMesh(vertices_px, vertex_depth_m, view.view_cosine, surface.faces)
    return FrameValues(mesh, ImageView(torch.from_numpy(image), depth_m, torch.from_numpy(pixel_weights)), view.weight)


def _used_pixels(weights: Float[np.ndarray, "h w"]) -> Bool[np.ndarray, "h w"]:
    """Return the pixels that bilinear samples with weight contain: also those without weight next to one with."""
    return np.asarray(cv2.dilate(weights, np.ones((3, 3), np.uint8)) > 0)


def light_confidence(shading: Float[Tensor, "*n d"]) -> Float[Tensor, "*n"]:
    """Return the weight of an albedo that was seen under this shading: about the inverse variance, at most 1.

    Noise of the image and errors of the light are divided by the irradiance; a highlight hides the albedo.
    """
    irradiance, highlight = shading[..., :3].mean(dim=-1), shading[..., 3:].sum(dim=-1)
    return irradiance.clamp(max=1.0) ** 2 * (irradiance / (irradiance + HIDING * highlight)) ** 2


def average_views(views: Iterable[BakeView], surface: TexturedSurface, settings: TextureSettings) -> WeightedMean:
    """Return the weighted mean colour of each texel over all views, without alignment."""
    return _mean_of_views(lambda view: frame_colours(view, surface, settings), views, surface, settings)


def _mean_of_views(
    values_of: Callable[[BakeView], FrameValues],
    views: Iterable[BakeView],
    surface: TexturedSurface,
    settings: TextureSettings,
) -> WeightedMean:
    """Return the weighted mean of values of the views: several views at a time are made, then added in their order."""
    trim_heap()
    mean, pool = WeightedMean.empty(len(surface.texels.face)), shared_thread_pool(torch.get_num_threads())
    with single_threaded_opencv():
        for frame in pool.imap(values_of, views):
            frame.add_to(mean, surface.texels, settings)
    return mean


def average_residuals(
    texture: Float[np.ndarray, "s s 3"],
    views: Iterable[BakeView],
    surface: TexturedSurface,
    settings: TextureSettings,
) -> WeightedMean:
    """Return the weighted mean over views of the residual between aligned view and render, at each texel.

    texture: sRGB in [0, 1]. Residuals are down-weighted by the Geman-McClure function.
    """
    return _mean_of_views(lambda view: frame_residuals(texture, view, surface, settings), views, surface, settings)


def frame_residuals(
    texture: Float[np.ndarray, "s s 3"], view: BakeView, surface: TexturedSurface, settings: TextureSettings
) -> FrameValues:
    """Return the residual between an aligned view and the render of the texture, with its weights."""
    drawn = draw_view(texture, view, surface)
    pixel_m = pixel_footprint_m(view.vertices_world, view.camera)
    warped, warped_mask = align_to_render(
        view, drawn.lit, settings.flow_smoothing_sigma_m / pixel_m, settings.max_flow_m / pixel_m
    )
    weights = pixel_confidence(warped_mask, drawn.depth_m.numpy(), settings.silhouette_falloff_m / pixel_m)
    used = _used_pixels(weights)
    colour, alpha = warped[used], np.maximum(drawn.lit[used][:, 3:], 1e-3)
    residual = colour - drawn.lit[used][:, :3] / alpha
    robust = 1.0 / (1.0 + (np.linalg.norm(residual, axis=1) / settings.geman_mcclure_scale) ** 2) ** 2
    if drawn.shading is not None:
        shading = drawn.shading[used]
        residual = remove_light(colour, shading) - drawn.unlit[used][:, :3] / alpha
        robust *= light_confidence(torch.from_numpy(shading)).numpy()
    weights[used] *= robust
    residuals = np.zeros((*weights.shape, 3), dtype=np.float32)
    residuals[used] = residual
    mesh = ProjectedMesh(*project(view.vertices_world, view.camera), view.view_cosine, surface.faces)
    return FrameValues(
        mesh, ImageView(torch.from_numpy(residuals), drawn.depth_m, torch.from_numpy(weights)), view.weight
    )


@dataclass(frozen=True)
class DrawnView:
    """Render of a texture in the pose and light of a view.

    Attributes:
        unlit, lit: premultiplied sRGB and coverage, in [0, 1]; the same for a view without shading.
        shading: of each pixel, see `BakeView`; 1 outside the mesh.
        depth_m: at the pixel centres; inf outside the mesh.
    """

    unlit: Float[np.ndarray, "h w 4"]
    lit: Float[np.ndarray, "h w 4"]
    shading: Float[np.ndarray, "h w d"] | None
    depth_m: Float[Tensor, "h w"]


def draw_view(texture: Float[np.ndarray, "s s 3"], view: BakeView, surface: TexturedSurface) -> DrawnView:
    """Render the textured mesh in the pose and light of a view, one sample a pixel."""
    vertices_px, vertex_depth_m = project(view.vertices_world, view.camera)
    face_id, barycentric, depth_m = rasterize(
        vertices_px, vertex_depth_m, surface.faces, view.camera.height, view.camera.width
    )
    unlit = supersample_texture(face_id, barycentric, surface.faces_uv, surface.uv, torch.from_numpy(texture), 1)
    if view.shading is None:
        return DrawnView(unlit.numpy(), unlit.numpy(), None, depth_m)
    shading = supersample_attributes(face_id, barycentric, surface.faces, view.shading, 1)
    shading[face_id < 0] = 1.0
    return DrawnView(unlit.numpy(), apply_shading(unlit, shading).numpy(), shading.numpy(), depth_m)


def render_textured_view(
    texture: Float[np.ndarray, "s s 3"], view: BakeView, surface: TexturedSurface
) -> Float[np.ndarray, "h w 4"]:
    """Render the textured mesh in the pose and light of a view: premultiplied colour and alpha, in [0, 1]."""
    return render_textured(
        view.vertices_world,
        surface.faces,
        surface.faces_uv,
        surface.uv,
        torch.from_numpy(texture),
        view.camera,
        supersampling=2,
        shading=view.shading,
    ).numpy()


@dataclass(frozen=True)
class InitialTexels:
    """Where the rounds start.

    Attributes:
        colour: mean of the frames, inpainted where few frames show the texel.
        confidence: of each texel, in [0, 1].
        half_confidence_weight: weight sum of a texel of confidence 1/2.
    """

    colour: Float[Tensor, "t 3"]
    confidence: Float[Tensor, "t"]
    half_confidence_weight: float

    def save(self, path: Path) -> None:
        """Write the texels as a checkpoint."""
        tensors = {"colour": self.colour, "confidence": self.confidence}
        save_tensors(path, tensors, {"half_confidence_weight": self.half_confidence_weight})

    @staticmethod
    def load(path: Path) -> "InitialTexels":
        """Read what `save` wrote; UserError if the file is damaged."""
        tensors, numbers = load_tensors(path)
        return InitialTexels(tensors["colour"].clone(), tensors["confidence"].clone(), **numbers)


def mean_texels(
    views: Sequence[BakeView], surface: TexturedSurface, inpaint: InpaintFunction, settings: TextureSettings
) -> InitialTexels:
    """Return the mean of the frames at each texel; see `bake_diffuse`."""
    initial = average_views(track(views, "texture: initial mean"), surface, settings)
    half_confidence_weight = (
        HALF_CONFIDENCE_WEIGHT_RATIO * float(initial.weight[initial.weight > 0].median())
        if bool(initial.weight.any())
        else 1.0
    )
    confidence = weight_confidence(initial.weight, half_confidence_weight)
    inpainted = torch.from_numpy(inpaint(initial.value().numpy(), confidence.numpy()))
    colour = torch.lerp(inpainted, initial.value(), confidence[:, None]).clamp(0.0, 1.0)
    return InitialTexels(colour, confidence, half_confidence_weight)


def bake_diffuse(
    views: Sequence[BakeView],
    surface: TexturedSurface,
    inpaint: InpaintFunction,
    rounds: int,
    settings: TextureSettings,
    checkpoint: Path | None = None,
) -> tuple[Float[np.ndarray, "s s 3"], Float[np.ndarray, "t"]]:
    """Bake the diffuse texture.

    Args:
        views: training frames.
        surface: mesh, atlas and texels.
        inpaint: gives colours for all texels from the initial mean and its confidence; used where confidence is low.
        rounds: of alignment and residual back-projection; 0 returns the initial mean.
        settings: see `TextureSettings`.
        checkpoint: file of the initial mean, from which an interrupted run of the same inputs continues; None: none.

    Returns:
        The texture (sRGB in [0, 1], gutters filled), and the confidence of every texel in [0, 1].
    """
    if checkpoint is not None and checkpoint.exists():
        initial = InitialTexels.load(checkpoint)
    else:
        initial = mean_texels(views, surface, inpaint, settings)
        if checkpoint is not None:
            initial.save(checkpoint)
    colour = initial.colour
    parts = max(1, min(rounds, len(views) // MIN_ROUND_VIEWS))
    for number in range(rounds):
        label, part = f"texture: round {number + 1}/{rounds}", views[number % parts :: parts]
        half = initial.half_confidence_weight * len(part) / len(views)
        colour = _add_residuals(colour, half, track(part, label, total=len(part)), surface, settings)
    return texels_to_texture(colour, surface.texels), initial.confidence.numpy()


def _add_residuals(
    colour: Float[Tensor, "t 3"],
    half_confidence_weight: float,
    views: Iterable[BakeView],
    surface: TexturedSurface,
    settings: TextureSettings,
) -> Float[Tensor, "t 3"]:
    """Return the texels with the mean residuals of the views added, as far as these are confident."""
    residual = average_residuals(texels_to_texture(colour, surface.texels, is_final=False), views, surface, settings)
    gain = weight_confidence(residual.weight, half_confidence_weight)[:, None]
    return residual.value().mul_(gain).add_(colour).clamp_(0.0, 1.0)


def weight_confidence(weight: Float[Tensor, "t"], half_confidence_weight: float) -> Float[Tensor, "t"]:
    """Map weight sums to confidence in [0, 1): 0 at 0, 1/2 at `half_confidence_weight`."""
    return weight**2 / (weight**2 + half_confidence_weight**2)


def texels_to_texture(
    colour: Float[Tensor, "t c"], texels: Texels, *, is_final: bool = True
) -> Float[np.ndarray, "s s c"]:
    """Write texel values into a texture and fill its gutters; those of a final one for mip levels, too."""
    trim_heap()
    fill = fill_unknown_texels if is_final else dilate_known_texels
    return fill(texels.to_texture(colour.numpy()), texels.coverage_mask())


def mean_foreground_psnr_db(
    texture: Float[np.ndarray, "s s 3"], views: Sequence[BakeView], surface: TexturedSurface
) -> float:
    """Return the mean over views of the foreground PSNR, render and frame composited on white; nan without views."""
    renders = shared_thread_pool(torch.get_num_threads()).imap(
        lambda view: composite_premultiplied_on_white(render_textured_view(texture, view, surface)), views
    )
    targets = (composite_on_white(view.image, view.mask) for view in views)
    return validation_psnr_db(renders, targets, (foreground_mask(view.mask) for view in views))
