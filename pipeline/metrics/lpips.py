"""LPIPS, the distance between two images in the feature space of a trained network.

Zhang et al., "The Unreasonable Effectiveness of Deep Features as a Perceptual Metric", CVPR 2018, version 0.1 with
AlexNet: the features after each of the five convolutions are normalised to unit length over channels; their squared
differences are weighted per channel, averaged over the image and summed over layers. The weights are not part of this
project; `pipeline.report.lpips_weights` searches for them.
"""

from collections.abc import Mapping

import numpy as np
import torch
from jaxtyping import Float, UInt8
from torch import Tensor

MIN_SIDE_PX = 63
"""Smallest side with which AlexNet's last feature map still has a pixel."""

_SHIFT, _SCALE = (-0.030, -0.088, -0.188), (0.458, 0.448, 0.450)
_CONVOLUTIONS = (("0", 4, 2, False), ("3", 1, 2, True), ("6", 1, 1, True), ("8", 1, 1, False), ("10", 1, 1, False))
"""Name, stride and padding of each convolution of AlexNet, and whether a 3 x 3 max pooling of stride 2 precedes it."""


@torch.no_grad()
def lpips(
    render: UInt8[np.ndarray, "h w 3"], image: UInt8[np.ndarray, "h w 3"], weights: Mapping[str, Tensor]
) -> float:
    """Return the distance of two sRGB images: 0 for equal images, about 1 for very different ones.

    Args:
        render, image: the two images, both sides at least 63 px.
        weights: `features.N.weight` and `.bias` of torchvision's AlexNet, and `linK.model.1.weight` of the five layers.

    Raises:
        ValueError: a side is shorter than 63 px.
    """
    if min(image.shape[:2]) < MIN_SIDE_PX:
        raise ValueError(f"an image of {image.shape[1]} x {image.shape[0]} px is smaller than {MIN_SIDE_PX} px")
    total = 0.0
    for layer, (a, b) in enumerate(zip(_features(render, weights), _features(image, weights), strict=True)):
        channel_weights = weights[f"lin{layer}.model.1.weight"].view(-1, 1, 1)
        total += float(((a - b).square() * channel_weights).sum(0).mean())
    return total


def _features(image: UInt8[np.ndarray, "h w 3"], weights: Mapping[str, Tensor]) -> list[Float[Tensor, "c fh fw"]]:
    """Return the outputs of each convolution after ReLU, normalised to unit length over the channels of each pixel."""
    shift, scale = (torch.tensor(values).view(3, 1, 1) for values in (_SHIFT, _SCALE))
    values = (torch.from_numpy(image).permute(2, 0, 1).float() / 127.5 - 1.0 - shift) / scale
    layers = []
    for name, stride, padding, pool_first in _CONVOLUTIONS:
        if pool_first:
            values = torch.nn.functional.max_pool2d(values, 3, 2)
        kernel, bias = weights[f"features.{name}.weight"], weights[f"features.{name}.bias"]
        values = torch.nn.functional.conv2d(values[None], kernel, bias, stride, padding)[0].relu()
        layers.append(values / (values.square().sum(0, keepdim=True).sqrt() + 1e-10))
    return layers
