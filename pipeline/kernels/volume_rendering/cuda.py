"""The renderer on a CUDA GPU: march, Newton step, hash grid, network and compositing, and their gradients.

All samples are evaluated, also those behind a surface: a GPU has arithmetic to spare, and rays that end at different
samples would wait for each other. Matrix products are torch's.
"""

import math
from dataclasses import dataclass
from functools import cached_property
from typing import NamedTuple

import numpy as np
import torch
from numba import cuda
from torch import Tensor

from pipeline.kernels.common.cuda import CUDA_OPTIONS, launch
from pipeline.kernels.common.voxels import voxel_index
from pipeline.kernels.hashgrid import cuda as hashgrid
from pipeline.kernels.inverse_skinning import cuda as inverse_skinning
from pipeline.kernels.march import Rays, SamplingVolume
from pipeline.kernels.march.cuda import SampleTensors, march
from pipeline.kernels.volume_rendering.backward_cpu import MIN_GATE
from pipeline.kernels.volume_rendering.inputs import (
    BatchSkinning,
    OutputGradients,
    RadianceNetwork,
    RenderGradients,
    RenderOutput,
    RenderSettings,
)

_ZERO, _ONE = np.float32(0), np.float32(1)


class CompositedTensors(NamedTuple):
    """Density (1/m) and colour of s samples and of further points, transmittance in front of the samples and their
    weight, and final transmittance of the rays.
    """

    density: Tensor
    colour: Tensor
    transmittance: Tensor
    weight: Tensor
    final_transmittance: Tensor


@cuda.jit(**CUDA_OPTIONS)
def composite_samples(ray_offsets, step, composited, image):
    """Fill image and final transmittance of a ray, and transmittance and weight of its samples."""
    ray = cuda.grid(1)
    density, colour, transmittance, weight, final_transmittance = composited
    if ray >= final_transmittance.shape[0]:
        return
    left = _ONE
    red = green = blue = _ZERO
    for s in range(ray_offsets[ray], ray_offsets[ray + 1]):
        passed = math.exp(-density[s] * step)
        w = left * (_ONE - passed)
        transmittance[s], weight[s] = left, w
        red, green, blue = red + w * colour[s, 0], green + w * colour[s, 1], blue + w * colour[s, 2]
        left *= passed
    image[ray, 0], image[ray, 1], image[ray, 2] = red, green, blue
    final_transmittance[ray] = left


@cuda.jit(**CUDA_OPTIONS)
def network_output_gradients(ray_offsets, step, composited, grad_image, grad_alpha, raw):
    """Fill dL/d(network output) (s, 4) of the samples of a ray, with the equations of `composite.cpu`."""
    ray = cuda.grid(1)
    density, colour, transmittance, weight, final_transmittance = composited
    if ray >= final_transmittance.shape[0]:
        return
    gx, gy, gz = grad_image[ray, 0], grad_image[ray, 1], grad_image[ray, 2]
    behind, of_alpha = _ZERO, grad_alpha[ray] * final_transmittance[ray]
    for back in range(ray_offsets[ray + 1] - ray_offsets[ray]):
        s = ray_offsets[ray + 1] - 1 - back
        r, g, b, w = colour[s, 0], colour[s, 1], colour[s, 2], weight[s]
        along = gx * r + gy * g + gz * b
        raw[s, 0] = w * gx * r * (_ONE - r)
        raw[s, 1] = w * gy * g * (_ONE - g)
        raw[s, 2] = w * gz * b * (_ONE - b)
        raw[s, 3] = density[s] * step * ((transmittance[s] - w) * along - behind + of_alpha)
        behind += w * along


@dataclass(frozen=True)
class Rendered:
    """Result of a forward pass: s samples of rays, then p further points."""

    samples: SampleTensors
    ray_offsets: Tensor
    inverse_jacobian: Tensor | None
    unit: Tensor
    features: Tensor
    activation: Tensor
    composited: CompositedTensors
    image: Tensor

    def output(self) -> RenderOutput:
        """Return the result without what the backward pass needs."""
        density, _, transmittance, weight, final_transmittance = self.composited
        of_rays = self.image, 1 - final_transmittance, density[len(weight) :]
        return RenderOutput(*of_rays, self.samples.canonical, transmittance, weight)


