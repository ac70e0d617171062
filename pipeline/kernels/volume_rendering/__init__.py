"""Fused volume renderer: rays through a canonical radiance field behind inverse skinning, with early termination.

The plain composition of march, Newton step, hash grid, network and compositing (`reference`) evaluates all samples, of
which about three in five are behind a surface. The fused loop ends a ray at `MIN_TRANSMITTANCE`, and the working set of
a block of rays stays in the cache.

Notation: n rays, k frames of a batch, s samples, p points, w features of a point, h hidden units.
"""

import threading
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, Protocol

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from pipeline.kernels.common.dispatch import runs_on_cuda
from pipeline.kernels.hashgrid import FeatureGradients
from pipeline.kernels.march import Rays, SamplingVolume
from pipeline.kernels.march.cpu import MarchArrays, RayArrays
from pipeline.kernels.volume_rendering import backward_cpu, cpu
from pipeline.kernels.volume_rendering.backward_cpu import OutputGradientArrays, ParameterGradients
from pipeline.kernels.volume_rendering.cpu import RenderArrays, SampleBuffers
from pipeline.kernels.volume_rendering.inputs import (
    MIN_TRANSMITTANCE,
    BatchSkinning,
    OutputGradients,
    RadianceNetwork,
    RenderGradients,
    RenderOutput,
    RenderSettings,
)

__all__ = [
    "MIN_TRANSMITTANCE",
    "BatchSkinning",
    "OutputGradients",
    "RadianceNetwork",
    "RenderGradients",
    "RenderOutput",
    "RenderSettings",
    "render_rays_fused",
    "render_rays_with_gradients",
]

INITIAL_SAMPLES_PER_RAY = 16
"""Mean number of samples of a ray that memory is first allocated for; doubled until it is sufficient."""


def render_rays_fused(
    rays: Rays,
    volume: SamplingVolume,
    network: RadianceNetwork,
    skinning: BatchSkinning | None,
    points_m: Float[Tensor, "p 3"],
    settings: RenderSettings,
    feature_gradients: FeatureGradients,
) -> RenderOutput:
    """Render rays, and evaluate the density at additional canonical points.

    float32, on the CPU or on a CUDA GPU. Differentiable in the weights and the gate of the network and in
    `skinning.canonical_to_posed`; the backward pass appends the input of `add_table_gradient_` to `feature_gradients`.

    Args:
        rays: sorted by `skinning.batch_index`.
        skinning: None: no Newton step, samples stay where the warp grids put them.
        points_m: canonical points whose density is evaluated, in the box of the network.
    """
    renderer = _renderer(rays, volume, network, skinning, points_m, settings, reuse_buffers=False)
    matrices = skinning.canonical_to_posed if skinning else None
    weights = (network.hidden, network.output, network.bias, network.gate)
    return RenderOutput(*_RenderRays.apply(*weights, matrices, renderer, feature_gradients))


def render_rays_with_gradients(
    rays: Rays,
    volume: SamplingVolume,
    network: RadianceNetwork,
    skinning: BatchSkinning | None,
    points_m: Float[Tensor, "p 3"],
    settings: RenderSettings,
    output_gradients: Callable[[Tensor, Tensor, Tensor], OutputGradients],
) -> tuple[RenderOutput, RenderGradients, FeatureGradients]:
    """Do `render_rays_fused` and its backward pass without autograd, which costs as much as a third of the loops.

    output_gradients: returns the gradients of a loss from image (n, 3), alpha (n) and density (p).
    """
    renderer = _renderer(rays, volume, network, skinning, points_m, settings, reuse_buffers=True)
    rendered = renderer.forward_pass()
    output = rendered.output()
    gradients, features = renderer.backward_pass(
        rendered, output_gradients(output.image, output.alpha, output.density_per_m)
    )
    return output, gradients, [features]


class _Renderer(Protocol):
    """Inputs of one call, with its forward and backward pass."""

    def forward_pass(self) -> Any:
        """Render; `output` of the result returns the `RenderOutput`."""

    def backward_pass(
        self, rendered: Any, output_gradients: OutputGradients
    ) -> tuple[RenderGradients, tuple[Tensor, Tensor]]:
        """Return the gradients of the parameters, and the positions and the gradients of the features."""


class _RenderRays(torch.autograd.Function):
    @staticmethod
    def forward(
        ctx: Any,
        hidden: Tensor,
        output: Tensor,
        bias: Tensor,
        gate: Tensor | None,
        matrices: Tensor | None,
        renderer: _Renderer,
        feature_gradients: FeatureGradients,
    ) -> RenderOutput:
        rendered = renderer.forward_pass()
        ctx.kept = renderer, rendered, feature_gradients
        result = rendered.output()
        ctx.mark_non_differentiable(result.canonical_m, result.transmittance, result.weight)
        return result

    @staticmethod
    def backward(ctx: Any, *gradients: Tensor) -> tuple[Tensor | None, ...]:
        renderer, rendered, feature_gradients = ctx.kept
        by_parameter, of_features = renderer.backward_pass(rendered, OutputGradients(*gradients[:3]))
        feature_gradients.append(of_features)
        return (*by_parameter, None, None)


