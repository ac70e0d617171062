"""Compiled loops of forward kinematics with corrected joints.

A joint's local rotation is L = F exp(a): F fitted, a the correction's axis times its angle. Rotations A and places t go
down from parent q to joint j: A_j = A_q L_j, t_j = t_q + A_q (p_j - p_q), with p the canonical places of the joints.
Skinning carries x to A_j (x - p_j) + t_j. Sums are in float64: there are few.
"""

import numpy as np
from numba import njit

from pipeline.kernels.common.numba_options import OPTIONS


@njit(**OPTIONS)
def _factors(a):
    """sin(t)/t, (1 - cos(t))/t² and (t - sin(t))/t³ for the length t of `a`; near zero by their series."""
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


@njit(**OPTIONS)
def _turn(a, into):
    """Rodrigues' formula: I + s K + c K², K the cross product with `a`."""
    s, c, _ = _factors(a)
    x, y, z = a[0], a[1], a[2]
    into[0, 0], into[0, 1], into[0, 2] = 1 - c * (y * y + z * z), c * x * y - s * z, c * x * z + s * y
    into[1, 0], into[1, 1], into[1, 2] = c * x * y + s * z, 1 - c * (x * x + z * z), c * y * z - s * x
    into[2, 0], into[2, 1], into[2, 2] = c * x * z - s * y, c * y * z + s * x, 1 - c * (x * x + y * y)


@njit(**OPTIONS)
def _times(a, b, into):
    for row in range(3):
        for column in range(3):
            into[row, column] = a[row, 0] * b[0, column] + a[row, 1] * b[1, column] + a[row, 2] * b[2, column]


@njit(**OPTIONS)
def forward(turns, shift, fitted, of_joint, root, joints, parents, posed_from_world, local, rotations, matrices):
    """Fill local (k, j, 3, 3), rotations (k, j, 3, 3) and matrices (k, j, 4, 4) in the posed space.

    turns (k, c, 3), shift (k, 3): corrections; of_joint (j): a joint's row of `turns`, -1 without.
    """
    turned, places = np.empty((3, 3)), np.empty((len(joints), 3))
    for frame in range(len(fitted)):
        rigid = posed_from_world[frame]
        for joint in range(len(joints)):
            mine, above = local[frame, joint], parents[joint]
            if of_joint[joint] < 0:
                mine[:] = fitted[frame, joint]
            else:
                _turn(turns[frame, of_joint[joint]], turned)
                _times(fitted[frame, joint], turned, mine)
            turn, to = rotations[frame, joint], places[joint]
            if above < 0:
                _times(rigid[:3, :3], mine, turn)
                for row in range(3):
                    to[row] = rigid[row, 3]
                    for axis in range(3):
                        to[row] += rigid[row, axis] * (root[frame, axis] + shift[frame, axis])
            else:
                _times(rotations[frame, above], mine, turn)
                for row in range(3):
                    to[row] = places[above, row]
                    for axis in range(3):
                        to[row] += rotations[frame, above, row, axis] * (joints[joint, axis] - joints[above, axis])
            matrix = matrices[frame, joint]
            matrix[3, 0] = matrix[3, 1] = matrix[3, 2] = np.float32(0)
            matrix[3, 3] = np.float32(1)
            for row in range(3):
                stays = 0.0
                for axis in range(3):
                    matrix[row, axis] = turn[row, axis]
                    stays += turn[row, axis] * joints[joint, axis]
                matrix[row, 3] = to[row] - stays


@njit(**OPTIONS)
def _turn_gradient(a, turn_gradient, turned, into):
    """dL/da for E = exp(a) and dL/dE: J^T v, where v turns with M = dL/dE E^T, and J is the left Jacobian of exp."""
    m = np.empty((3, 3))
    for row in range(3):
        for column in range(3):
            total = 0.0
            for axis in range(3):
                total += turn_gradient[row, axis] * turned[column, axis]
            m[row, column] = total
    vx, vy, vz = m[2, 1] - m[1, 2], m[0, 2] - m[2, 0], m[1, 0] - m[0, 1]
    _, c, d = _factors(a)
    x, y, z = a[0], a[1], a[2]
    ax, ay, az = y * vz - z * vy, z * vx - x * vz, x * vy - y * vx
    into[0] = vx - c * ax + d * (y * az - z * ay)
    into[1] = vy - c * ay + d * (z * ax - x * az)
    into[2] = vz - c * az + d * (x * ay - y * ax)


@njit(**OPTIONS)
def backward(
    turns,
    fitted,
    of_joint,
    joints,
    parents,
    posed_from_world,
    local,
    rotations,
    gradient,
    turns_gradient,
    shift_gradient,
):
    """Fill turns_gradient (k, c, 3) and shift_gradient (k, 3) for gradient (k, j, 4, 4) = dL/dmatrices."""
    of_turn, of_place = np.empty((len(joints), 3, 3)), np.empty((len(joints), 3))
    of_local, of_own, turned, upper = np.empty((3, 3)), np.empty((3, 3)), np.empty((3, 3)), np.empty((3, 3))
    for frame in range(len(fitted)):
        for joint in range(len(joints)):
            for row in range(3):
                of_place[joint, row] = gradient[frame, joint, row, 3]
                for axis in range(3):
                    of_turn[joint, row, axis] = (
                        gradient[frame, joint, row, axis] - gradient[frame, joint, row, 3] * joints[joint, axis]
                    )
        for joint in range(len(joints) - 1, -1, -1):
            above = parents[joint]
            if above < 0:
                upper[:] = posed_from_world[frame, :3, :3]
            else:
                upper[:] = rotations[frame, above]
            for row in range(3):
                for column in range(3):
                    of_local[row, column] = (
                        upper[0, row] * of_turn[joint, 0, column]
                        + upper[1, row] * of_turn[joint, 1, column]
                        + upper[2, row] * of_turn[joint, 2, column]
                    )
            if above >= 0:
                for row in range(3):
                    of_place[above, row] += of_place[joint, row]
                    for axis in range(3):
                        total = of_place[joint, row] * (joints[joint, axis] - joints[above, axis])
                        for column in range(3):
                            total += of_turn[joint, row, column] * local[frame, joint, axis, column]
                        of_turn[above, row, axis] += total
            if of_joint[joint] >= 0:
                own, a = fitted[frame, joint], turns[frame, of_joint[joint]]
                for row in range(3):
                    for column in range(3):
                        of_own[row, column] = (
                            own[0, row] * of_local[0, column]
                            + own[1, row] * of_local[1, column]
                            + own[2, row] * of_local[2, column]
                        )
                _turn(a, turned)
                _turn_gradient(a, of_own, turned, turns_gradient[frame, of_joint[joint]])
        for axis in range(3):
            shift_gradient[frame, axis] = 0
            for row in range(3):
                shift_gradient[frame, axis] += posed_from_world[frame, row, axis] * of_place[0, row]
