"""Compiled loops of the backward pass of the fused renderer: gradients of the network and of the features."""

import numpy as np
from numba import njit

from pipeline.kernels.common.numba_options import NJIT_OPTIONS

_ZERO, _ONE = np.float32(0), np.float32(1)


@njit(**NJIT_OPTIONS)
def network_output_gradients(samples, count, step, final_transmittance, grad_image, grad_alpha, raw):
    """Fill dL/d(network output) (s, 4) of the first `count` samples, from the gradients of image and alpha.

    The equations are those of `pipeline.kernels.composite.cpu`.
    """
    ray_indices, colour, density, weight = samples.ray_indices, samples.colour, samples.density, samples.weight
    sample_transmittance = samples.transmittance
    suffix_sum = np.zeros(len(final_transmittance), np.float32)
    for s in range(count):
        ray = ray_indices[s]
        suffix_sum[ray] += weight[s] * (
            grad_image[ray, 0] * colour[s, 0] + grad_image[ray, 1] * colour[s, 1] + grad_image[ray, 2] * colour[s, 2]
        )
    for s in range(count):
        ray = ray_indices[s]
        gx, gy, gz = grad_image[ray, 0], grad_image[ray, 1], grad_image[ray, 2]
        r, g, b = colour[s, 0], colour[s, 1], colour[s, 2]
        grad_dot_colour = gx * r + gy * g + gz * b
        suffix_sum[ray] -= weight[s] * grad_dot_colour
        grad_alpha_term = grad_alpha[ray] * final_transmittance[ray]
        raw[s, 0] = weight[s] * gx * r * (_ONE - r)
        raw[s, 1] = weight[s] * gy * g * (_ONE - g)
        raw[s, 2] = weight[s] * gz * b * (_ONE - b)
        transmittance_behind = sample_transmittance[s] - weight[s]
        raw[s, 3] = density[s] * step * (transmittance_behind * grad_dot_colour - suffix_sum[ray] + grad_alpha_term)


@njit(**NJIT_OPTIONS)
def subsample_gradients(raw, relative_threshold):
    """Return an unbiased subset of the rows of gradients (s, 4) by systematic resampling, and the rescaled rows.

    Rows above `relative_threshold` times the mean size are kept. Smaller rows are kept with a probability proportional
    to their size, and divided by it.
    """
    count, total = len(raw), 0.0
    size = np.empty(count, np.float32)
    for s in range(count):
        size[s] = max(max(abs(raw[s, 0]), abs(raw[s, 1])), max(abs(raw[s, 2]), abs(raw[s, 3])))
        total += size[s]
    threshold = relative_threshold * total / max(count, 1)
    rows, scaled = np.empty(count, np.int64), np.empty((count, 4), np.float32)
    kept, accumulated = 0, 0.5
    for s in range(count):
        if not size[s] > _ZERO:
            continue
        probability = min(1.0, size[s] / threshold)
        accumulated += probability
        if accumulated >= 1.0:
            accumulated -= 1.0
            rows[kept] = s
            for c in range(4):
                scaled[kept, c] = raw[s, c] / np.float32(probability)
            kept += 1
    return rows[:kept], scaled[:kept]


@njit(**NJIT_OPTIONS)
def network_gradients(rows, raw, features, hidden, output, grad_hidden_weights, grad_output_weights, grad_features):
    """Add the gradients of the weights; fill dL/d(features) (rows, w)."""
    width, units = hidden.shape
    back = np.ascontiguousarray(hidden.T)
    layer = np.empty(units, np.float32)
    for row in range(len(rows)):
        s = rows[row]
        for h in range(units):
            layer[h] = _ZERO
        whole = width // 4 * 4
        for i in range(0, whole, 4):
            f0, f1, f2, f3 = features[s, i], features[s, i + 1], features[s, i + 2], features[s, i + 3]
            for h in range(units):
                layer[h] += (f0 * hidden[i, h] + f1 * hidden[i + 1, h]) + (
                    f2 * hidden[i + 2, h] + f3 * hidden[i + 3, h]
                )
        for i in range(whole, width):
            for h in range(units):
                layer[h] += features[s, i] * hidden[i, h]
        r0, r1, r2, r3 = raw[row, 0], raw[row, 1], raw[row, 2], raw[row, 3]
        for h in range(units):
            value = max(layer[h], _ZERO)
            grad_output_weights[h, 0] += value * r0
            grad_output_weights[h, 1] += value * r1
            grad_output_weights[h, 2] += value * r2
            grad_output_weights[h, 3] += value * r3
            grad_activation = (r0 * output[h, 0] + r1 * output[h, 1]) + (r2 * output[h, 2] + r3 * output[h, 3])
            layer[h] = grad_activation if value > _ZERO else _ZERO
        for i in range(width):
            value = features[s, i]
            for h in range(units):
                grad_hidden_weights[i, h] += value * layer[h]
        for i in range(width):
            grad_features[row, i] = _ZERO
        for h in range(units):
            value = layer[h]
            if value != _ZERO:
                for i in range(width):
                    grad_features[row, i] += value * back[h, i]
