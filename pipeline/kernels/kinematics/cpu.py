"""Compiled loops of forward kinematics with corrected joints.

The local rotation of a joint is L = F exp(a), with the fitted rotation F and the correction a (axis times angle).
Rotations A and positions t follow from parent q to joint j: A_j = A_q L_j, t_j = t_q + A_q (p_j - p_q), with the
canonical positions p of the joints. Skinning moves x to A_j (x - p_j) + t_j. Sums are in float64.
"""

from typing import NamedTuple

import numpy as np
from numba import njit

from pipeline.kernels.common.numba_options import NJIT_OPTIONS


class SkeletonArrays(NamedTuple):
    """See `pipeline.kernels.kinematics.inputs.Skeleton`."""

    joints: np.ndarray
    parents: np.ndarray
    correction_row: np.ndarray


class PoseArrays(NamedTuple):
    """See `pipeline.kernels.kinematics.inputs.FittedPoses`."""

    fitted: np.ndarray
    root: np.ndarray
    world_to_posed: np.ndarray


@njit(**NJIT_OPTIONS)
def _rodrigues_factors(a):
    """Return sin(t)/t, (1 - cos(t))/t² and (t - sin(t))/t³ for the length t of `a`; by their series near zero."""
    squared = a[0] * a[0] + a[1] * a[1] + a[2] * a[2]
    if squared < 1e-4:
        return (
            1 - squared / 6 * (1 - squared / 20),
            0.5 - squared / 24 * (1 - squared / 30),
            1 / 6 - squared / 120 * (1 - squared / 42),
        )
    angle = np.sqrt(squared)
    sine = np.sin(angle)
    return sine / angle, (1 - np.cos(angle)) / squared, (angle - sine) / (squared * angle)


@njit(**NJIT_OPTIONS)
def _axis_angle_to_matrix(a, out):
    """Fill `out` by Rodrigues' formula: I + s K + c K², where K x = a x x (cross product)."""
    s, c, _ = _rodrigues_factors(a)
    x, y, z = a[0], a[1], a[2]
    out[0, 0], out[0, 1], out[0, 2] = 1 - c * (y * y + z * z), c * x * y - s * z, c * x * z + s * y
    out[1, 0], out[1, 1], out[1, 2] = c * x * y + s * z, 1 - c * (x * x + z * z), c * y * z - s * x
    out[2, 0], out[2, 1], out[2, 2] = c * x * z - s * y, c * y * z + s * x, 1 - c * (x * x + y * y)


@njit(**NJIT_OPTIONS)
def _multiply_3x3(a, b, out):
    for row in range(3):
        for column in range(3):
            out[row, column] = a[row, 0] * b[0, column] + a[row, 1] * b[1, column] + a[row, 2] * b[2, column]


@njit(**NJIT_OPTIONS)
def forward(axis_angles, root_shift, skeleton, poses, local, rotations, matrices):
    """Fill local and posed rotations (k, j, 3, 3), and the skinning matrices (k, j, 4, 4) into the posed space.

    axis_angles (k, c, 3) and root_shift (k, 3) are the corrections.
    """
    joints, parents, correction_row = skeleton
    fitted, root, world_to_posed = poses
    correction, positions = np.empty((3, 3)), np.empty((len(joints), 3))
    for frame in range(len(fitted)):
        rigid = world_to_posed[frame]
        for joint in range(len(joints)):
            local_rotation, parent = local[frame, joint], parents[joint]
            if correction_row[joint] < 0:
                local_rotation[:] = fitted[frame, joint]
            else:
                _axis_angle_to_matrix(axis_angles[frame, correction_row[joint]], correction)
                _multiply_3x3(fitted[frame, joint], correction, local_rotation)
            rotation, position = rotations[frame, joint], positions[joint]
            if parent < 0:
                _multiply_3x3(rigid[:3, :3], local_rotation, rotation)
                for row in range(3):
                    position[row] = rigid[row, 3]
                    for axis in range(3):
                        position[row] += rigid[row, axis] * (root[frame, axis] + root_shift[frame, axis])
            else:
                _multiply_3x3(rotations[frame, parent], local_rotation, rotation)
                for row in range(3):
                    position[row] = positions[parent, row]
                    for axis in range(3):
                        position[row] += rotations[frame, parent, row, axis] * (
                            joints[joint, axis] - joints[parent, axis]
                        )
            matrix = matrices[frame, joint]
            matrix[3, 0] = matrix[3, 1] = matrix[3, 2] = np.float32(0)
            matrix[3, 3] = np.float32(1)
            for row in range(3):
                rotated_joint = 0.0
                for axis in range(3):
                    matrix[row, axis] = rotation[row, axis]
                    rotated_joint += rotation[row, axis] * joints[joint, axis]
                matrix[row, 3] = position[row] - rotated_joint


