"""What rays see of a canonical field behind inverse skinning: one operation that goes no farther than the light.

It is what `pipeline.field.volume_rendering.look_at_all`, its plain twin, composes of march, Newton step, hash grid,
network and compositing. That asks the field for all samples, and three in five of these lie behind a surface. Here a
ray ends where less than `MIN_TRANSMITTANCE` is left, and what a few rays ask is in the cache while it is worked at.

Letters: n rays, k frames of the batch, s samples, p points, l levels, f features a level, w = l * f, h hidden units.
"""

from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np
import torch
from jaxtyping import Float, Int, UInt8
from torch import Tensor

from pipeline.kernels.hashgrid import FeatureGradients, GridLayout
from pipeline.kernels.hashgrid import cpu as hashgrid_cpu
from pipeline.kernels.inverse_skinning import SkinGrid, newton_cpu
from pipeline.kernels.march import PackedWarpGrids
from pipeline.kernels.volume_rendering import backward_cpu as trace_back_cpu
from pipeline.kernels.volume_rendering import cpu as trace_cpu

MIN_TRANSMITTANCE = 1e-3
"""Of a ray's light, below which what is behind is not asked for: a quarter of a grey level."""
GRADIENT_SUBSAMPLING_THRESHOLD = 0.3
"""Samples whose gradient is below this part of the mean one are thinned out: three in four of those that have any. What
that adds to the noise of a step's gradient is a ten-thousandth of its square (docs/decisions.md).
"""
INITIAL_SAMPLES_PER_RAY = 16
"""Samples that a ray has at first room for, on average."""


@dataclass(frozen=True)
class SamplingVolume:
    """What rays go through: the posed frames' way back to canonical space, and what may hold something there."""

    warps: PackedWarpGrids
    occupied: UInt8[Tensor, "gx gy gz"]
    bounds_m: Float[Tensor, "2 3"]

    def arrays(self) -> tuple[Any, ...]:
        """In the order that the loops take."""
        low_m, high_m = self.bounds_m
        per_m = torch.tensor(self.occupied.shape) / (high_m - low_m)
        tensors = (*self.warps.tensors(), self.occupied, low_m, per_m)
        return np.float32(self.warps.cell_m), *(tensor.contiguous().numpy() for tensor in tensors)


class BatchSkinning(NamedTuple):
    """Where a Newton step carries samples: `SkinGrid.blend` of the batch's k frames (`blended`), and which of these
    each ray belongs to, not falling.
    """

    skin: SkinGrid
    blended: Float[Tensor, "m k 12"]
    batch_index: Int[Tensor, "n"]

    def grid(self) -> tuple[Any, ...]:
        """In the order that the loops take."""
        return self.skin.origin_m.numpy(), np.float32(self.skin.cell_m), self.skin.row_of_node.numpy()


def _empty_skinning(rays: int) -> BatchSkinning:
    empty = torch.zeros(0, 3)
    empty_grid = SkinGrid(torch.zeros(3), 1.0, torch.zeros(0, 0, 0, dtype=torch.int32), empty, empty[:, 0], empty)
    return BatchSkinning(empty_grid, torch.zeros(0, 1, 12), torch.zeros(rays, dtype=torch.int64))


@dataclass(frozen=True)
class RadianceNetwork:
    """What is seen: relu(features hidden) output + bias, sigmoid for three colours; start_density * exp for the density
    (1/m), its exponent cut at plus and minus `exponent_limit`.
    """

    bounds_m: Float[Tensor, "2 3"]
    table: Float[Tensor, "rows f"]
    layout: GridLayout
    hidden: Float[Tensor, "w h"]
    output: Float[Tensor, "h 4"]
    bias: Float[Tensor, "4"]
    initial_density_per_m: float
    exponent_limit: float

    def arrays(self) -> tuple[Any, ...]:
        """In the order that the loops take."""
        tensors = [tensor.detach().numpy() for tensor in (self.table, self.hidden, self.output, self.bias)]
        scalars = np.float32(self.initial_density_per_m), np.float32(self.exponent_limit)
        return tensors[0], self.layout.level_params, *tensors[1:], *scalars


