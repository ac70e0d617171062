"""Compiled loops of alpha compositing: each thread composites whole rays, so that the sums do not depend on the number
of threads.

Backward, for a loss L with g = dL/d(image), h = dL/d(alpha), and the transmittance T_i in front of sample i:
dL/d(density_i) = step_i · (T_{i+1} · (g · c_i) - sum_{k>i} w_k (g · c_k) + h · T_end), because a higher density at i
attenuates all samples behind it and increases alpha by a part of the final transmittance T_end.
"""

from typing import NamedTuple

import numpy as np
from numba import njit, prange

from pipeline.kernels.common.numba_options import NJIT_OPTIONS


class SampleArrays(NamedTuple):
    """Density (s), colour (s, c) and step (s) of the samples, and the offsets of the rays (n + 1)."""

    density: np.ndarray
    colour: np.ndarray
    step: np.ndarray
    ray_offsets: np.ndarray


@njit(parallel=True, **NJIT_OPTIONS)
def forward(samples, weights, image, alpha):
    """Fill weights (s), image (n, c) and alpha (n)."""
    density, colour, step, ray_offsets = samples
    channels = colour.shape[1]
    for ray in prange(ray_offsets.shape[0] - 1):
        transmittance = np.float32(1)
        for channel in range(channels):
            image[ray, channel] = np.float32(0)
        for i in range(ray_offsets[ray], ray_offsets[ray + 1]):
            segment_transmittance = np.exp(-density[i] * step[i])
            weight = transmittance * (np.float32(1) - segment_transmittance)
            weights[i] = weight
            for channel in range(channels):
                image[ray, channel] += weight * colour[i, channel]
            transmittance *= segment_transmittance
        alpha[ray] = np.float32(1) - transmittance


@njit(parallel=True, **NJIT_OPTIONS)
def backward(samples, weights, alpha, grad_image, grad_alpha, grad_density, grad_colour):
    """Fill grad_density (s) and grad_colour (s, c)."""
    density, colour, step, ray_offsets = samples
    channels = colour.shape[1]
    for ray in prange(ray_offsets.shape[0] - 1):
        first, last = ray_offsets[ray], ray_offsets[ray + 1]
        suffix_sum = np.float32(0)
        for i in range(first, last):
            for channel in range(channels):
                suffix_sum += weights[i] * grad_image[ray, channel] * colour[i, channel]
        transmittance = np.float32(1)
        grad_alpha_term = grad_alpha[ray] * (np.float32(1) - alpha[ray])
        for i in range(first, last):
            grad_dot_colour = np.float32(0)
            for channel in range(channels):
                grad_dot_colour += grad_image[ray, channel] * colour[i, channel]
                grad_colour[i, channel] = weights[i] * grad_image[ray, channel]
            suffix_sum -= weights[i] * grad_dot_colour
            transmittance *= np.exp(-density[i] * step[i])
            grad_density[i] = step[i] * (transmittance * grad_dot_colour - suffix_sum + grad_alpha_term)
