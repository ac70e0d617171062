"""The diffuse texture, baked from the video: depth-tested projection, then refinement of what the texture predicts.

Letters: T texture, I_n frame n, R_n(T) the picture that T gives in the pose of frame n.
A first texture is the weighted mean of what the frames show. Poses err by some pixels, so this mean is blurred but
stands at the right place. Every round then moves each frame onto R_n(T) by optical flow and adds the weighted mean of
the residual I_n - R_n(T) to T: alignment against the model instead of between frames (Zhou and Koltun, "Color map
optimization", 2014), and back-projection, which also undoes the blur of the pixels' own size (Irani and Peleg, 1991).
"""

from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Float, Int
from pydantic import Field
from torch import Tensor

from pipeline.core.config import Config
from pipeline.core.progress import track
from pipeline.geometry.atlas import Atlas, Texels, fill_unknown_texels
from pipeline.geometry.camera import pixel_footprint_m, project
from pipeline.geometry.texture_rendering import render_textured
from pipeline.kernels.texel_projection import project_texels
from pipeline.metrics.images import (
    composite_on_white,
    composite_premultiplied_on_white,
    foreground_mask,
    validation_psnr_db,
)
from pipeline.texture.views import BakeView, align_to_render, pixel_confidence, render_depth

HALF_CONFIDENCE_WEIGHT_RATIO = 0.1
"""A texel with this share of the median sum of weights is half its own, half filled: of the texels below it on a real
video a tenth hold the backdrop's colour, of the well seen ones a thousandth."""

InpaintFunction = Callable[[Float[np.ndarray, "t 3"], Float[np.ndarray, "t"]], Float[np.ndarray, "t 3"]]


class BakeConfig(Config):
    """Options of the bake."""

    cosine_power: float = Field(
        2.0, ge=0.0, le=16.0, description="weight of a view: the cosine between normal and view to this power"
    )
    silhouette_falloff_m: float = Field(
        0.012, gt=0.0, le=0.2, description="trust grows from 0 to 1 over this distance from a silhouette, m"
    )
    depth_tolerance_m: float = Field(
        0.01, gt=0.0, le=0.2, description="depth difference up to which a texel is visible, m"
    )
    rounds: int = Field(3, ge=0, le=20, description="rounds of aligning frames and adding their residuals")
    flow_smoothing_sigma_m: float = Field(
        0.01, ge=0.0, le=0.2, description="standard deviation of the blur of the alignment, m"
    )
    max_flow_m: float = Field(
        0.03, ge=0.0, le=0.5, description="frames are moved by at most this much, m; 0 aligns nothing"
    )
    geman_mcclure_scale: float = Field(
        0.3, gt=0.0, le=2.0, description="residual (sRGB, 0 to 1) at which a pixel counts a quarter of a right one"
    )


@dataclass(frozen=True)
class TexturedSurface:
    """A mesh with its atlas: what the texture is painted on."""

    faces: Int[Tensor, "f 3"]
    faces_uv: Int[Tensor, "f 3"]
    uv: Float[Tensor, "t 2"]
    texels: Texels

    @staticmethod
    def from_arrays(faces: Int[np.ndarray, "f 3"], atlas: Atlas, texels: Texels) -> "TexturedSurface":
        """Torch copies of the arrays."""
        tensors = [torch.from_numpy(array) for array in (faces, atlas.faces_uv, atlas.uv)]
        return TexturedSurface(tensors[0], tensors[1], tensors[2], texels)


@dataclass
class WeightedMean:
    """Weighted mean of colours over frames, summed frame by frame."""

    total: Float[Tensor, "t c"]
    weight: Float[Tensor, "t"]

    @staticmethod
    def empty(count: int, channels: int = 3) -> "WeightedMean":
        """Nothing seen yet."""
        return WeightedMean(torch.zeros(count, channels), torch.zeros(count))

    def add(self, values: Float[Tensor, "t c"], weight: Float[Tensor, "t"]) -> None:
        """One frame's values."""
        self.total += values * weight[:, None]
        self.weight += weight

    def value(self) -> Float[Tensor, "t c"]:
        """The mean; 0 where nothing was seen."""
        return self.total / self.weight.clamp(min=1e-6)[:, None]


def observe(
    view: BakeView,
    surface: TexturedSurface,
    picture: Float[np.ndarray, "h w c"],
    pixel_weights: Float[np.ndarray, "h w"],
    depth_m: Float[Tensor, "h w"],
    config: BakeConfig,
) -> tuple[Float[Tensor, "t c"], Float[Tensor, "t"]]:
    """What a picture over a view says about every texel, and with which weight."""
    vertices_px, vertex_depth_m = project(view.vertices_world, view.camera)
    texels = surface.texels
    values, seen = project_texels(
        vertices_px,
        vertex_depth_m,
        view.view_cosine,
        surface.faces,
        torch.from_numpy(texels.face),
        torch.from_numpy(texels.barycentric),
        torch.from_numpy(np.ascontiguousarray(picture)),
        depth_m,
        torch.from_numpy(pixel_weights),
        config.depth_tolerance_m,
    )
    return values, seen[:, 0] * seen[:, 1] ** config.cosine_power * view.weight