class RenderOutput(NamedTuple):
    """Premultiplied colour and alpha of the rays; density (1/m) of the points; and of the samples, in no order that
    means anything, the place where they were found, the light that reached them, their weight in their pixel.
    """

    image: Float[Tensor, "n 3"]
    alpha: Float[Tensor, "n"]
    density_per_m: Float[Tensor, "p"]
    canonical_m: Float[Tensor, "s 3"]
    transmittance: Float[Tensor, "s"]
    weight: Float[Tensor, "s"]


class _SampleBuffers(NamedTuple):
    """What is kept of samples; the rows of the points follow those of the samples."""

    ray: np.ndarray
    canonical_m: np.ndarray
    distance_m: np.ndarray
    inverse_jacobian: np.ndarray
    unit: np.ndarray
    features: np.ndarray
    colour: np.ndarray
    density: np.ndarray
    weight: np.ndarray
    transmittance: np.ndarray

    @staticmethod
    def capacity(rows: int, width: int) -> "_SampleBuffers":
        """Nothing yet."""
        columns = (3, 0, 9, 3, width, 3, 0, 0, 0)
        arrays = (np.empty((rows, *([count] if count else [])), np.float32) for count in columns)
        return _SampleBuffers(np.empty(rows, np.int32), *arrays)


class _RenderRays(torch.autograd.Function):
    @staticmethod
    def forward(
        ctx: Any, hidden: Tensor, output: Tensor, bias: Tensor, blended: Tensor, scene: "_RenderInputs"
    ) -> RenderOutput:
        samples, count, image, final_transmittance = scene.forward_pass(blended.detach().numpy())
        ctx.kept = scene, samples, count, final_transmittance
        ctx.save_for_backward(blended)
        seen = [
            torch.from_numpy(array[:count]) for array in (samples.canonical_m, samples.transmittance, samples.weight)
        ]
        ctx.mark_non_differentiable(*seen)
        density = torch.from_numpy(samples.density[count : count + len(scene.points_m)].copy())
        return RenderOutput(torch.from_numpy(image), torch.from_numpy(1 - final_transmittance), density, *seen)

    @staticmethod
    def backward(ctx: Any, *gradients: Tensor) -> tuple[Tensor | None, ...]:
        (blended,) = ctx.saved_tensors
        scene, samples, count, final_transmittance = ctx.kept
        grad_image, grad_alpha, grad_density = (gradient.contiguous().numpy() for gradient in gradients[:3])
        rows = count + len(grad_density)
        raw = np.zeros((rows, 4), np.float32)
        shown = (
            array[:count]
            for array in (samples.ray, samples.colour, samples.density, samples.weight, samples.transmittance)
        )
        trace_back_cpu.network_output_gradients(*shown, scene.step_m, final_transmittance, grad_image, grad_alpha, raw)
        raw[count:, 3] = grad_density * samples.density[count:rows]
        total = torch.zeros_like(blended)
        grad_hidden_weights, grad_output_weights = scene.backward_pass(samples, count, raw, total.numpy())
        return (
            torch.from_numpy(grad_hidden_weights),
            torch.from_numpy(grad_output_weights),
            torch.from_numpy(raw.sum(0)),
            total,
            None,
        )


