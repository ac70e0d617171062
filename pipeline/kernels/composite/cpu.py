"""Compiled loops of alpha compositing: a thread takes whole rays, so the sums do not depend on the number of threads.

Backward, for a loss L with g = dL/d(image), h = dL/d(alpha), T_i the light that reaches sample i:
dL/d(density_i) = step_i · (T_{i+1} · (g · c_i) - sum_{k>i} w_k (g · c_k) + h · T_end), because more density at i
dims everything behind it and adds to the alpha by the light T_end that is left over.
"""

import numpy as np
from numba import njit, prange

from pipeline.kernels.common.numba_options import OPTIONS


@njit(parallel=True, **OPTIONS)
def forward(density, colour, step, ray_start, weights, image, alpha):
    """Fill weights (s), image (n, c) and alpha (n)."""
    channels = colour.shape[1]
    for ray in prange(ray_start.shape[0] - 1):
        light = np.float32(1)
        for channel in range(channels):
            image[ray, channel] = np.float32(0)
        for i in range(ray_start[ray], ray_start[ray + 1]):
            passed = np.exp(-density[i] * step[i])
            weight = light * (np.float32(1) - passed)
            weights[i] = weight
            for channel in range(channels):
                image[ray, channel] += weight * colour[i, channel]
            light *= passed
        alpha[ray] = np.float32(1) - light


@njit(parallel=True, **OPTIONS)
def backward(
    density,
    colour,
    step,
    ray_start,
    weights,
    alpha,
    image_gradient,
    alpha_gradient,
    density_gradient,
    colour_gradient,
):
    """Fill density_gradient (s) and colour_gradient (s, c)."""
    channels = colour.shape[1]
    for ray in prange(ray_start.shape[0] - 1):
        first, last = ray_start[ray], ray_start[ray + 1]
        behind = np.float32(0)
        for i in range(first, last):
            for channel in range(channels):
                behind += weights[i] * image_gradient[ray, channel] * colour[i, channel]
        light = np.float32(1)
        left_over = alpha_gradient[ray] * (np.float32(1) - alpha[ray])
        for i in range(first, last):
            towards = np.float32(0)
            for channel in range(channels):
                towards += image_gradient[ray, channel] * colour[i, channel]
                colour_gradient[i, channel] = weights[i] * image_gradient[ray, channel]
            behind -= weights[i] * towards
            light *= np.exp(-density[i] * step[i])
            density_gradient[i] = step[i] * (light * towards - behind + left_over)
