"""AlexNet with few channels and random weights, for the tests of LPIPS."""

import numpy as np
import torch

CHANNELS = (3, 4, 5, 6, 5, 4)
KERNELS = (("0", 11, 4, 2), ("3", 5, 1, 2), ("6", 3, 1, 1), ("8", 3, 1, 1), ("10", 3, 1, 1))
"""Name, side, stride and padding of each convolution."""


def narrow_alexnet(rng: np.random.Generator) -> dict[str, torch.Tensor]:
    """Random weights with the names that `pipeline.metrics.lpips` reads."""
    made: dict[str, np.ndarray] = {}
    for layer, (name, side, _, _) in enumerate(KERNELS):
        before, after = CHANNELS[layer : layer + 2]
        made[f"features.{name}.weight"] = rng.normal(size=(after, before, side, side)) / side
        made[f"features.{name}.bias"] = rng.normal(size=after) * 0.1
        made[f"lin{layer}.model.1.weight"] = rng.random((1, after, 1, 1))
    return {name: torch.from_numpy(values).float() for name, values in made.items()}
