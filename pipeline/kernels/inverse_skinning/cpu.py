"""Compiled loops that bake the warp grid of one frame: skinning inverted at the nodes of a posed grid."""

from typing import NamedTuple

import numpy as np
from numba import njit

from pipeline.kernels.common.numba_options import NJIT_OPTIONS
from pipeline.kernels.inverse_skinning.newton_cpu import LatticeArrays, apply_affine, invert, skin_point

_ZERO, _ONE = np.float32(0), np.float32(1)
MAX_EXTRA_DISTANCE_M = np.float32(0.03)
"""Of several inverses, those that are this much farther from the body than the nearest one are dropped: otherwise the
side of the torso would appear again as a flap below a raised arm that hung next to it in the canonical pose.
"""


class SkinArrays(NamedTuple):
    """A skin grid and the matrices of one frame.

    nodes (m, 3): canonical positions. distance (m): distance to the body. blended (m, 1, 12): skinning matrices.
    """

    lattice: LatticeArrays
    nodes: np.ndarray
    distance: np.ndarray
    blended: np.ndarray


class PosedGrid(NamedTuple):
    """A grid in posed space, with the cell size of the skin grid: position of the first node (3), node counts (3)."""

    origin: np.ndarray
    dims: np.ndarray


@njit(**NJIT_OPTIONS)
def _newton(target, start, iterations, tolerance, lattice, blended, inverse_jacobian):
    """Solve A(x) x = target by Newton's method; return whether it converged, and x.

    Fills `inverse_jacobian` (9) with that of the last iterate.
    """
    x, y, z = start
    squared = np.float32(1e9)
    for iteration in range(iterations + 1):
        inside, (qx, qy, qz), jacobian = skin_point((x, y, z), 0, lattice, blended)
        if not inside:
            return False, x, y, z
        invertible, (a, b, c, d, e, f, g, h, k) = invert(jacobian)
        if not invertible:
            return False, x, y, z
        inverse_jacobian[0], inverse_jacobian[1], inverse_jacobian[2] = a, b, c
        inverse_jacobian[3], inverse_jacobian[4], inverse_jacobian[5] = d, e, f
        inverse_jacobian[6], inverse_jacobian[7], inverse_jacobian[8] = g, h, k
        rx, ry, rz = target[0] - qx, target[1] - qy, target[2] - qz
        squared = rx * rx + ry * ry + rz * rz
        if squared < tolerance * tolerance or iteration == iterations:
            break
        sx, sy, sz = a * rx + b * ry + c * rz, d * rx + e * ry + f * rz, g * rx + h * ry + k * rz
        length = np.sqrt(sx * sx + sy * sy + sz * sz)
        scale = min(_ONE, np.float32(2) * lattice.cell / max(length, np.float32(1e-9)))
        x, y, z = x + scale * sx, y + scale * sy, z + scale * sz
    return squared < tolerance * tolerance, x, y, z


@njit(**NJIT_OPTIONS)
def skin_nodes(nodes, blended):
    """Return the posed positions (m, 3) of the nodes (m, 3) of the skin grid, and their bounding box (2, 3)."""
    posed = np.empty((nodes.shape[0], 3), np.float32)
    box = np.empty((2, 3), np.float32)
    box[0], box[1] = np.float32(1e9), np.float32(-1e9)
    for row in range(nodes.shape[0]):
        x, y, z = nodes[row, 0], nodes[row, 1], nodes[row, 2]
        m = blended[row, 0]
        for axis in range(3):
            value = m[4 * axis] * x + m[4 * axis + 1] * y + m[4 * axis + 2] * z + m[4 * axis + 3]
            posed[row, axis] = value
            box[0, axis], box[1, axis] = min(box[0, axis], value), max(box[1, axis], value)
    return posed, box


@njit(**NJIT_OPTIONS)
def _choose_start_rows(posed, distance, cell, grid):
    """Return for each posed node the row of the skin grid to start from, -1 if none is near.

    The chosen row minimises distance to the posed node + distance to the body.
    """
    origin, dims = grid
    best = np.full(dims[0] * dims[1] * dims[2], np.float32(1e9))
    start_row = np.full(dims[0] * dims[1] * dims[2], -1, np.int32)
    for row in range(posed.shape[0]):
        ci = int(np.floor((posed[row, 0] - origin[0]) / cell + np.float32(0.5)))
        cj = int(np.floor((posed[row, 1] - origin[1]) / cell + np.float32(0.5)))
        ck = int(np.floor((posed[row, 2] - origin[2]) / cell + np.float32(0.5)))
        for i in range(max(ci - 1, 0), min(ci + 2, dims[0])):
            dx = origin[0] + np.float32(i) * cell - posed[row, 0]
            for j in range(max(cj - 1, 0), min(cj + 2, dims[1])):
                dy = origin[1] + np.float32(j) * cell - posed[row, 1]
                for k in range(max(ck - 1, 0), min(ck + 2, dims[2])):
                    dz = origin[2] + np.float32(k) * cell - posed[row, 2]
                    key = distance[row] + np.sqrt(dx * dx + dy * dy + dz * dz)
                    node = (i * dims[1] + j) * dims[2] + k
                    if key < best[node]:
                        best[node], start_row[node] = key, row
    return start_row


