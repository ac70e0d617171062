"""Compiled loops that bake the warp grid of a frame, skinning inverted at its nodes. Grid arguments: `newton_cpu`."""

import numpy as np
from numba import njit

from pipeline.kernels.common.numba_options import NJIT_OPTIONS
from pipeline.kernels.inverse_skinning.newton_cpu import apply_affine, invert, skin_point

_ZERO, _ONE = np.float32(0), np.float32(1)
MAX_EXTRA_DISTANCE_M = np.float32(0.03)
"""An inverse that much farther from the body than another is not believed: the side of a torso would else become a flap
below the arm that hung beside it.
"""


@njit(**NJIT_OPTIONS)
def _newton(px, py, pz, x, y, z, iterations, tolerance, origin, cell, row_of_node, blended, inverse_jacobian):
    """Solve A(x) x = p from a start; fills the inverse Jacobian (9). Returns converged, x, y, z, squared residual."""
    squared = np.float32(1e9)
    for iteration in range(iterations + 1):
        inside, qx, qy, qz, a, b, c, d, e, f, g, h, k = skin_point(x, y, z, 0, origin, cell, row_of_node, blended)
        if not inside:
            return False, x, y, z, squared
        invertible, a, b, c, d, e, f, g, h, k = invert(a, b, c, d, e, f, g, h, k)
        if not invertible:
            return False, x, y, z, squared
        inverse_jacobian[0], inverse_jacobian[1], inverse_jacobian[2] = a, b, c
        inverse_jacobian[3], inverse_jacobian[4], inverse_jacobian[5] = d, e, f
        inverse_jacobian[6], inverse_jacobian[7], inverse_jacobian[8] = g, h, k
        rx, ry, rz = px - qx, py - qy, pz - qz
        squared = rx * rx + ry * ry + rz * rz
        if squared < tolerance * tolerance or iteration == iterations:
            break
        sx, sy, sz = a * rx + b * ry + c * rz, d * rx + e * ry + f * rz, g * rx + h * ry + k * rz
        length = np.sqrt(sx * sx + sy * sy + sz * sz)
        scale = min(_ONE, np.float32(2) * cell / max(length, np.float32(1e-9)))
        x, y, z = x + scale * sx, y + scale * sy, z + scale * sz
    return squared < tolerance * tolerance, x, y, z, squared


@njit(**NJIT_OPTIONS)
def skin_nodes(nodes, blended):
    """Posed positions (m, 3) of the skin grid's nodes, and their box (2, 3)."""
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
def _choose_start_rows(posed, distance, posed_origin, cell, dims):
    """For each posed node the skin-grid row to start from: near in space, and of the body part that is nearest."""
    best = np.full(dims[0] * dims[1] * dims[2], np.float32(1e9))
    start_row = np.full(dims[0] * dims[1] * dims[2], -1, np.int32)
    for row in range(posed.shape[0]):
        ci = int(np.floor((posed[row, 0] - posed_origin[0]) / cell + np.float32(0.5)))
        cj = int(np.floor((posed[row, 1] - posed_origin[1]) / cell + np.float32(0.5)))
        ck = int(np.floor((posed[row, 2] - posed_origin[2]) / cell + np.float32(0.5)))
        for i in range(max(ci - 1, 0), min(ci + 2, dims[0])):
            dx = posed_origin[0] + np.float32(i) * cell - posed[row, 0]
            for j in range(max(cj - 1, 0), min(cj + 2, dims[1])):
                dy = posed_origin[1] + np.float32(j) * cell - posed[row, 1]
                for k in range(max(ck - 1, 0), min(ck + 2, dims[2])):
                    dz = posed_origin[2] + np.float32(k) * cell - posed[row, 2]
                    key = distance[row] + np.sqrt(dx * dx + dy * dy + dz * dz)
                    node = (i * dims[1] + j) * dims[2] + k
                    if key < best[node]:
                        best[node], start_row[node] = key, row
    return start_row


