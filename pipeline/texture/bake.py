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
from pipeline.geometry.atlas import Atlas, Texels, fill_gaps
from pipeline.geometry.camera import project
from pipeline.geometry.texture_rendering import render_textured
from pipeline.kernels.texel_projection import observe_texels
from pipeline.metrics.images import body_pixels, on_white, premultiplied_on_white, psnr_db
from pipeline.texture.views import View, align, footprint_m, pixel_trust, seen_depth

ENOUGH_SHARE = 0.1
"""A texel with this share of the median sum of weights is half its own, half filled: of the texels below it on a real
video a tenth hold the backdrop's colour, of the well seen ones a thousandth."""

Fill = Callable[[Float[np.ndarray, "t 3"], Float[np.ndarray, "t"]], Float[np.ndarray, "t 3"]]


class BakeConfig(Config):
    """Options of the bake."""

    cosine_power: float = Field(
        2.0, ge=0.0, le=16.0, description="weight of a view: the cosine between normal and view to this power"
    )
    edge_m: float = Field(
        0.012, gt=0.0, le=0.2, description="trust grows from 0 to 1 over this distance from a silhouette, m"
    )
    tolerance_m: float = Field(0.01, gt=0.0, le=0.2, description="depth difference up to which a texel is visible, m")
    rounds: int = Field(3, ge=0, le=20, description="rounds of aligning frames and adding their residuals")
    flow_smoothing_m: float = Field(
        0.01, ge=0.0, le=0.2, description="standard deviation of the blur of the alignment, m"
    )
    largest_flow_m: float = Field(
        0.03, ge=0.0, le=0.5, description="frames are moved by at most this much, m; 0 aligns nothing"
    )
    outlier: float = Field(
        0.3, gt=0.0, le=2.0, description="residual (sRGB, 0 to 1) at which a pixel counts a quarter of a right one"
    )


@dataclass(frozen=True)
class Surface:
    """A mesh with its atlas: what the texture is painted on."""

    faces: Int[Tensor, "f 3"]
    faces_uv: Int[Tensor, "f 3"]
    uv: Float[Tensor, "t 2"]
    texels: Texels

    @staticmethod
    def of(faces: Int[np.ndarray, "f 3"], atlas: Atlas, texels: Texels) -> "Surface":
        """Torch copies of the arrays."""
        tensors = [torch.from_numpy(array) for array in (faces, atlas.faces_uv, atlas.uv)]
        return Surface(tensors[0], tensors[1], tensors[2], texels)


@dataclass
class Mean:
    """Weighted mean of colours over frames, summed frame by frame."""

    total: Float[Tensor, "t c"]
    weight: Float[Tensor, "t"]

    @staticmethod
    def empty(count: int, channels: int = 3) -> "Mean":
        """Nothing seen yet."""
        return Mean(torch.zeros(count, channels), torch.zeros(count))

    def add(self, values: Float[Tensor, "t c"], weight: Float[Tensor, "t"]) -> None:
        """One frame's values."""
        self.total += values * weight[:, None]
        self.weight += weight

    def value(self) -> Float[Tensor, "t c"]:
        """The mean; 0 where nothing was seen."""
        return self.total / self.weight.clamp(min=1e-6)[:, None]


def observe(
    view: View,
    surface: Surface,
    picture: Float[np.ndarray, "h w c"],
    trust: Float[np.ndarray, "h w"],
    depth_m: Float[Tensor, "h w"],
    config: BakeConfig,
) -> tuple[Float[Tensor, "t c"], Float[Tensor, "t"]]:
    """What a picture over a view says about every texel, and with which weight."""
    vertices_px, vertex_depth_m = project(view.vertices_world, view.camera)
    texels = surface.texels
    values, seen = observe_texels(
        vertices_px,
        vertex_depth_m,
        view.cosine,
        surface.faces,
        torch.from_numpy(texels.face),
        torch.from_numpy(texels.barycentric),
        torch.from_numpy(np.ascontiguousarray(picture)),
        depth_m,
        torch.from_numpy(trust),
        config.tolerance_m,
    )
    return values, seen[:, 0] * seen[:, 1] ** config.cosine_power * view.weight


