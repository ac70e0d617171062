"""Fused volume renderer: rays through a canonical radiance field behind inverse skinning, with early termination.

The plain composition of march, Newton step, hash grid, network and compositing (`reference`) evaluates all samples, of
which about three in five are behind a surface. The fused loop ends a ray at `MIN_TRANSMITTANCE`, and the working set of
a block of rays stays in the cache.

Notation: n rays, k frames of a batch, s samples, p points, w features of a point, h hidden units.
"""

from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from pipeline.kernels.common.voxels import voxel_index
from pipeline.kernels.hashgrid import FeatureGradients
from pipeline.kernels.hashgrid import cpu as hashgrid_cpu
from pipeline.kernels.inverse_skinning import cell_skinning_cpu
from pipeline.kernels.march import Rays, SamplingVolume
from pipeline.kernels.march.cpu import MarchArrays, RayArrays
from pipeline.kernels.volume_rendering import backward_cpu, cpu
from pipeline.kernels.volume_rendering.cpu import RenderArrays, SampleBuffers
from pipeline.kernels.volume_rendering.inputs import (
    MIN_TRANSMITTANCE,
    BatchSkinning,
    RadianceNetwork,
    RenderOutput,
    RenderSettings,
)

__all__ = [
    "MIN_TRANSMITTANCE",
    "BatchSkinning",
    "RadianceNetwork",
    "RenderOutput",
    "RenderSettings",
    "render_rays_fused",
]

