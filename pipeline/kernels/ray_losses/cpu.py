"""Compiled loop of the losses of rays and their gradients: one pass over memory instead of about twenty operations."""

import math
from typing import NamedTuple

import numpy as np
from numba import njit

from pipeline.kernels.common.numba_options import NJIT_OPTIONS

_ZERO, _ONE, _HALF = np.float32(0), np.float32(1), np.float32(0.5)
_HARD_OFFSET = np.float32(math.log(1 + math.exp(-1)))


class LossInputs(NamedTuple):
    """Rendered image (n, 3) and alpha (n); rgba (n, 4) of the pixels; background (n, 3); confidence (n)."""

    image: np.ndarray
    alpha: np.ndarray
    rgba: np.ndarray
    background: np.ndarray
    confidence: np.ndarray


class GradientArrays(NamedTuple):
    """Gradients of the sums of the losses.

    image (n, 3): of the colour loss. alpha (n, 2): of the colour and the mask loss. hard (n): of the hard surface loss,
    with respect to alpha.
    """

    image: np.ndarray
    alpha: np.ndarray
    hard: np.ndarray


@njit(**NJIT_OPTIONS)
def huber(error, delta):
    """Return the value and the slope of the Huber loss, divided by delta."""
    size = abs(error)
    if size < delta:
        return _HALF * error * error / delta, error / delta
    return size - _HALF * delta, _ONE if error > _ZERO else -_ONE


@njit(**NJIT_OPTIONS)
def ray_losses(inputs, delta, sums, error, gradients):
    """Fill sums (3), error (n, 3) and the gradients of the sums: see `pipeline.kernels.ray_losses.ray_losses`."""
    image, alpha, rgba, background, confidence = inputs
    grad_image, grad_alpha, grad_hard = gradients
    colours, alphas, hard = 0.0, 0.0, 0.0
    for ray in range(len(alpha)):
        a, mask, ray_confidence = alpha[ray], rgba[ray, 3], confidence[ray]
        grad_alpha[ray, 0] = _ZERO
        for channel in range(3):
            background_value = background[ray, channel]
            residual = (
                image[ray, channel]
                + background_value * (_ONE - a)
                - (rgba[ray, channel] * mask + background_value * (_ONE - mask))
            )
            error[ray, channel] = residual
            value, slope = huber(residual, delta)
            slope *= ray_confidence
            colours += ray_confidence * value
            grad_image[ray, channel] = slope
            grad_alpha[ray, 0] -= slope * background_value
        value, slope = huber(a - mask, delta)
        alphas += ray_confidence * value
        grad_alpha[ray, 1] = ray_confidence * slope
        full, clear = np.exp(-abs(a)), np.exp(-abs(a - _ONE))
        hard += ray_confidence * (_HARD_OFFSET - np.log(full + clear))
        rising = full if a > _ZERO else -full if a < _ZERO else _ZERO
        falling = clear if a > _ONE else -clear if a < _ONE else _ZERO
        grad_hard[ray] = ray_confidence * (rising + falling) / (full + clear)
    sums[0], sums[1], sums[2] = colours, alphas, hard
