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


@njit(parallel=True, **NJIT_OPTIONS)
def project_texels(mesh, texel_face, texel_barycentric, view, tolerance_m, min_cosine):
    """Return values (t, c) and weights (t, 2): see `pipeline.kernels.texel_projection.project_texels`."""
    vertices_px, depth_m, cosine, faces = mesh
    image, depth_map_m, pixel_confidence = view
    count, channels = texel_face.shape[0], image.shape[2]
    height, width = pixel_confidence.shape
    values = np.zeros((count, channels), np.float32)
    weights = np.zeros((count, 2), np.float32)
    for t in prange(count):
        a, b, c = faces[texel_face[t], 0], faces[texel_face[t], 1], faces[texel_face[t], 2]
        wa, wb, wc = texel_barycentric[t, 0], texel_barycentric[t, 1], texel_barycentric[t, 2]
        texel_cosine = wa * cosine[a] + wb * cosine[b] + wc * cosine[c]
        za, zb, zc = wa * depth_m[a], wb * depth_m[b], wc * depth_m[c]
        z = za + zb + zc
        if not (texel_cosine > min_cosine and z > 0.0):
            continue
        x = (za * vertices_px[a, 0] + zb * vertices_px[b, 0] + zc * vertices_px[c, 0]) / z - 0.5
        y = (za * vertices_px[a, 1] + zb * vertices_px[b, 1] + zc * vertices_px[c, 1]) / z - 0.5
        if not (x >= 0.0 and y >= 0.0 and x < width - 1 and y < height - 1):
            continue
        column, row = int(x), int(y)
        nearest = min(
            min(depth_map_m[row, column], depth_map_m[row, column + 1]),
            min(depth_map_m[row + 1, column], depth_map_m[row + 1, column + 1]),
        )
        if nearest < z - tolerance_m / texel_cosine:
            continue
        right, down = np.float32(x - column), np.float32(y - row)
        w00, w01 = (1 - right) * (1 - down), right * (1 - down)
        w10, w11 = (1 - right) * down, right * down
        confidence = (
            w00 * pixel_confidence[row, column]
            + w01 * pixel_confidence[row, column + 1]
            + w10 * pixel_confidence[row + 1, column]
            + w11 * pixel_confidence[row + 1, column + 1]
        )
        weights[t, 0] = confidence
        weights[t, 1] = texel_cosine
        for k in range(channels):
            values[t, k] = (
                w00 * image[row, column, k]
                + w01 * image[row, column + 1, k]
                + w10 * image[row + 1, column, k]
                + w11 * image[row + 1, column + 1, k]
            )
    return values, weights
