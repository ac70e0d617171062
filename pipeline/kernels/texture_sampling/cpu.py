"""Compiled loops of lookups at rasterised points. A thread writes whole rows of pixels: the result is deterministic."""

import numpy as np
from numba import njit, prange

from pipeline.kernels.common.numba_options import NJIT_OPTIONS


@njit(parallel=True, **NJIT_OPTIONS)
def supersample_texture_cpu(
    face_id: np.ndarray,
    barycentric: np.ndarray,
    faces_uv: np.ndarray,
    uv: np.ndarray,
    texture: np.ndarray,
    samples: int,
) -> np.ndarray:
    """Return the image (h, w, c + 1): see `pipeline.kernels.texture_sampling.supersample_texture`."""
    height, width = face_id.shape[0] // samples, face_id.shape[1] // samples
    texture_height, texture_width, channels = texture.shape
    image = np.zeros((height, width, channels + 1), np.float32)
    sample_weight = np.float32(1.0 / (samples * samples))
    for row in prange(height):
        for fine_row in range(row * samples, (row + 1) * samples):
            for fine_column in range(width * samples):
                face = face_id[fine_row, fine_column]
                if face < 0:
                    continue
                u, v = np.float32(0.0), np.float32(0.0)
                for k in range(3):
                    corner = faces_uv[face, k]
                    u += barycentric[fine_row, fine_column, k] * uv[corner, 0]
                    v += barycentric[fine_row, fine_column, k] * uv[corner, 1]
                # `max` returns its second argument only if that is larger, which NaN is not: NaN becomes zero.
                x = min(max(np.float32(0.0), u * texture_width - np.float32(0.5)), np.float32(texture_width - 1))
                y = min(
                    max(np.float32(0.0), (np.float32(1.0) - v) * texture_height - np.float32(0.5)),
                    np.float32(texture_height - 1),
                )
                left, top = int(x), int(y)
                right, bottom = min(left + 1, texture_width - 1), min(top + 1, texture_height - 1)
                across, down = x - np.float32(left), y - np.float32(top)
                column = fine_column // samples
                image[row, column, channels] += sample_weight
                for c in range(channels):
                    upper = texture[top, left, c] + across * (texture[top, right, c] - texture[top, left, c])
                    lower = texture[bottom, left, c] + across * (texture[bottom, right, c] - texture[bottom, left, c])
                    image[row, column, c] += sample_weight * (upper + down * (lower - upper))
    return image


@njit(parallel=True, **NJIT_OPTIONS)
def supersample_attributes_cpu(
    face_id: np.ndarray, barycentric: np.ndarray, faces: np.ndarray, values: np.ndarray, samples: int
) -> np.ndarray:
    """Return the image (h, w, c): see `pipeline.kernels.texture_sampling.supersample_attributes`."""
    height, width, channels = face_id.shape[0] // samples, face_id.shape[1] // samples, values.shape[1]
    image = np.zeros((height, width, channels), np.float32)
    for row in prange(height):
        for column in range(width):
            covered = np.float32(0.0)
            for fine_row in range(row * samples, (row + 1) * samples):
                for fine_column in range(column * samples, (column + 1) * samples):
                    face = face_id[fine_row, fine_column]
                    if face < 0:
                        continue
                    covered += np.float32(1.0)
                    for k in range(3):
                        weight = barycentric[fine_row, fine_column, k]
                        for c in range(channels):
                            image[row, column, c] += weight * values[faces[face, k], c]
            if covered > 1.0:
                for c in range(channels):
                    image[row, column, c] /= covered
    return image