@njit(**NJIT_OPTIONS)
def _solve_nodes(start_row, nodes, posed, posed_origin, dims, origin, cell, row_of_node, blended):
    """Canonical positions (count, 3) of the posed nodes; NaN where none was found."""
    canonical = np.full((start_row.shape[0], 3), np.float32(np.nan))
    inverse_jacobian = np.empty(9, np.float32)
    for node in range(start_row.shape[0]):
        row = start_row[node]
        if row < 0:
            continue
        px = posed_origin[0] + np.float32(node // (dims[1] * dims[2])) * cell
        py = posed_origin[1] + np.float32(node // dims[2] % dims[1]) * cell
        pz = posed_origin[2] + np.float32(node % dims[2]) * cell
        m = blended[row, 0]
        invertible, a, b, c, d, e, f, g, h, k = invert(m[0], m[1], m[2], m[4], m[5], m[6], m[8], m[9], m[10])
        rx, ry, rz = px - posed[row, 0], py - posed[row, 1], pz - posed[row, 2]
        x = nodes[row, 0] + a * rx + b * ry + c * rz
        y = nodes[row, 1] + d * rx + e * ry + f * rz
        z = nodes[row, 2] + g * rx + h * ry + k * rz
        found, x, y, z, _ = _newton(
            px, py, pz, x, y, z, 6, np.float32(2e-5), origin, cell, row_of_node, blended, inverse_jacobian
        )
        if found:
            canonical[node, 0], canonical[node, 1], canonical[node, 2] = x, y, z
    return canonical


@njit(**NJIT_OPTIONS)
def _is_smooth(canonical, corners, limit):
    """True if all eight corners have an inverse and no edge of the cell is stretched beyond `limit` metres."""
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
def _distance_at(x, y, z, origin, cell, row_of_node, distance):
    """Distance to the body at a canonical point whose cell has all its nodes."""
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
    """Drop the inverses that lie much farther from the body than the nearest one; returns how many are left."""
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
def _is_duplicate_root(affine_maps, found, px, py, pz, x, y, z, limit):
    """True if one of the first `found` inverses puts the posed point p within `limit` metres of x."""
    for other in range(found):
        ox, oy, oz = apply_affine(affine_maps[other], px, py, pz)
        squared = (ox - x) * (ox - x) + (oy - y) * (oy - y) + (oz - z) * (oz - z)
        if squared <= limit * limit:
            return True
    return False


@njit(**NJIT_OPTIONS)
def _roots_in_cell(canonical, corners, centre, origin, cell, row_of_node, blended, distance, affine_maps):
    """Distinct inverses at a cell's centre, started from its corners, as affine maps (4, 12); returns their number.

    A corner that an inverse found before explains already would lead there again, and starts none.
    """
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
        if _is_duplicate_root(affine_maps, found, cx, cy, cz, x, y, z, same):
            continue
        converged, x, y, z, _ = _newton(
            px, py, pz, x, y, z, 5, np.float32(2e-4), origin, cell, row_of_node, blended, inverse_jacobian
        )
        converged &= not _is_duplicate_root(affine_maps, found, px, py, pz, x, y, z, same)
        if not converged:
            continue
        for axis in range(3):
            value = x if axis == 0 else (y if axis == 1 else z)
            for column in range(3):
                affine_maps[found, 4 * axis + column] = inverse_jacobian[3 * axis + column]
                value -= inverse_jacobian[3 * axis + column] * centre[column]
            affine_maps[found, 4 * axis + 3] = value
        distances[found] = _distance_at(x, y, z, origin, cell, row_of_node, distance)
        found += 1
    return _drop_far_inverses(affine_maps, distances, found) if found > 1 else found


@njit(**NJIT_OPTIONS)
def _encode_cells(canonical, posed_origin, dims, origin, cell, row_of_node, blended, distance):
    """A code per posed cell and the affine maps of the cells without one smooth inverse: see `bake_warp_grid`."""
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
                centre[0] = posed_origin[0] + (np.float32(i) + np.float32(0.5)) * cell
                centre[1] = posed_origin[1] + (np.float32(j) + np.float32(0.5)) * cell
                centre[2] = posed_origin[2] + (np.float32(k) + np.float32(0.5)) * cell
                count = _roots_in_cell(
                    canonical, corners, centre, origin, cell, row_of_node, blended, distance, affine_maps
                )
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
def bake_warp_grid(nodes, posed, distance, posed_origin, dims, origin, cell, row_of_node, blended):
    """The warp grid of one frame: see `pipeline.kernels.inverse_skinning.bake_warp_grid`."""
    start_row = _choose_start_rows(posed, distance, posed_origin, cell, dims)
    canonical = _solve_nodes(start_row, nodes, posed, posed_origin, dims, origin, cell, row_of_node, blended)
    cell_codes, affine_maps = _encode_cells(canonical, posed_origin, dims, origin, cell, row_of_node, blended, distance)
    return canonical, cell_codes, affine_maps