@njit(**NJIT_OPTIONS)
def _solve_nodes(start_row, posed, skin, grid):
    """Return the canonical positions (count, 3) of the posed nodes; NaN where no inverse was found."""
    lattice, nodes, _, blended = skin
    origin, dims = grid
    cell = lattice.cell
    canonical = np.full((start_row.shape[0], 3), np.float32(np.nan))
    inverse_jacobian = np.empty(9, np.float32)
    for node in range(start_row.shape[0]):
        row = start_row[node]
        if row < 0:
            continue
        px = origin[0] + np.float32(node // (dims[1] * dims[2])) * cell
        py = origin[1] + np.float32(node // dims[2] % dims[1]) * cell
        pz = origin[2] + np.float32(node % dims[2]) * cell
        m = blended[row, 0]
        _, (a, b, c, d, e, f, g, h, k) = invert((m[0], m[1], m[2], m[4], m[5], m[6], m[8], m[9], m[10]))
        rx, ry, rz = px - posed[row, 0], py - posed[row, 1], pz - posed[row, 2]
        x = nodes[row, 0] + a * rx + b * ry + c * rz
        y = nodes[row, 1] + d * rx + e * ry + f * rz
        z = nodes[row, 2] + g * rx + h * ry + k * rz
        converged, x, y, z = _newton((px, py, pz), (x, y, z), 6, np.float32(2e-5), lattice, blended, inverse_jacobian)
        if converged:
            canonical[node, 0], canonical[node, 1], canonical[node, 2] = x, y, z
    return canonical


@njit(**NJIT_OPTIONS)
def _is_smooth(canonical, corners, limit):
    """Return whether all eight corners have an inverse and no edge of the cell is longer than `limit` (m)."""
    for a in range(8):
        if np.isnan(canonical[corners[a], 0]):
            return False
    for a in range(8):
        for bit in range(3):
            b = a | (1 << bit)
            if a == b:
                continue
            squared = _ZERO
            for axis in range(3):
                part = canonical[corners[a], axis] - canonical[corners[b], axis]
                squared += part * part
            if squared > limit * limit:
                return False
    return True


@njit(**NJIT_OPTIONS)
def _distance_at(x, y, z, lattice, distance):
    """Return the distance to the body at a canonical point whose cell has all eight nodes."""
    origin, cell, row_of_node = lattice
    gx, gy, gz = (x - origin[0]) / cell, (y - origin[1]) / cell, (z - origin[2]) / cell
    i, j, k = int(np.floor(gx)), int(np.floor(gy)), int(np.floor(gz))
    u, v, w = gx - np.float32(i), gy - np.float32(j), gz - np.float32(k)
    total = _ZERO
    for corner in range(8):
        a, b, c = corner & 1, (corner >> 1) & 1, corner >> 2
        weight = (u if a == 1 else _ONE - u) * (v if b == 1 else _ONE - v) * (w if c == 1 else _ONE - w)
        total += weight * distance[row_of_node[i + a, j + b, k + c]]
    return total


@njit(**NJIT_OPTIONS)
def _drop_far_inverses(affine_maps, distances, found):
    """Drop inverses beyond `MAX_EXTRA_DISTANCE_M`, in place; return the number that remain."""
    nearest = distances[0]
    for root in range(1, found):
        nearest = min(nearest, distances[root])
    kept = 0
    for root in range(found):
        if distances[root] <= nearest + MAX_EXTRA_DISTANCE_M:
            affine_maps[kept] = affine_maps[root]
            kept += 1
    return kept


@njit(**NJIT_OPTIONS)
def _is_duplicate_root(affine_maps, found, posed, canonical, limit):
    """Return whether one of the first `found` inverses maps the posed point to within `limit` (m) of `canonical`."""
    x, y, z = canonical
    for other in range(found):
        ox, oy, oz = apply_affine(affine_maps[other], posed[0], posed[1], posed[2])
        squared = (ox - x) * (ox - x) + (oy - y) * (oy - y) + (oz - z) * (oz - z)
        if squared <= limit * limit:
            return True
    return False


@njit(**NJIT_OPTIONS)
def _roots_in_cell(canonical, corners, centre, skin, affine_maps):
    """Fill `affine_maps` (4, 12) with the distinct inverses at the centre of a posed cell; return their number.

    Newton's method starts from the inverse of each corner. A corner that an earlier root already explains is skipped,
    because it would converge to that root again.
    """
    lattice, blended = skin.lattice, skin.blended
    cell = lattice.cell
    found = 0
    half, same = np.float32(0.5) * cell, np.float32(0.1) * cell
    distances = np.empty(4, np.float32)
    inverse_jacobian = np.empty(9, np.float32)
    for corner in range(8):
        node = corners[corner]
        x, y, z = canonical[node, 0], canonical[node, 1], canonical[node, 2]
        if found == affine_maps.shape[0] or np.isnan(x):
            continue
        px, py, pz = centre[0], centre[1], centre[2]
        right, up, away = corner & 1, (corner >> 1) & 1, corner >> 2
        cx, cy, cz = px + (half if right else -half), py + (half if up else -half), pz + (half if away else -half)
        if _is_duplicate_root(affine_maps, found, (cx, cy, cz), (x, y, z), same):
            continue
        converged, x, y, z = _newton((px, py, pz), (x, y, z), 5, np.float32(2e-4), lattice, blended, inverse_jacobian)
        converged &= not _is_duplicate_root(affine_maps, found, (px, py, pz), (x, y, z), same)
        if not converged:
            continue
        for axis in range(3):
            value = x if axis == 0 else (y if axis == 1 else z)
            for column in range(3):
                affine_maps[found, 4 * axis + column] = inverse_jacobian[3 * axis + column]
                value -= inverse_jacobian[3 * axis + column] * centre[column]
            affine_maps[found, 4 * axis + 3] = value
        distances[found] = _distance_at(x, y, z, lattice, skin.distance)
        found += 1
    return _drop_far_inverses(affine_maps, distances, found) if found > 1 else found


@njit(**NJIT_OPTIONS)
def _encode_cells(canonical, skin, grid):
    """Return the code of each posed cell, and the affine maps of the cells without one smooth inverse (`WarpGrid`)."""
    origin, dims = grid
    cell = skin.lattice.cell
    cell_codes = np.full((dims[0] - 1) * (dims[1] - 1) * (dims[2] - 1), -1, np.int32)
    capacity, used = 256, 0
    table = np.empty((capacity, 12), np.float32)
    affine_maps = np.empty((4, 12), np.float32)
    corners, centre = np.empty(8, np.int64), np.empty(3, np.float32)
    for i in range(dims[0] - 1):
        for j in range(dims[1] - 1):
            for k in range(dims[2] - 1):
                known = False
                for corner in range(8):
                    node = ((i + (corner & 1)) * dims[1] + j + ((corner >> 1) & 1)) * dims[2] + k + (corner >> 2)
                    corners[corner] = node
                    known |= not np.isnan(canonical[node, 0])
                if not known:
                    continue
                code = (i * (dims[1] - 1) + j) * (dims[2] - 1) + k
                if _is_smooth(canonical, corners, np.float32(2) * cell):
                    cell_codes[code] = 0
                    continue
                centre[0] = origin[0] + (np.float32(i) + np.float32(0.5)) * cell
                centre[1] = origin[1] + (np.float32(j) + np.float32(0.5)) * cell
                centre[2] = origin[2] + (np.float32(k) + np.float32(0.5)) * cell
                count = _roots_in_cell(canonical, corners, centre, skin, affine_maps)
                if count == 0:
                    continue
                if used + count > capacity:
                    capacity *= 2
                    larger = np.empty((capacity, 12), np.float32)
                    larger[:used] = table[:used]
                    table = larger
                table[used : used + count] = affine_maps[:count]
                cell_codes[code] = 1 + 4 * used + (count - 1)
                used += count
    return cell_codes, table[:used].copy()


@njit(**NJIT_OPTIONS)
def bake_warp_grid(posed, skin, grid):
    """Return canonical positions, cell codes and affine maps of a `WarpGrid`; posed (m, 3): `skin_nodes`' output."""
    start_row = _choose_start_rows(posed, skin.distance, skin.lattice.cell, grid)
    canonical = _solve_nodes(start_row, posed, skin, grid)
    cell_codes, affine_maps = _encode_cells(canonical, skin, grid)
    return canonical, cell_codes, affine_maps
