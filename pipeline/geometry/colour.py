"""The transfer function of sRGB (IEC 61966-2-1) for arrays and tensors of any shape."""

from typing import TypeVar

import numpy as np
import torch
from torch import Tensor

_Colours = TypeVar("_Colours", np.ndarray, Tensor)


def srgb_to_linear(srgb: _Colours) -> _Colours:
    """Convert sRGB colours to linear RGB; white is 1 in both. Values above 1 are extrapolated with the same curve."""
    return _where(srgb <= 0.04045, srgb / 12.92, ((srgb + 0.055) / 1.055) ** 2.4)


def linear_to_srgb(linear: _Colours) -> _Colours:
    """Convert linear RGB (>= 0) to sRGB, the inverse of `srgb_to_linear`."""
    return _where(linear <= 0.0031308, 12.92 * linear, 1.055 * linear ** (1 / 2.4) - 0.055)


def _where(condition: _Colours, then: _Colours, other: _Colours) -> _Colours:
    return torch.where(condition, then, other) if isinstance(then, Tensor) else np.where(condition, then, other)
