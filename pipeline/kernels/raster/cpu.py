"""Compiled loops of z-buffer rasterisation. Each thread draws whole bands of rows, so that the result is deterministic.

Notation: a, b, c corners of a face in pixels; e twice the signed area of (corner, corner, pixel centre); w = e / area
screen-space barycentrics. 1/z is linear in w (Blinn, "Hyperbolic interpolation", 1992), hence q_k = w_k / z_k and
depth = 1 / sum(q). Edge functions are float64: in float32 a pixel centre on an edge shared by two faces can be outside
both. Comparisons with NaN must be false (a face with a NaN corner is dropped), which full fast math does not guarantee.
"""

import numpy as np
from numba import njit, prange

from pipeline.kernels.common.numba_options import NJIT_OPTIONS

BAND_ROWS = 16


@njit(**NJIT_OPTIONS)
def _first_centre(low: float, size: int) -> int:
    """Return the first pixel index whose centre is at or right of `low`, clamped to [0, size]."""
    return int(np.ceil(min(max(low - 0.5, 0.0), float(size))))


@njit(**NJIT_OPTIONS)
def _last_centre(high: float, size: int) -> int:
    """Return the last pixel index whose centre is at or left of `high`, clamped to [-1, size - 1]."""
    return int(np.floor(min(max(high - 0.5, -1.0), float(size - 1))))


@njit(parallel=True, **NJIT_OPTIONS)
def face_boxes(
    vertices_px: np.ndarray, depth_m: np.ndarray, faces: np.ndarray, size_wh: tuple, near_m: float, cull: bool
) -> np.ndarray:
    """Return the first and last column and row (f, 4) int32 that each face can cover; first > last if it is dropped."""
    width, height = size_wh
    boxes = np.empty((faces.shape[0], 4), np.int32)
    for f in prange(faces.shape[0]):
        a, b, c = faces[f, 0], faces[f, 1], faces[f, 2]
        ax, ay = np.float64(vertices_px[a, 0]), np.float64(vertices_px[a, 1])
        bx, by = np.float64(vertices_px[b, 0]), np.float64(vertices_px[b, 1])
        cx, cy = np.float64(vertices_px[c, 0]), np.float64(vertices_px[c, 1])
        area = (bx - ax) * (cy - ay) - (by - ay) * (cx - ax)
        in_front = depth_m[a] >= near_m and depth_m[b] >= near_m and depth_m[c] >= near_m
        # Image y points down: a counter-clockwise face seen from outside has a negative area.
        seen = area < 0.0 if cull else abs(area) > 0.0
        if not (in_front and seen):
            boxes[f, 0], boxes[f, 1], boxes[f, 2], boxes[f, 3] = 1, 0, 1, 0
            continue
        boxes[f, 0] = _first_centre(min(ax, bx, cx), width)
        boxes[f, 1] = _last_centre(max(ax, bx, cx), width)
        boxes[f, 2] = _first_centre(min(ay, by, cy), height)
        boxes[f, 3] = _last_centre(max(ay, by, cy), height)
    return boxes