MIN_GATE = 1e-6
"""Smallest factor that a gradient is divided by."""
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

    float32 on the CPU. Differentiable in the weights and the gate of the network and in `skinning.canonical_to_posed`; the
    backward pass appends the input of `add_table_gradient_` to `feature_gradients`.

    Args:
        rays: sorted by `skinning.batch_index`.
        skinning: None: no Newton step, samples stay where the warp grids put them.
        points_m: canonical points whose density is evaluated, in the box of the network.
    """
    skinning = skinning or BatchSkinning.empty(len(rays.frame_index))
    marched = MarchArrays(
        RayArrays(*(tensor.contiguous().numpy() for tensor in rays)),
        np.float32(settings.step_m),
        volume.warps.arrays(),
        volume.occupancy_arrays(),
    )
    inputs = RenderArrays(
        marched, skinning.arrays(), network.arrays(), settings.max_samples, np.float32(settings.min_transmittance)
    )
    threshold = settings.gradient_subsampling_threshold
    renderer = _Renderer(inputs, network, points_m.detach(), threshold, feature_gradients)
    weights = (network.hidden, network.output, network.bias, network.gate)
    return RenderOutput(*_RenderRays.apply(*weights, skinning.canonical_to_posed, renderer))


class _RenderRays(torch.autograd.Function):
    @staticmethod
    def forward(
        ctx: Any,
        hidden: Tensor,
        output: Tensor,
        bias: Tensor,
        gate: Tensor | None,
        matrices: Tensor,
        renderer: "_Renderer",
    ) -> RenderOutput:
        samples, count, image, final_transmittance = renderer.forward_pass()
        ctx.kept = renderer, samples, count, final_transmittance
        ctx.save_for_backward(matrices)
        arrays = (samples.canonical, samples.transmittance, samples.weight)
        sample_outputs = [torch.from_numpy(array[:count]) for array in arrays]
        ctx.mark_non_differentiable(*sample_outputs)
        density = torch.from_numpy(samples.density[count : count + len(renderer.points_m)].copy())
        alpha = torch.from_numpy(1 - final_transmittance)
        return RenderOutput(torch.from_numpy(image), alpha, density, *sample_outputs)

    @staticmethod
    def backward(ctx: Any, *gradients: Tensor) -> tuple[Tensor | None, ...]:
        (matrices,) = ctx.saved_tensors
        renderer, samples, count, final_transmittance = ctx.kept
        grad_image, grad_alpha, grad_density = (gradient.contiguous().numpy() for gradient in gradients[:3])
        rows = count + len(grad_density)
        raw = np.zeros((rows, 4), np.float32)
        step = renderer.inputs.march.step
        backward_cpu.network_output_gradients(samples, count, step, final_transmittance, grad_image, grad_alpha, raw)
        raw[count:, 3] = grad_density * samples.density[count:rows]
        grad_matrices = torch.zeros(matrices.shape)
        grad_hidden, grad_output = renderer.backward_pass(samples, count, raw, grad_matrices.flatten(2).numpy())
        grad_bias, grad_gate = torch.from_numpy(raw.sum(0)), renderer.gate_gradient(samples, raw)
        return torch.from_numpy(grad_hidden), torch.from_numpy(grad_output), grad_bias, grad_gate, grad_matrices, None


@dataclass(frozen=True)
class _Renderer:
    """Inputs of one call, with its forward and backward pass on arrays."""

    inputs: RenderArrays
    network: RadianceNetwork
    points_m: Tensor
    gradient_subsampling_threshold: float
    feature_gradients: FeatureGradients

    def forward_pass(self) -> tuple[SampleBuffers, int, np.ndarray, np.ndarray]:
        """Return the samples, followed by the points, the number of samples, image (n, 3), final transmittance (n)."""
        inputs, bounds_m = self.inputs, self.network.bounds_m
        rays, width = len(inputs.march.rays.frame_index), len(inputs.field.network.hidden)
        capacity = INITIAL_SAMPLES_PER_RAY * rays + cpu.MAX_SAMPLES_PER_PASS
        count = -1
        while count < 0:
            image, final_transmittance = np.zeros((rays, 3), np.float32), np.ones(rays, np.float32)
            samples = _allocate(capacity + len(self.points_m), width)
            count = cpu.render_rays_fused(inputs, samples, capacity, image, final_transmittance)
            capacity *= 2
        last = count + len(self.points_m)
        unit = (self.points_m - bounds_m[0]) / (bounds_m[1] - bounds_m[0])
        samples.unit[count:last] = unit.numpy()
        cpu.evaluate_field(count, last, inputs.field, samples)
        return samples, count, image, final_transmittance

    def backward_pass(
        self, samples: SampleBuffers, count: int, raw: np.ndarray, grad_matrices: np.ndarray
    ) -> tuple[np.ndarray, np.ndarray]:
        """Return the gradients of the weights from that of the network output (s, 4); add to `grad_matrices`."""
        _, table, lanes, network, _ = self.inputs.field
        hidden, output = network.hidden, network.output
        rows, scaled = backward_cpu.subsample_gradients(raw, self.gradient_subsampling_threshold)
        grad_hidden, grad_output = np.zeros_like(hidden), np.zeros_like(output)
        grad_features, positions = np.empty((len(rows), len(hidden)), np.float32), samples.unit[rows]
        backward_cpu.network_gradients(
            rows, scaled, samples.features, hidden, output, grad_hidden, grad_output, grad_features
        )
        self.feature_gradients.append((torch.from_numpy(positions), torch.from_numpy(grad_features)))
        ray_row_count = np.searchsorted(rows, count)
        if len(grad_matrices) and ray_row_count:
            grad_unit = np.zeros((ray_row_count, 3), np.float32)
            selected = positions[:ray_row_count], grad_features[:ray_row_count]
            hashgrid_cpu.add_points_gradient(selected[0], table, lanes, selected[1], grad_unit)
            self._add_pose_gradient(samples, rows[:ray_row_count], grad_unit, grad_matrices)
        return grad_hidden, grad_output

    def gate_gradient(self, samples: SampleBuffers, raw: np.ndarray) -> Tensor | None:
        """Return the gradient of the gate from that of the network output (s, 4).

        The last column is that of the logarithm of the gated density, hence also that of the logarithm of the gate.
        """
        gate = self.network.gate
        if gate is None:
            return None
        voxel = voxel_index(torch.from_numpy(samples.unit[: len(raw)]), tuple(gate.shape))
        of_logarithm = torch.zeros(gate.numel()).index_add_(0, voxel, torch.from_numpy(raw[:, 3]))
        return (of_logarithm / gate.detach().reshape(-1).clamp(min=MIN_GATE)).reshape(gate.shape)

    def _add_pose_gradient(
        self, samples: SampleBuffers, rows: np.ndarray, grad_unit: np.ndarray, grad_matrices: np.ndarray
    ) -> None:
        """Add the gradient of the matrices (k, j, 16), from that of some samples' positions in the unit box."""
        skinning, bounds_m = self.inputs.skinning, self.network.bounds_m
        frames = skinning.batch_index[samples.ray_indices[rows]]
        gradient = grad_unit / (bounds_m[1] - bounds_m[0]).numpy()
        cell_skinning_cpu.add_matrix_gradient(
            rows, frames, samples.canonical, samples.inverse_jacobian, gradient, skinning.cells, grad_matrices
        )


def _allocate(rows: int, width: int) -> SampleBuffers:
    """Return uninitialised buffers for samples with `width` features."""
    columns = (3, 0, 9, 3, width, 3, 0, 0, 0)
    arrays = (np.empty((rows, *([count] if count else [])), np.float32) for count in columns)
    return SampleBuffers(np.empty(rows, np.int32), *arrays)
