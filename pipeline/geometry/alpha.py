"""Images with alpha: conversion between premultiplied and straight alpha, cropping."""

import numpy as np
from jaxtyping import Float, UInt8


def unpremultiply_to_uint8(premultiplied: Float[np.ndarray, "h w 4"]) -> UInt8[np.ndarray, "h w 4"]:
    """Convert premultiplied colours and alpha in [0, 1] to an 8-bit image with straight alpha.

    Pixels with an alpha of 0 are black.
    """
    alpha = premultiplied[..., 3:]
    colour = premultiplied[..., :3] / np.maximum(alpha, 1e-6)
    return np.rint(255.0 * np.clip(np.concatenate([colour, alpha], axis=2), 0.0, 1.0)).astype(np.uint8)


def premultiply_to_float(straight: UInt8[np.ndarray, "h w 4"]) -> Float[np.ndarray, "h w 4"]:
    """Convert an 8-bit image with straight alpha to premultiplied colours and alpha in [0, 1]."""
    image = straight.astype(np.float32) / 255.0
    return np.concatenate([image[..., :3] * image[..., 3:], image[..., 3:]], axis=2)


def crop_empty_columns(image: UInt8[np.ndarray, "h w 4"]) -> UInt8[np.ndarray, "h _ 4"]:
    """Remove the columns left and right of all pixels with an alpha above 0; an empty image is returned as it is."""
    columns = np.flatnonzero(image[..., 3].any(axis=0))
    return image[:, columns[0] : columns[-1] + 1] if len(columns) else image