def first_texture(views: Iterable[View], surface: Surface, config: BakeConfig) -> Mean:
    """Weighted mean of what all views show, unaligned."""
    mean = Mean.empty(len(surface.texels.face))
    for view in views:
        depth_m = seen_depth(view, surface.faces)
        trust = pixel_trust(view.mask, depth_m.numpy(), config.edge_m / footprint_m(view))
        mean.add(*observe(view, surface, view.image.astype(np.float32) / 255.0, trust, depth_m, config))
    return mean


def residual_round(
    texture: Float[np.ndarray, "s s 3"], views: Iterable[View], surface: Surface, config: BakeConfig
) -> Mean:
    """Weighted mean of what the aligned views show more than the texture does."""
    mean = Mean.empty(len(surface.texels.face))
    for view in views:
        rendered, pixel_m = render_view(texture, view, surface), footprint_m(view)
        moved, moved_mask = align(view, rendered, config.flow_smoothing_m / pixel_m, config.largest_flow_m / pixel_m)
        depth_m = seen_depth(view, surface.faces)
        trust = pixel_trust(moved_mask, depth_m.numpy(), config.edge_m / pixel_m)
        residual = moved - rendered[..., :3] / np.maximum(rendered[..., 3:], 1e-3)
        trust /= (1.0 + (np.linalg.norm(residual, axis=2) / config.outlier) ** 2) ** 2
        mean.add(*observe(view, surface, residual, trust, depth_m, config))
    return mean


def render_view(texture: Float[np.ndarray, "s s 3"], view: View, surface: Surface) -> Float[np.ndarray, "h w 4"]:
    """The textured mesh in a view's pose: premultiplied colour and alpha."""
    return render_textured(
        view.vertices_world,
        surface.faces,
        surface.faces_uv,
        surface.uv,
        torch.from_numpy(texture),
        view.camera,
        samples=2,
    ).numpy()


def bake_diffuse(
    views: Sequence[View], surface: Surface, fill: Fill, config: BakeConfig
) -> tuple[Float[np.ndarray, "s s 3"], Float[np.ndarray, "t"]]:
    """The diffuse texture (sRGB, gutters filled), and how well every texel was seen, in [0, 1].

    fill: colours for all texels from those of the first mean and how well they were seen, for those that were not.
    """
    first = first_texture(track(views, "texture: first mean"), surface, config)
    enough = ENOUGH_SHARE * float(first.weight[first.weight > 0].median()) if bool(first.weight.any()) else 1.0
    seen = confidence(first.weight, enough)
    fallback = torch.from_numpy(fill(first.value().numpy(), seen.numpy()))
    colour = torch.lerp(fallback, first.value(), seen[:, None])
    for number in range(config.rounds):
        texture = paint(colour, surface.texels)
        label = f"texture: round {number + 1}/{config.rounds}"
        change = residual_round(texture, track(views, label, total=len(views)), surface, config)
        sure = confidence(change.weight, enough)[:, None]
        colour = (colour + sure * change.value()).clamp(0.0, 1.0)
    return paint(colour, surface.texels), seen.numpy()


def confidence(weight: Float[Tensor, "t"], enough: float) -> Float[Tensor, "t"]:
    """How far a sum of weights is to be believed: 0 for none, 1/2 at `enough`, 1 for many."""
    return weight**2 / (weight**2 + enough**2)


def paint(colour: Float[Tensor, "t c"], texels: Texels) -> Float[np.ndarray, "s s c"]:
    """Texel colours (or other values) as a texture with filled gutters."""
    return fill_gaps(texels.image(colour.numpy()), texels.covered())


def validation_psnr_db(texture: Float[np.ndarray, "s s 3"], views: Sequence[View], surface: Surface) -> float:
    """Mean over views of the PSNR on the person's pixels, both laid on white; nan without views."""
    values = []
    for view in views:
        rendered = premultiplied_on_white(render_view(texture, view, surface))
        values.append(psnr_db(rendered, on_white(view.image, view.mask), body_pixels(view.mask)))
    return float(np.mean(values)) if values else float("nan")
