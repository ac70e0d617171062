"""Voxel attention: the occupancy update of IHM (Wang et al. 2025, section 2.2).

A network of two layers maps density, distance to the body surface and mask fraction of a cell to a weight in [0, 1];
the opacity of the cell is a moving average of weight times opacity. The paper does not define the training of the
network. Here the training rays provide the labels: a cell that a ray reached is positive if it contributed to a pixel
and negative if the ray passed through it. Cells that no ray reached have no label.
"""

import torch
from jaxtyping import Float
from torch import Tensor

from pipeline.core.device import CPU
from pipeline.field.occupancy import CellData, OccupancyGrid

HIDDEN_WIDTH = 16
MIN_LABELLED_TRANSMITTANCE = 0.25
"""Transmittance above which a cell has a label."""
POSITIVE_WEIGHT = 0.05
"""Weight of a sample in its pixel from which a label is 1; below, the label is proportional to the weight."""


class VoxelAttention(torch.nn.Module):
    """Map (density, distance, mask fraction) to the logit of a weight, which is close to 1 before training."""

    def __init__(self, clothing_offset_m: float, seed: int) -> None:
        super().__init__()
        self.clothing_offset_m = clothing_offset_m
        rng = torch.Generator().manual_seed(seed)
        self.first = torch.nn.Linear(3, HIDDEN_WIDTH)
        self.second = torch.nn.Linear(HIDDEN_WIDTH, 1)
        for weight in (self.first.weight, self.second.weight):
            weight.data.uniform_(-0.6, 0.6, generator=rng)
        self.first.bias.data.zero_()
        self.second.bias.data.fill_(2.0)

    def forward(
        self, density_per_m: Float[Tensor, "n"], distance_m: Float[Tensor, "n"], mask_fraction: Float[Tensor, "n"]
    ) -> Float[Tensor, "n"]:
        """Return logits. density >= 0 (1/m); distance negative inside the body; mask fraction in [0, 1]."""
        inputs = torch.stack(
            [0.5 * torch.log1p(density_per_m) - 1, distance_m / self.clothing_offset_m, 2 * mask_fraction - 1], dim=-1
        )
        return self.second(torch.relu(self.first(inputs))).squeeze(-1)


class AttentionOccupancyGrid(OccupancyGrid):
    """Occupancy grid whose moving average of the opacity is weighted by voxel attention, which it trains."""

    def __init__(
        self,
        cells: CellData,
        decay: float,
        threshold: float,
        clothing_offset_m: float,
        learning_rate: float,
        seed: int,
        device: torch.device = CPU,
    ) -> None:
        super().__init__(cells, decay, threshold, device)
        self.attention = VoxelAttention(clothing_offset_m, seed).to(device)
        self.optimiser = torch.optim.Adam(self.attention.parameters(), lr=learning_rate)

    def _update_opacity(self, density_per_m: Float[Tensor, "n"], opacity: Float[Tensor, "n"]) -> None:
        """Update `opacity_ema` with opacities times attention weights."""
        weight = torch.sigmoid(self._train_attention(density_per_m))
        self.opacity_ema = self.decay * self.opacity_ema + (1 - self.decay) * weight * opacity

    def _train_attention(self, density_per_m: Float[Tensor, "n"]) -> Float[Tensor, "n"]:
        """Take one step of the network on the cells with labels; return the logits of all candidate cells."""
        max_transmittance = self.max_transmittance[self.candidate_cells]
        has_label = (max_transmittance > MIN_LABELLED_TRANSMITTANCE).float()
        target = (self.max_weight[self.candidate_cells] / POSITIVE_WEIGHT).clamp(max=1)
        with torch.enable_grad():
            logit = self.attention(density_per_m, self.distance_m, self.mask_fraction)
            loss = torch.nn.functional.binary_cross_entropy_with_logits(logit, target, has_label, reduction="sum")
            self.optimiser.zero_grad()
            (loss / has_label.sum().clamp(min=1)).backward()
            self.optimiser.step()
        return logit.detach()

    def state_dict(self) -> dict[str, Tensor]:
        """Return the state of the grid, the network and its optimiser."""
        tensors = super().state_dict()
        for name, parameter in self.attention.named_parameters():
            moments = self.optimiser.state.get(parameter, {})
            tensors[f"attention.{name}"] = parameter.detach()
            tensors |= {f"attention.{name}.{key}": value for key, value in moments.items()}
        return tensors

    def load_state_dict(self, tensors: dict[str, Tensor]) -> None:
        """Restore the state that `state_dict` returned."""
        super().load_state_dict(tensors)
        for name, parameter in self.attention.named_parameters():
            parameter.data.copy_(tensors[f"attention.{name}"])
            keys = [key for key in ("step", "exp_avg", "exp_avg_sq") if f"attention.{name}.{key}" in tensors]
            if keys:
                loaded = {key: tensors[f"attention.{name}.{key}"].clone() for key in keys}
                # torch's Adam keeps the step count on the CPU.
                moved = {key: loaded[key].to(parameter.device) for key in keys if key != "step"}
                self.optimiser.state[parameter] = loaded | moved
