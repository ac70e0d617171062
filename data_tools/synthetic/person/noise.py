"""Solid procedural noise: a function of position alone, so that it has no seams wherever it is painted."""

import numpy as np
from jaxtyping import Float
from scipy.ndimage import map_coordinates

_LATTICE = 32


class ValueNoise:
    """Periodic value noise on a random lattice (Perlin's "solid texture"); the same seed gives the same field."""

    def __init__(self, seed: int) -> None:
        self._values = np.random.default_rng(seed).uniform(-1.0, 1.0, (_LATTICE,) * 3).astype(np.float32)

    def __call__(
        self, points: Float[np.ndarray, "n 3"], wavelength_m: float | tuple[float, float, float], order: int = 1
    ) -> Float[np.ndarray, "n"]:
        """Values in about [-1, 1].

        wavelength_m: size of a lattice cell, per axis when three are given. order: spline order, 1 for colours,
        3 where the slope must be continuous (displacements). The field repeats after 32 cells.
        """
        cells = points.T / np.broadcast_to(np.asarray(wavelength_m, dtype=np.float32), 3)[:, None]
        return map_coordinates(self._values, cells, order=order, mode="grid-wrap", prefilter=order > 1)

    def fractal(
        self, points: Float[np.ndarray, "n 3"], wavelength_m: float, octaves: int = 3
    ) -> Float[np.ndarray, "n"]:
        """Sum of octaves, each half as coarse and half as strong; in about [-1, 1]."""
        total = np.zeros(len(points), dtype=np.float32)
        for octave in range(octaves):
            total += self(points + 7.31 * octave, wavelength_m / 2**octave) / 2**octave
        return total / (2.0 - 2.0 ** (1 - octaves))
