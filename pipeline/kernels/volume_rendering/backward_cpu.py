"""Compiled loops of the backward pass of the fused renderer: gradients of the network and of the features."""

from typing import NamedTuple

import numpy as np
from numba import njit

from pipeline.kernels.common.numba_options import NJIT_OPTIONS
from pipeline.kernels.hashgrid.cpu import BLOCK, point_gradient_block
from pipeline.kernels.inverse_skinning.cell_skinning_cpu import add_matrix_gradient

_ZERO, _ONE = np.float32(0), np.float32(1)
ROWS_TOGETHER = 4
"""Samples whose contributions are added to the gradient of the weights at once."""
MIN_GATE = np.float32(1e-6)
"""Smallest factor that a gradient is divided by."""


class OutputGradientArrays(NamedTuple):
    """Gradients of image (n, 3), alpha (n) and density (p) of the further points."""

    image: np.ndarray
    alpha: np.ndarray
    density: np.ndarray


class ParameterGradients(NamedTuple):
    """Gradients of hidden (w, h), output (h, 4), bias (4), gate (gx, gy, gz) and matrices (k, j, 16); added to.

    Gate and matrices have no elements where there are none.
    """

    hidden: np.ndarray
    output: np.ndarray
    bias: np.ndarray
    gate: np.ndarray
    matrices: np.ndarray


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
    """Add the gradients of the weights; fill dL/d(features) (rows, w). Output weights and their gradient are (4, h)."""
    width, units = hidden.shape
    back = np.ascontiguousarray(hidden.T)
    layers, inputs = np.empty((ROWS_TOGETHER, units), np.float32), np.empty((ROWS_TOGETHER, width), np.float32)
    l0, l1, l2, l3 = layers[0], layers[1], layers[2], layers[3]
    for start in range(0, len(rows), ROWS_TOGETHER):
        for lane in range(ROWS_TOGETHER):
            row, layer = start + lane, layers[lane]
            for h in range(units):
                layer[h] = _ZERO
            if row >= len(rows):
                for i in range(width):
                    inputs[lane, i] = _ZERO
                continue
            s = rows[row]
            for i in range(width):
                inputs[lane, i] = features[s, i]
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
                grad_output_weights[0, h] += value * r0
                grad_output_weights[1, h] += value * r1
                grad_output_weights[2, h] += value * r2
                grad_output_weights[3, h] += value * r3
                grad_activation = (r0 * output[0, h] + r1 * output[1, h]) + (r2 * output[2, h] + r3 * output[3, h])
                layer[h] = grad_activation if value > _ZERO else _ZERO
            for i in range(width):
                grad_features[row, i] = _ZERO
            for h in range(units):
                value = layer[h]
                if value != _ZERO:
                    for i in range(width):
                        grad_features[row, i] += value * back[h, i]
        for i in range(width):
            f0, f1, f2, f3 = inputs[0, i], inputs[1, i], inputs[2, i], inputs[3, i]
            for h in range(units):
                grad_hidden_weights[i, h] += (f0 * l0[h] + f1 * l1[h]) + (f2 * l2[h] + f3 * l3[h])


@njit(**NJIT_OPTIONS)
def _add_gate_gradient(unit, raw, gate, grad_gate):
    """Add the gradient of the gate: the last column of raw (s, 4) is that of the logarithm of the gated density."""
    size_x, size_y, size_z = gate.shape
    for s in range(len(raw)):
        i = min(max(int(unit[s, 0] * np.float32(size_x)), 0), size_x - 1)
        j = min(max(int(unit[s, 1] * np.float32(size_y)), 0), size_y - 1)
        k = min(max(int(unit[s, 2] * np.float32(size_z)), 0), size_z - 1)
        grad_gate[i, j, k] += raw[s, 3] / max(gate[i, j, k], MIN_GATE)


@njit(**NJIT_OPTIONS)
def _add_pose_gradient(inputs, samples, rows, positions, grad_features, grad_matrices):
    """Add the gradient of the matrices from dL/d(features) of the samples `rows` at `positions` in the unit box."""
    _, table, lanes, _, _ = inputs.field
    batch_index, cells, _ = inputs.skinning
    bounds, ray_indices = inputs.field.bounds, samples.ray_indices
    count = len(rows)
    gradient, frames = np.zeros((count, 3), np.float32), np.empty(count, np.int64)
    for level in range(table.level_params.shape[0]):
        for start in range(0, count, BLOCK):
            stop = min(start + BLOCK, count)
            point_gradient_block(positions, table, lanes, level, grad_features, gradient, start, stop)
    for index in range(count):
        frames[index] = batch_index[ray_indices[rows[index]]]
        for axis in range(3):
            gradient[index, axis] /= bounds[1, axis] - bounds[0, axis]
    add_matrix_gradient(rows, frames, samples.canonical, samples.inverse_jacobian, gradient, cells, grad_matrices)


@njit(**NJIT_OPTIONS)
def backward_pass(inputs, samples, count, final_transmittance, threshold, output_gradients, gradients):
    """Add the gradients of all parameters but the hash table to `gradients`, from those of the output.

    The samples are `count` of rays, then the further points. threshold: see `subsample_gradients`.
    Returns positions in the unit box (r, 3) and dL/d(features) (r, w) of the samples that were kept.
    """
    grad_image, grad_alpha, grad_density = output_gradients
    network, unit, features, density = inputs.field.network, samples.unit, samples.features, samples.density
    last, width = count + len(grad_density), network.hidden.shape[0]
    raw = np.zeros((last, 4), np.float32)
    network_output_gradients(samples, count, inputs.march.step, final_transmittance, grad_image, grad_alpha, raw)
    for s in range(count, last):
        raw[s, 3] = grad_density[s - count] * density[s]
    totals = np.zeros(4, np.float64)
    for s in range(last):
        for c in range(4):
            totals[c] += raw[s, c]
    for c in range(4):
        gradients.bias[c] += np.float32(totals[c])
    if gradients.gate.size:
        _add_gate_gradient(unit, raw, inputs.field.gate, gradients.gate)
    rows, scaled = subsample_gradients(raw, threshold)
    positions, grad_features = np.empty((len(rows), 3), np.float32), np.empty((len(rows), width), np.float32)
    of_rays = 0
    for row in range(len(rows)):
        s = rows[row]
        positions[row, 0], positions[row, 1], positions[row, 2] = unit[s, 0], unit[s, 1], unit[s, 2]
        of_rays += 1 if s < count else 0
    output, grad_output = np.ascontiguousarray(network.output.T), np.zeros((4, network.hidden.shape[1]), np.float32)
    network_gradients(rows, scaled, features, network.hidden, output, gradients.hidden, grad_output, grad_features)
    for h in range(network.hidden.shape[1]):
        for c in range(4):
            gradients.output[h, c] += grad_output[c, h]
    if gradients.matrices.size:
        _add_pose_gradient(
            inputs, samples, rows[:of_rays], positions[:of_rays], grad_features[:of_rays], gradients.matrices
        )
    return positions, grad_features
