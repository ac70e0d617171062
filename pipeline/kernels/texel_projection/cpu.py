"""Compiled loop of projective texturing. Each thread writes whole texels, so that the result is deterministic.

Notation: b barycentrics, z depth; a point of a face is at pixel sum(b_k z_k p_k) / sum(b_k z_k), where p_k are the
pixels of its corners.
"""

from typing import NamedTuple

import numpy as np
from numba import njit, prange

from pipeline.kernels.common.numba_options import NJIT_OPTIONS


class MeshArrays(NamedTuple):
    """See `pipeline.kernels.texel_projection.inputs.ProjectedMesh`."""

    vertices_px: np.ndarray
    depth_m: np.ndarray
    cosine: np.ndarray
    faces: np.ndarray


class ViewArrays(NamedTuple):
    """See `pipeline.kernels.texel_projection.inputs.ImageView`."""

    image: np.ndarray
    depth_map_m: np.ndarray
    pixel_confidence: np.ndarray


class Lookup(NamedTuple):
    """Where a visible texel lies in the image: the upper left of four pixels, and the fractions to the others."""

    confidence: np.float32
    cosine: np.float32
    row: int
    column: int
    right: np.float32
    down: np.float32


@njit(**NJIT_OPTIONS)
def _look_up(mesh, face, barycentric, view, tolerance_m, min_cosine):
    """Return the `Lookup` of a texel; its confidence is negative if the texel is invisible."""
    vertices_px, depth_m, cosine, faces = mesh
    _, depth_map_m, pixel_confidence = view
    height, width = pixel_confidence.shape
    hidden = Lookup(np.float32(-1.0), np.float32(0.0), 0, 0, np.float32(0.0), np.float32(0.0))
    a, b, c = faces[face, 0], faces[face, 1], faces[face, 2]
    wa, wb, wc = barycentric[0], barycentric[1], barycentric[2]
    texel_cosine = wa * cosine[a] + wb * cosine[b] + wc * cosine[c]
    za, zb, zc = wa * depth_m[a], wb * depth_m[b], wc * depth_m[c]
    z = za + zb + zc
    if not (texel_cosine > min_cosine and z > 0.0):
        return hidden
    x = (za * vertices_px[a, 0] + zb * vertices_px[b, 0] + zc * vertices_px[c, 0]) / z - 0.5
    y = (za * vertices_px[a, 1] + zb * vertices_px[b, 1] + zc * vertices_px[c, 1]) / z - 0.5
    if not (x >= 0.0 and y >= 0.0 and x < width - 1 and y < height - 1):
        return hidden
    column, row = int(x), int(y)
    nearest = min(
        min(depth_map_m[row, column], depth_map_m[row, column + 1]),
        min(depth_map_m[row + 1, column], depth_map_m[row + 1, column + 1]),
    )
    if nearest < z - tolerance_m / texel_cosine:
        return hidden
    right, down = np.float32(x - column), np.float32(y - row)
    confidence = (
        (1 - right) * (1 - down) * pixel_confidence[row, column]
        + right * (1 - down) * pixel_confidence[row, column + 1]
        + (1 - right) * down * pixel_confidence[row + 1, column]
        + right * down * pixel_confidence[row + 1, column + 1]
    )
    return Lookup(np.float32(confidence), np.float32(texel_cosine), row, column, right, down)


@njit(**NJIT_OPTIONS)
def _bilinear(image, seen, channel):
    """Return the value of one channel at a `Lookup`."""
    row, column, right, down = seen.row, seen.column, seen.right, seen.down
    return (
        (1 - right) * (1 - down) * image[row, column, channel]
        + right * (1 - down) * image[row, column + 1, channel]
        + (1 - right) * down * image[row + 1, column, channel]
        + right * down * image[row + 1, column + 1, channel]
    )


@njit(parallel=True, **NJIT_OPTIONS)
def project_texels(mesh, texel_face, texel_barycentric, view, tolerance_m, min_cosine):
    """Return values (t, c) and weights (t, 2): see `pipeline.kernels.texel_projection.project_texels`."""
    count, channels = texel_face.shape[0], view.image.shape[2]
    values = np.zeros((count, channels), np.float32)
    weights = np.zeros((count, 2), np.float32)
    for t in prange(count):
        seen = _look_up(mesh, texel_face[t], texel_barycentric[t], view, tolerance_m, min_cosine)
        if seen.confidence >= 0.0:
            weights[t, 0] = seen.confidence
            weights[t, 1] = seen.cosine
            for k in range(channels):
                values[t, k] = _bilinear(view.image, seen, k)
    return values, weights


@njit(parallel=True, **NJIT_OPTIONS)
def add_projections(sums, mesh, texel_face, texel_barycentric, view, weighting):
    """Add to `sums`: see `pipeline.kernels.texel_projection.add_projections_`."""
    total, total_weight = sums
    view_weight, cosine_power, tolerance_m, min_cosine = weighting
    for t in prange(texel_face.shape[0]):
        seen = _look_up(mesh, texel_face[t], texel_barycentric[t], view, tolerance_m, min_cosine)
        if seen.confidence > 0.0:
            power = seen.cosine * seen.cosine if cosine_power == 2.0 else seen.cosine**cosine_power
            weight = np.float32(seen.confidence * power * view_weight)
            total_weight[t] += weight
            for k in range(total.shape[1]):
                total[t, k] += weight * _bilinear(view.image, seen, k)