@dataclass(frozen=True)
class CudaRenderer:
    """Inputs of one call, with its forward and backward pass; all tensors but the matrices of `skinning` are on the
    GPU.
    """

    rays: Rays
    volume: SamplingVolume
    network: RadianceNetwork
    skinning: BatchSkinning | None
    points_m: Tensor
    settings: RenderSettings

    @cached_property
    def _extent_m(self) -> Tensor:
        return self.network.bounds_m[1] - self.network.bounds_m[0]

    @cached_property
    def _frames(self) -> inverse_skinning.FrameTensors:
        assert self.skinning is not None
        matrices = self.skinning.canonical_to_posed.detach().flatten(2)
        cells, device = self.skinning.skin.cuda_cell_weights, self.points_m.device
        return inverse_skinning.FrameTensors(
            self.skinning.batch_index.contiguous(), matrices.to(device).contiguous(), cells
        )

    @torch.no_grad()
    def forward_pass(self) -> Rendered:
        """Render the rays, and evaluate the field at the further points."""
        network, settings = self.network, self.settings
        samples, ray_offsets = march(self.rays, self.volume, settings.step_m, settings.max_samples)
        canonical_m, inverse_jacobian = samples.canonical, None
        if self.skinning:
            rays = Rays(*(tensor.contiguous() for tensor in self.rays))
            canonical_m, inverse_jacobian = inverse_skinning.newton_steps(*samples, rays, self._frames)
        unit = torch.cat([canonical_m, self.points_m]).sub_(network.bounds_m[0]).div_(self._extent_m)
        features = hashgrid.encode(unit, network.table, network.layout.level_params)
        activation = (features @ network.hidden).clamp_(min=0)
        raw = torch.addmm(network.bias, activation, network.output)
        colour = torch.sigmoid(raw[:, :3])
        exponent = raw[:, 3].clamp(-network.exponent_limit, network.exponent_limit)
        density = exponent.exp_().mul_(network.initial_density_per_m)
        if network.gate is not None:
            density *= network.gate.reshape(-1).index_select(0, voxel_index(unit, tuple(network.gate.shape)))
        count, rays_count = len(canonical_m), len(self.rays.frame_index)
        composited = CompositedTensors(density, colour, *map(unit.new_empty, (count, count, rays_count)))
        image = unit.new_empty(rays_count, 3)
        launch(composite_samples, rays_count, ray_offsets, np.float32(settings.step_m), composited, image)
        return Rendered(samples, ray_offsets, inverse_jacobian, unit, features, activation, composited, image)

    @torch.no_grad()
    def backward_pass(
        self, rendered: Rendered, output_gradients: OutputGradients
    ) -> tuple[RenderGradients, tuple[Tensor, Tensor]]:
        """Return the gradients of the parameters, and the positions and the gradients of the features."""
        network, composited = self.network, rendered.composited
        count, raw = len(composited.weight), rendered.unit.new_zeros(len(rendered.unit), 4)
        torch.mul(output_gradients.density, composited.density[count:], out=raw[count:, 3])
        of_rays = output_gradients.image.contiguous(), output_gradients.alpha.contiguous()
        inputs = rendered.ray_offsets, np.float32(self.settings.step_m), composited, *of_rays
        launch(network_output_gradients, len(rendered.image), *inputs, raw)
        grad_activation = (raw @ network.output.T).mul_(rendered.activation > 0)
        grad_features = grad_activation @ network.hidden.T
        grad_gate = None
        if network.gate is not None:
            voxel = voxel_index(rendered.unit, tuple(network.gate.shape))
            of_samples = raw[:, 3] / network.gate.reshape(-1).index_select(0, voxel).clamp(min=float(MIN_GATE))
            grad_gate = torch.zeros_like(network.gate).view(-1).index_add_(0, voxel, of_samples).view_as(network.gate)
        gradients = RenderGradients(
            hidden=rendered.features.T @ grad_activation,
            output=rendered.activation.T @ raw,
            bias=raw.sum(0),
            gate=grad_gate,
            canonical_to_posed=self._matrix_gradient(rendered, grad_features) if self.skinning else None,
        )
        return gradients, (rendered.unit, grad_features)

    def _matrix_gradient(self, rendered: Rendered, grad_features: Tensor) -> Tensor:
        """Return the gradient of the skinning matrices, on their device."""
        assert self.skinning is not None
        assert rendered.inverse_jacobian is not None
        network, samples = self.network, rendered.samples
        gradient, grad_matrices = torch.zeros_like(samples.canonical), torch.zeros_like(self._frames.matrices)
        count, level_params = len(gradient), network.layout.level_params
        unit, of_features = rendered.unit[:count], grad_features[:count]
        hashgrid.add_points_gradient(unit, network.table, level_params, of_features, gradient)
        inverse_skinning.add_matrix_gradient(
            samples.canonical,
            samples.ray_indices,
            self._frames,
            rendered.inverse_jacobian,
            gradient.div_(self._extent_m),
            grad_matrices,
        )
        return grad_matrices.unflatten(2, (4, 4)).to(self.skinning.canonical_to_posed.device)
