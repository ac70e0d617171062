"""Voxel attention (IHM, Wang et al. 2025, section 2.2): each voxel of the occupancy grid has a learnt weight in [0, 1].

A network of two layers maps the density of a voxel, its distance to the body surface and its frequency of occupancy to
the weight. The weight multiplies the density of all samples in the voxel, in images and in the update of the occupancy
grid, so that the losses of the images train the network end to end. The paper does not define the training of the
network, nor the temporal window of the frequency. Here the frequency starts as the fraction of the posed frames whose
mask contains the voxel, and every update of the grid moves it, with the grid's decay, towards 1 where the opacity of
the voxel exceeds the threshold and towards 0 elsewhere.
"""

import torch
from jaxtyping import Float
from torch import Tensor

from pipeline.core.device import CPU
from pipeline.field.field import INITIAL_DENSITY_PER_M
from pipeline.field.occupancy import CellData, OccupancyGrid

HIDDEN_WIDTH = 16
INITIAL_LOGIT = 3.0
"""Bias of the output: a weight of 0.95 before training, so that the training starts like one without attention."""
MIN_WEIGHT = 1e-6
"""Smallest weight that a density is divided by."""


class VoxelAttention(torch.nn.Module):
    """Map (density, distance, frequency of occupancy) to a weight in [0, 1]."""

    def __init__(self, clothing_offset_m: float, seed: int) -> None:
        super().__init__()
        self.clothing_offset_m = clothing_offset_m
        rng = torch.Generator().manual_seed(seed)
        self.first = torch.nn.Linear(3, HIDDEN_WIDTH)
        self.second = torch.nn.Linear(HIDDEN_WIDTH, 1)
        for weight in (self.first.weight, self.second.weight):
            weight.data.uniform_(-0.6, 0.6, generator=rng)
        self.first.bias.data.zero_()
        self.second.bias.data.fill_(INITIAL_LOGIT)

    def forward(
        self, density_per_m: Float[Tensor, "n"], distance_m: Float[Tensor, "n"], frequency: Float[Tensor, "n"]
    ) -> Float[Tensor, "n"]:
        """Return weights. density >= 0 (1/m); distance negative inside the body; frequency in [0, 1]."""
        inputs = torch.stack(
            [0.5 * torch.log1p(density_per_m) - 1, distance_m / self.clothing_offset_m, 2 * frequency - 1], dim=-1
        )
        return torch.sigmoid(self.second(torch.relu(self.first(inputs))).squeeze(-1))


class AttentionOccupancyGrid(OccupancyGrid):
    """Occupancy grid with voxel attention: its opacity is a moving average of that of the weighted density.

    density_per_m: density of the candidate cells at the last update, without weights. frequency: see the module.
    """

    def __init__(
        self,
        cells: CellData,
        decay: float,
        threshold: float,
        clothing_offset_m: float,
        seed: int,
        device: torch.device = CPU,
    ) -> None:
        super().__init__(cells, decay, threshold, device)
        self.attention = VoxelAttention(clothing_offset_m, seed).to(device)
        self.frequency = self.mask_fraction.clone()
        self.density_per_m = torch.full_like(self.frequency, INITIAL_DENSITY_PER_M)

    def parameters(self) -> dict[str, Tensor]:
        """Return the weights of the network by name, for the optimiser."""
        return {f"attention.{name}": parameter for name, parameter in self.attention.named_parameters()}

    def gate(self) -> Float[Tensor, "gx gy gz"]:
        """Return the weight of each voxel for the present network, as a leaf of autograd; 1 if it is no candidate."""
        gate = torch.ones(self.occupied.numel(), device=self.frequency.device)
        with torch.no_grad():
            gate[self.candidate_cells] = self._weights()
        return gate.view(self.shape).requires_grad_()

    def parameter_gradients(self, gate_gradient: Float[Tensor, "gx gy gz"]) -> dict[str, Tensor]:
        """Return the gradients of `parameters`, from that of `gate`."""
        named = self.parameters()
        gradient = gate_gradient.reshape(-1)[self.candidate_cells]
        return dict(zip(named, torch.autograd.grad(self._weights(), list(named.values()), gradient), strict=True))

    def _weights(self) -> Float[Tensor, "n"]:
        weights: Tensor = self.attention(self.density_per_m, self.distance_m, self.frequency)
        return weights

    def _update_opacity(self, density_per_m: Float[Tensor, "n"], opacity: Float[Tensor, "n"]) -> None:
        """Update opacity, density and frequency from the weighted density of the candidate cells."""
        self.opacity_ema = torch.lerp(opacity, self.opacity_ema, self.decay)
        self.density_per_m = density_per_m / self._weights().clamp(min=MIN_WEIGHT)
        self.frequency = torch.lerp((opacity > self.threshold).float(), self.frequency, self.decay)

    def state_dict(self) -> dict[str, Tensor]:
        """Return the state of the grid and the inputs of the network, whose weights the optimiser keeps."""
        return super().state_dict() | {"density_per_m": self.density_per_m, "frequency": self.frequency}

    def load_state_dict(self, tensors: dict[str, Tensor]) -> None:
        """Restore the state that `state_dict` returned."""
        super().load_state_dict(tensors)
        for name in ("density_per_m", "frequency"):
            setattr(self, name, tensors[name].clone().to(self.candidate_cells.device))
