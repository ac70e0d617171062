"""Compiled loop of the losses of rays, with their gradients: one pass over what some twenty operations would read."""

import math

import numpy as np
from numba import njit

from pipeline.kernels.common.numba_options import OPTIONS

_ZERO, _ONE, _HALF = np.float32(0), np.float32(1), np.float32(0.5)
_HARD_OFFSET = np.float32(math.log(1 + math.exp(-1)))


@njit(**OPTIONS)
def _huber(error, delta):
    """Value and slope."""
    size = abs(error)
    if size < delta:
        return _HALF * error * error / delta, error / delta
    return size - _HALF * delta, _ONE if error > _ZERO else -_ONE


@njit(**OPTIONS)
def ray_losses(image, alpha, rgba, background, trust, delta, sums, error, of_image, of_alpha, of_hard):
    """Fill sums (3), error (n, 3) and the gradients of the sums: see `pipeline.kernels.ray_losses.ray_losses`.

    of_image (n, 3) is that of the first sum in the image; of_alpha (n, 2) those of the first and second in alpha;
    of_hard (n) that of the third.
    """
    colours, alphas, hard = 0.0, 0.0, 0.0
    for ray in range(len(alpha)):
        a, mask, share = alpha[ray], rgba[ray, 3], trust[ray]
        of_alpha[ray, 0] = _ZERO
        for channel in range(3):
            behind = background[ray, channel]
            wrong = image[ray, channel] + behind * (_ONE - a) - (rgba[ray, channel] * mask + behind * (_ONE - mask))
            error[ray, channel] = wrong
            value, slope = _huber(wrong, delta)
            slope *= share
            colours += share * value
            of_image[ray, channel] = slope
            of_alpha[ray, 0] -= slope * behind
        value, slope = _huber(a - mask, delta)
        alphas += share * value
        of_alpha[ray, 1] = share * slope
        full, clear = np.exp(-abs(a)), np.exp(-abs(a - _ONE))
        hard += share * (_HARD_OFFSET - np.log(full + clear))
        rising = full if a > _ZERO else -full if a < _ZERO else _ZERO
        falling = clear if a > _ONE else -clear if a < _ONE else _ZERO
        of_hard[ray] = share * (rising + falling) / (full + clear)
    sums[0], sums[1], sums[2] = colours, alphas, hard