@njit(**NJIT_OPTIONS)
def bin_faces(boxes: np.ndarray, n_bands: int) -> tuple:
    """Return the faces of each band of rows, in ascending order: (offsets (n_bands + 1), face list)."""
    band_offsets = np.zeros(n_bands + 1, np.int64)
    for f in range(boxes.shape[0]):
        if boxes[f, 0] <= boxes[f, 1] and boxes[f, 2] <= boxes[f, 3]:
            for band in range(boxes[f, 2] // BAND_ROWS, boxes[f, 3] // BAND_ROWS + 1):
                band_offsets[band + 1] += 1
    for band in range(n_bands):
        band_offsets[band + 1] += band_offsets[band]
    cursor = band_offsets[:-1].copy()
    face_list = np.empty(band_offsets[n_bands], np.int32)
    for f in range(boxes.shape[0]):
        if boxes[f, 0] <= boxes[f, 1] and boxes[f, 2] <= boxes[f, 3]:
            for band in range(boxes[f, 2] // BAND_ROWS, boxes[f, 3] // BAND_ROWS + 1):
                face_list[cursor[band]] = f
                cursor[band] += 1
    return band_offsets, face_list


@njit(**NJIT_OPTIONS)
def _edge_plane(ax: float, ay: float, bx: float, by: float, scale: float) -> tuple:
    """Return (A, B, C) with A x + B y + C = scale * ((b - a) x (p - a))."""
    return -(by - ay) * scale, (bx - ax) * scale, ((by - ay) * ax - (bx - ax) * ay) * scale


@njit(**NJIT_OPTIONS)
def _draw_face(
    f: int,
    box: tuple,
    vertices_px: np.ndarray,
    depth_m: np.ndarray,
    faces: np.ndarray,
    face_id: np.ndarray,
    inverse: np.ndarray,
) -> None:
    """Draw face `f` into the rows and columns of `box`; the nearer fragment wins, the lower face index on a tie."""
    a, b, c = faces[f, 0], faces[f, 1], faces[f, 2]
    ax, ay = np.float64(vertices_px[a, 0]), np.float64(vertices_px[a, 1])
    bx, by = np.float64(vertices_px[b, 0]), np.float64(vertices_px[b, 1])
    cx, cy = np.float64(vertices_px[c, 0]), np.float64(vertices_px[c, 1])
    scale = 1.0 / ((bx - ax) * (cy - ay) - (by - ay) * (cx - ax))
    a0, b0, c0 = _edge_plane(bx, by, cx, cy, scale)
    a1, b1, c1 = _edge_plane(cx, cy, ax, ay, scale)
    a2, b2, c2 = _edge_plane(ax, ay, bx, by, scale)
    za, zb, zc = 1.0 / depth_m[a], 1.0 / depth_m[b], 1.0 / depth_m[c]
    for y in range(box[2], box[3] + 1):
        row0, row1, row2 = b0 * (y + 0.5) + c0, b1 * (y + 0.5) + c1, b2 * (y + 0.5) + c2
        for x in range(box[0], box[1] + 1):
            w0, w1, w2 = a0 * (x + 0.5) + row0, a1 * (x + 0.5) + row1, a2 * (x + 0.5) + row2
            if w0 >= 0.0 and w1 >= 0.0 and w2 >= 0.0:
                q = np.float32(w0 * za + w1 * zb + w2 * zc)
                if q > inverse[y, x]:
                    inverse[y, x] = q
                    face_id[y, x] = f


@njit(parallel=True, **NJIT_OPTIONS)
def draw_bands(
    vertices_px: np.ndarray,
    depth_m: np.ndarray,
    faces: np.ndarray,
    boxes: np.ndarray,
    band_offsets: np.ndarray,
    face_list: np.ndarray,
    face_id: np.ndarray,
    inverse: np.ndarray,
) -> None:
    """Fill `face_id` and the inverse depth (h, w), one band of rows for each work item."""
    height = face_id.shape[0]
    for band in prange(band_offsets.shape[0] - 1):
        top, bottom = band * BAND_ROWS, min((band + 1) * BAND_ROWS, height) - 1
        for k in range(band_offsets[band], band_offsets[band + 1]):
            f = face_list[k]
            box = (boxes[f, 0], boxes[f, 1], max(boxes[f, 2], top), min(boxes[f, 3], bottom))
            _draw_face(f, box, vertices_px, depth_m, faces, face_id, inverse)


@njit(parallel=True, **NJIT_OPTIONS)
def resolve(
    vertices_px: np.ndarray,
    depth_m: np.ndarray,
    faces: np.ndarray,
    face_id: np.ndarray,
    barycentric: np.ndarray,
    depth: np.ndarray,
) -> None:
    """Fill perspective-correct barycentrics and depth of the visible face of each pixel."""
    for y in prange(face_id.shape[0]):
        for x in range(face_id.shape[1]):
            f = face_id[y, x]
            if f < 0:
                continue
            a, b, c = faces[f, 0], faces[f, 1], faces[f, 2]
            ax, ay = np.float64(vertices_px[a, 0]), np.float64(vertices_px[a, 1])
            bx, by = np.float64(vertices_px[b, 0]), np.float64(vertices_px[b, 1])
            cx, cy = np.float64(vertices_px[c, 0]), np.float64(vertices_px[c, 1])
            px, py = x + 0.5, y + 0.5
            scale = 1.0 / ((bx - ax) * (cy - ay) - (by - ay) * (cx - ax))
            q0 = ((cx - bx) * (py - by) - (cy - by) * (px - bx)) * scale / depth_m[a]
            q1 = ((ax - cx) * (py - cy) - (ay - cy) * (px - cx)) * scale / depth_m[b]
            q2 = ((bx - ax) * (py - ay) - (by - ay) * (px - ax)) * scale / depth_m[c]
            z = 1.0 / (q0 + q1 + q2)
            depth[y, x] = z
            barycentric[y, x, 0], barycentric[y, x, 1], barycentric[y, x, 2] = q0 * z, q1 * z, q2 * z


def rasterize_cpu(
    vertices_px: np.ndarray, depth_m: np.ndarray, faces: np.ndarray, height: int, width: int, near_m: float, cull: bool
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Do `pipeline.kernels.raster.rasterize` on contiguous float32 and int32 arrays."""
    boxes = face_boxes(vertices_px, depth_m, faces, (width, height), near_m, cull)
    band_offsets, face_list = bin_faces(boxes, -(-height // BAND_ROWS))
    face_id = np.full((height, width), -1, np.int32)
    inverse = np.zeros((height, width), np.float32)
    draw_bands(vertices_px, depth_m, faces, boxes, band_offsets, face_list, face_id, inverse)
    barycentric = np.zeros((height, width, 3), np.float32)
    depth = np.full((height, width), np.inf, np.float32)
    resolve(vertices_px, depth_m, faces, face_id, barycentric, depth)
    return face_id, barycentric, depth


@njit(**NJIT_OPTIONS)
def silhouette_edges_cpu(vertices_px: np.ndarray, faces: np.ndarray, adjacency: np.ndarray) -> np.ndarray:
    """Return the vertices (s, 3) int64 (start, end, apex) of every silhouette edge, by face and then by edge."""
    facing = np.empty(len(faces), np.bool_)
    for f in range(len(faces)):
        ax, ay = vertices_px[faces[f, 0], 0], vertices_px[faces[f, 0], 1]
        bx, by = vertices_px[faces[f, 1], 0], vertices_px[faces[f, 1], 1]
        cx, cy = vertices_px[faces[f, 2], 0], vertices_px[faces[f, 2], 1]
        facing[f] = (bx - ax) * (cy - ay) - (by - ay) * (cx - ax) < 0.0
    edges = np.empty((3 * len(faces), 3), np.int64)
    count = 0
    for f in range(len(faces)):
        for k in range(3):
            other = adjacency[f, k]
            if other < 0 or (facing[f] and not facing[other]):
                edges[count, 0] = faces[f, k]
                edges[count, 1] = faces[f, (k + 1) % 3]
                edges[count, 2] = faces[f, (k + 2) % 3]
                count += 1
    return edges[:count].copy()