@dataclass(frozen=True)
class _RenderInputs:
    """All that a trace does not move, as the loops take it."""

    rays: tuple[np.ndarray, ...]
    space: tuple[Any, ...]
    skin: tuple[Any, ...]
    radiance: RadianceNetwork
    points_m: Tensor
    step_m: np.float32
    max_samples: int
    min_transmittance: np.float32
    subsampling_threshold: float
    feature_gradients: FeatureGradients

    def forward_pass(self, blended: np.ndarray) -> tuple[_SampleBuffers, int, np.ndarray, np.ndarray]:
        """Forward: samples, how many, image (n, 3), light that is left (n)."""
        rays, radiance = len(self.rays[0]), self.radiance
        capacity, lanes, bounds = (
            INITIAL_SAMPLES_PER_RAY * rays + trace_cpu.MAX_SAMPLES_PER_PASS,
            radiance.layout.lanes,
            radiance.bounds_m.numpy(),
        )
        count = -1
        while count < 0:
            image, final_transmittance = np.zeros((rays, 3), np.float32), np.ones(rays, np.float32)
            samples = _SampleBuffers.capacity(capacity + len(self.points_m), len(radiance.hidden))
            count = trace_cpu.trace(
                *self.rays,
                self.step_m,
                self.max_samples,
                self.min_transmittance,
                *self.space,
                *self.skin,
                blended,
                bounds,
                *radiance.arrays(),
                lanes,
                image,
                final_transmittance,
                capacity,
                *samples,
            )
            capacity *= 2
        last = count + len(self.points_m)
        unit = (self.points_m - radiance.bounds_m[0]) / (radiance.bounds_m[1] - radiance.bounds_m[0])
        samples.unit[count:last] = unit.numpy()
        shaded = (samples.features, samples.colour, samples.density)
        trace_cpu.evaluate_field(count, last, samples.unit, *radiance.arrays(), *shaded, lanes)
        return samples, count, image, final_transmittance

    def backward_pass(
        self, samples: _SampleBuffers, count: int, raw: np.ndarray, grad_blended: np.ndarray
    ) -> tuple[np.ndarray, np.ndarray]:
        """Backward from what the network put out: gradients of hidden and output; adds to that of the matrices."""
        table, level_params, hidden, output = self.radiance.arrays()[:4]
        rows, scaled = trace_back_cpu.subsample_gradients(raw, self.subsampling_threshold)
        grad_hidden_weights, grad_output_weights = np.zeros_like(hidden), np.zeros_like(output)
        grad_features, positions = np.empty((len(rows), len(hidden)), np.float32), samples.unit[rows]
        trace_back_cpu.network(
            rows, scaled, samples.features, hidden, output, grad_hidden_weights, grad_output_weights, grad_features
        )
        self.feature_gradients.append((torch.from_numpy(positions), torch.from_numpy(grad_features)))
        ray_row_count = np.searchsorted(rows, count)
        if len(grad_blended) and ray_row_count:
            grad_unit = np.zeros((ray_row_count, 3), np.float32)
            moved = (
                positions[:ray_row_count],
                table,
                level_params,
                grad_features[:ray_row_count],
                grad_unit,
                self.radiance.layout.lanes,
            )
            hashgrid_cpu.add_points_gradient(*moved)
            extent_m = (self.radiance.bounds_m[1] - self.radiance.bounds_m[0]).numpy()
            selected = rows[:ray_row_count]
            frame_offsets = np.searchsorted(self.rays[3][samples.ray[selected]], np.arange(grad_blended.shape[1] + 1))
            sample_arrays = samples.canonical_m[selected], samples.inverse_jacobian[selected], grad_unit / extent_m
            newton_cpu.add_pose_gradient(*sample_arrays, frame_offsets, *self.skin, grad_blended)
        return grad_hidden_weights, grad_output_weights


def trace(
    origins_m: Float[Tensor, "n 3"],
    directions: Float[Tensor, "n 3"],
    frame: Int[Tensor, "n"],
    jitter: Float[Tensor, "n"],
    space: SamplingVolume,
    radiance: RadianceNetwork,
    skinning: BatchSkinning | None,
    points_m: Float[Tensor, "p 3"],
    step_m: float,
    max_samples: int,
    feature_gradients: FeatureGradients,
    min_transmittance: float = MIN_TRANSMITTANCE,
    subsampling_threshold: float = GRADIENT_SUBSAMPLING_THRESHOLD,
) -> RenderOutput:
    """What rays see, given in the posed space of their frame, and the field's density at some more canonical points.

    float32 on the CPU. Differentiable in the network and the matrices; backward appends to `feature_gradients` what
    `add_table_gradient_` needs.

    Args:
        frame: row of the warp grids that each ray belongs to.
        jitter: in [0, 1), the part of a step by which a ray's stops are shifted.
        skinning: None: samples lie where the warp grids say.
        max_samples: of a ray; those farther back are dropped.
        least_light: 0: nothing is left out. thinning: 0: each sample has its own gradient.
    """
    skinning = skinning or _empty_skinning(len(frame))
    rays = tuple(tensor.contiguous().numpy() for tensor in (origins_m, directions, frame, skinning.batch_index, jitter))
    scene = _RenderInputs(
        rays,
        space.arrays(),
        skinning.grid(),
        radiance,
        points_m.detach(),
        np.float32(step_m),
        max_samples,
        np.float32(min_transmittance),
        subsampling_threshold,
        feature_gradients,
    )
    network = (radiance.hidden, radiance.output, radiance.bias)
    return RenderOutput(*_RenderRays.apply(*network, skinning.blended.contiguous(), scene))