def average_views(views: Iterable[BakeView], surface: TexturedSurface, config: BakeConfig) -> WeightedMean:
    """Weighted mean of what all views show, unaligned."""
    mean = WeightedMean.empty(len(surface.texels.face))
    for view in views:
        depth_m = render_depth(view, surface.faces)
        pixel_weights = pixel_confidence(
            view.mask,
            depth_m.numpy(),
            config.silhouette_falloff_m / pixel_footprint_m(view.vertices_world, view.camera),
        )
        mean.add(*observe(view, surface, view.image.astype(np.float32) / 255.0, pixel_weights, depth_m, config))
    return mean


def average_residuals(
    texture: Float[np.ndarray, "s s 3"], views: Iterable[BakeView], surface: TexturedSurface, config: BakeConfig
) -> WeightedMean:
    """Weighted mean of what the aligned views show more than the texture does."""
    mean = WeightedMean.empty(len(surface.texels.face))
    for view in views:
        rendered, pixel_m = (
            render_textured_view(texture, view, surface),
            pixel_footprint_m(view.vertices_world, view.camera),
        )
        warped, warped_mask = align_to_render(
            view, rendered, config.flow_smoothing_sigma_m / pixel_m, config.max_flow_m / pixel_m
        )
        depth_m = render_depth(view, surface.faces)
        pixel_weights = pixel_confidence(warped_mask, depth_m.numpy(), config.silhouette_falloff_m / pixel_m)
        residual = warped - rendered[..., :3] / np.maximum(rendered[..., 3:], 1e-3)
        pixel_weights /= (1.0 + (np.linalg.norm(residual, axis=2) / config.geman_mcclure_scale) ** 2) ** 2
        mean.add(*observe(view, surface, residual, pixel_weights, depth_m, config))
    return mean


def render_textured_view(
    texture: Float[np.ndarray, "s s 3"], view: BakeView, surface: TexturedSurface
) -> Float[np.ndarray, "h w 4"]:
    """The textured mesh in a view's pose: premultiplied colour and alpha."""
    return render_textured(
        view.vertices_world,
        surface.faces,
        surface.faces_uv,
        surface.uv,
        torch.from_numpy(texture),
        view.camera,
        supersampling=2,
    ).numpy()


def bake_diffuse(
    views: Sequence[BakeView], surface: TexturedSurface, inpaint: InpaintFunction, config: BakeConfig
) -> tuple[Float[np.ndarray, "s s 3"], Float[np.ndarray, "t"]]:
    """The diffuse texture (sRGB, gutters filled), and how well every texel was seen, in [0, 1].

    fill: colours for all texels from those of the first mean and how well they were seen, for those that were not.
    """
    first = average_views(track(views, "texture: first mean"), surface, config)
    half_confidence_weight = (
        HALF_CONFIDENCE_WEIGHT_RATIO * float(first.weight[first.weight > 0].median())
        if bool(first.weight.any())
        else 1.0
    )
    seen = weight_confidence(first.weight, half_confidence_weight)
    fallback = torch.from_numpy(inpaint(first.value().numpy(), seen.numpy()))
    colour = torch.lerp(fallback, first.value(), seen[:, None])
    for number in range(config.rounds):
        texture = texels_to_texture(colour, surface.texels)
        label = f"texture: round {number + 1}/{config.rounds}"
        mean_residual = average_residuals(texture, track(views, label, total=len(views)), surface, config)
        residual_confidence = weight_confidence(mean_residual.weight, half_confidence_weight)[:, None]
        colour = (colour + residual_confidence * mean_residual.value()).clamp(0.0, 1.0)
    return texels_to_texture(colour, surface.texels), seen.numpy()


def weight_confidence(weight: Float[Tensor, "t"], half_confidence_weight: float) -> Float[Tensor, "t"]:
    """How far a sum of weights is to be believed: 0 for none, 1/2 at `half_confidence_weight`, 1 for many."""
    return weight**2 / (weight**2 + half_confidence_weight**2)


def texels_to_texture(colour: Float[Tensor, "t c"], texels: Texels) -> Float[np.ndarray, "s s c"]:
    """Texel colours (or other values) as a texture with filled gutters."""
    return fill_unknown_texels(texels.to_texture(colour.numpy()), texels.coverage_mask())


def mean_foreground_psnr_db(
    texture: Float[np.ndarray, "s s 3"], views: Sequence[BakeView], surface: TexturedSurface
) -> float:
    """Mean over views of the PSNR on the person's pixels, both laid on white; nan without views."""
    renders = [composite_premultiplied_on_white(render_textured_view(texture, view, surface)) for view in views]
    targets = [composite_on_white(view.image, view.mask) for view in views]
    return validation_psnr_db(renders, targets, [foreground_mask(view.mask) for view in views])
