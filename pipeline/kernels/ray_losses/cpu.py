"""Compiled loop of the losses of rays, with their gradients: one pass over what some twenty operations would read."""

import math

import numpy as np
from numba import njit

from pipeline.kernels.common.numba_options import NJIT_OPTIONS

_ZERO, _ONE, _HALF = np.float32(0), np.float32(1), np.float32(0.5)
_HARD_OFFSET = np.float32(math.log(1 + math.exp(-1)))


@njit(**NJIT_OPTIONS)
def _huber(error, delta):
    """Value and slope."""
    size = abs(error)
    if size < delta:
        return _HALF * error * error / delta, error / delta
    return size - _HALF * delta, _ONE if error > _ZERO else -_ONE


@njit(**NJIT_OPTIONS)
def ray_losses(image, alpha, rgba, background, confidence, delta, sums, error, grad_image, grad_alpha, grad_hard):
    """Fill sums (3), error (n, 3) and the gradients of the sums: see `pipeline.kernels.ray_losses.ray_losses`.

    of_image (n, 3) is that of the first sum in the image; of_alpha (n, 2) those of the first and second in alpha;
    of_hard (n) that of the third.
    """
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
            value, slope = _huber(residual, delta)
            slope *= ray_confidence
            colours += ray_confidence * value
            grad_image[ray, channel] = slope
            grad_alpha[ray, 0] -= slope * background_value
        value, slope = _huber(a - mask, delta)
        alphas += ray_confidence * value
        grad_alpha[ray, 1] = ray_confidence * slope
        full, clear = np.exp(-abs(a)), np.exp(-abs(a - _ONE))
        hard += ray_confidence * (_HARD_OFFSET - np.log(full + clear))
        rising = full if a > _ZERO else -full if a < _ZERO else _ZERO
        falling = clear if a > _ONE else -clear if a < _ONE else _ZERO
        grad_hard[ray] = ray_confidence * (rising + falling) / (full + clear)
    sums[0], sums[1], sums[2] = colours, alphas, hard
