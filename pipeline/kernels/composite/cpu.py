"""Compiled loops of alpha compositing: a thread takes whole rays, so the sums do not depend on the number of threads.

Backward, for a loss L with g = dL/d(image), h = dL/d(alpha), T_i the light that reaches sample i:
dL/d(density_i) = step_i · (T_{i+1} · (g · c_i) - sum_{k>i} w_k (g · c_k) + h · T_end), because more density at i
dims everything behind it and adds to the alpha by the light T_end that is left over.
"""

import numpy as np
from numba import njit, prange

from pipeline.kernels.common.numba_options import NJIT_OPTIONS


@njit(parallel=True, **NJIT_OPTIONS)
def forward(density, colour, step, ray_offsets, weights, image, alpha):
    """Fill weights (s), image (n, c) and alpha (n)."""
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
def backward(
    density,
    colour,
    step,
    ray_offsets,
    weights,
    alpha,
    grad_image,
    grad_alpha,
    grad_density,
    grad_colour,
):
    """Fill density_gradient (s) and colour_gradient (s, c)."""
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