@dataclass(frozen=True)
class _Rendered:
    """Result of a forward pass: `count` samples of rays, then `points` others; image (n, 3), transmittance (n).

    is_borrowed: the next call writes to the same samples.
    """

    samples: SampleBuffers
    is_borrowed: bool
    count: int
    points: int
    image: np.ndarray
    final_transmittance: np.ndarray

    def output(self) -> RenderOutput:
        """Return the result as tensors."""
        samples, last = self.samples, self.count + self.points
        of_samples = [array[: self.count] for array in (samples.canonical, samples.transmittance, samples.weight)]
        if self.is_borrowed:
            of_samples = [array.copy() for array in of_samples]
        of_rays = self.image, 1 - self.final_transmittance, samples.density[self.count : last].copy()
        return RenderOutput(*(torch.from_numpy(array) for array in (*of_rays, *of_samples)))


@dataclass(frozen=True)
class _CpuRenderer:
    """The renderer in compiled loops on arrays."""

    inputs: RenderArrays
    points: np.ndarray
    gradient_subsampling_threshold: float
    reuse_buffers: bool

    def forward_pass(self) -> _Rendered:
        """Render the rays, and evaluate the field at the further points."""
        allocate = _thread_buffers if self.reuse_buffers else _allocate
        inputs = self.inputs
        rays, width = len(inputs.march.rays.frame_index), len(inputs.field.network.hidden)
        capacity = INITIAL_SAMPLES_PER_RAY * rays + cpu.MAX_SAMPLES_PER_PASS
        count = -1
        while count < 0:
            image, final_transmittance = np.zeros((rays, 3), np.float32), np.ones(rays, np.float32)
            samples = allocate(capacity + len(self.points), width)
            count = cpu.render_rays_fused(inputs, samples, capacity, image, final_transmittance)
            capacity *= 2
        last, bounds = count + len(self.points), inputs.field.bounds
        samples.unit[count:last] = (self.points - bounds[0]) / (bounds[1] - bounds[0])
        cpu.evaluate_field(count, last, inputs.field, samples)
        return _Rendered(samples, self.reuse_buffers, count, len(self.points), image, final_transmittance)

    def backward_pass(
        self, rendered: _Rendered, output_gradients: OutputGradients
    ) -> tuple[RenderGradients, tuple[Tensor, Tensor]]:
        """Return the gradients of the parameters, and the positions and the gradients of the features."""
        network, matrices, gate = self.inputs.field.network, self.inputs.skinning.matrices, self.inputs.field.gate
        parameters = (network.hidden, network.output, network.bias, gate, matrices)
        gradients = ParameterGradients(*(np.zeros(array.shape, np.float32) for array in parameters))
        threshold, final_transmittance = self.gradient_subsampling_threshold, rendered.final_transmittance
        of_output = OutputGradientArrays(*(gradient.contiguous().numpy() for gradient in output_gradients))
        features = backward_cpu.backward_pass(
            self.inputs, rendered.samples, rendered.count, final_transmittance, threshold, of_output, gradients
        )
        hidden, output, bias, of_gate, of_matrices = (torch.from_numpy(array) for array in gradients)
        of_poses = of_matrices.unflatten(2, (4, 4)) if len(matrices) else None
        positions, grad_features = features
        return (
            RenderGradients(hidden, output, bias, of_gate if gate.size else None, of_poses),
            (torch.from_numpy(positions), torch.from_numpy(grad_features)),
        )


def _renderer(
    rays: Rays,
    volume: SamplingVolume,
    network: RadianceNetwork,
    skinning: BatchSkinning | None,
    points_m: Float[Tensor, "p 3"],
    settings: RenderSettings,
    reuse_buffers: bool,
) -> _Renderer:
    if runs_on_cuda(rays.origins_m, network.table):
        from pipeline.kernels.volume_rendering.cuda import CudaRenderer  # only where there is a GPU

        return CudaRenderer(rays, volume, network, skinning, points_m, settings)
    skinning = skinning or BatchSkinning.empty(len(rays.frame_index))
    marched = MarchArrays(
        RayArrays(*(tensor.contiguous().numpy() for tensor in rays)),
        np.float32(settings.step_m),
        volume.warps.arrays,
        volume.occupancy_arrays,
    )
    inputs = RenderArrays(
        marched, skinning.arrays(), network.arrays, settings.max_samples, np.float32(settings.min_transmittance)
    )
    return _CpuRenderer(inputs, points_m.detach().numpy(), settings.gradient_subsampling_threshold, reuse_buffers)


def _allocate(rows: int, width: int) -> SampleBuffers:
    """Return uninitialised buffers for samples with `width` features."""
    columns = (3, 0, 9, 3, width, 3, 0, 0, 0)
    arrays = (np.empty((rows, *([count] if count else [])), np.float32) for count in columns)
    return SampleBuffers(np.empty(rows, np.int32), *arrays)


class _ThreadLocal(threading.local):
    samples: SampleBuffers | None = None


_THREAD_LOCAL = _ThreadLocal()


def _thread_buffers(rows: int, width: int) -> SampleBuffers:
    """Return buffers that the next call in the same thread returns again, if they suffice: new memory has to be mapped,
    which takes as long as to fill it."""
    samples = _THREAD_LOCAL.samples
    if samples is None or len(samples.density) < rows or samples.features.shape[1] != width:
        samples = _THREAD_LOCAL.samples = _allocate(rows, width)
    return samples