@njit(**NJIT_OPTIONS)
def _axis_angle_gradient(a, grad_matrix, correction, out):
    """Fill `out` with dL/da = J^T v for E = exp(a): v is the axial vector of dL/dE E^T, J the left Jacobian of exp."""
    m = np.empty((3, 3))
    for row in range(3):
        for column in range(3):
            total = 0.0
            for axis in range(3):
                total += grad_matrix[row, axis] * correction[column, axis]
            m[row, column] = total
    vx, vy, vz = m[2, 1] - m[1, 2], m[0, 2] - m[2, 0], m[1, 0] - m[0, 1]
    _, c, d = _rodrigues_factors(a)
    x, y, z = a[0], a[1], a[2]
    ax, ay, az = y * vz - z * vy, z * vx - x * vz, x * vy - y * vx
    out[0] = vx - c * ax + d * (y * az - z * ay)
    out[1] = vy - c * ay + d * (z * ax - x * az)
    out[2] = vz - c * az + d * (x * ay - y * ax)


@njit(**NJIT_OPTIONS)
def backward(axis_angles, skeleton, poses, local, rotations, gradient, grad_axis_angles, grad_shift):
    """Fill grad_axis_angles (k, c, 3) and grad_shift (k, 3) from gradient = dL/dmatrices (k, j, 4, 4)."""
    joints, parents, correction_row = skeleton
    fitted, _, world_to_posed = poses
    grad_rotation, grad_position = np.empty((len(joints), 3, 3)), np.empty((len(joints), 3))
    grad_local, grad_correction, correction, parent_rotation = (
        np.empty((3, 3)),
        np.empty((3, 3)),
        np.empty((3, 3)),
        np.empty((3, 3)),
    )
    for frame in range(len(fitted)):
        for joint in range(len(joints)):
            for row in range(3):
                grad_position[joint, row] = gradient[frame, joint, row, 3]
                for axis in range(3):
                    grad_rotation[joint, row, axis] = (
                        gradient[frame, joint, row, axis] - gradient[frame, joint, row, 3] * joints[joint, axis]
                    )
        for joint in range(len(joints) - 1, -1, -1):
            parent = parents[joint]
            if parent < 0:
                parent_rotation[:] = world_to_posed[frame, :3, :3]
            else:
                parent_rotation[:] = rotations[frame, parent]
            for row in range(3):
                for column in range(3):
                    grad_local[row, column] = (
                        parent_rotation[0, row] * grad_rotation[joint, 0, column]
                        + parent_rotation[1, row] * grad_rotation[joint, 1, column]
                        + parent_rotation[2, row] * grad_rotation[joint, 2, column]
                    )
            if parent >= 0:
                for row in range(3):
                    grad_position[parent, row] += grad_position[joint, row]
                    for axis in range(3):
                        total = grad_position[joint, row] * (joints[joint, axis] - joints[parent, axis])
                        for column in range(3):
                            total += grad_rotation[joint, row, column] * local[frame, joint, axis, column]
                        grad_rotation[parent, row, axis] += total
            if correction_row[joint] >= 0:
                fitted_rotation, a = fitted[frame, joint], axis_angles[frame, correction_row[joint]]
                for row in range(3):
                    for column in range(3):
                        grad_correction[row, column] = (
                            fitted_rotation[0, row] * grad_local[0, column]
                            + fitted_rotation[1, row] * grad_local[1, column]
                            + fitted_rotation[2, row] * grad_local[2, column]
                        )
                _axis_angle_to_matrix(a, correction)
                _axis_angle_gradient(a, grad_correction, correction, grad_axis_angles[frame, correction_row[joint]])
        for axis in range(3):
            grad_shift[frame, axis] = 0
            for row in range(3):
                grad_shift[frame, axis] += world_to_posed[frame, row, axis] * grad_position[0, row]
