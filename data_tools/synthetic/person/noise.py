"""Solid procedural noise: a function of the 3D position, so textures made from it have no UV seams."""

import numpy as np
from jaxtyping import Float
from scipy.ndimage import map_coordinates

_LATTICE = 32


class ValueNoise:
    """Periodic value noise on a random lattice of 32 cells; equal seeds give equal fields.

    Solid textures: Perlin, "An image synthesizer", 1985.
    """

    def __init__(self, seed: int) -> None:
        self._values = np.random.default_rng(seed).uniform(-1.0, 1.0, (_LATTICE,) * 3).astype(np.float32)

    def __call__(
        self, points: Float[np.ndarray, "n 3"], wavelength_m: float | tuple[float, float, float], order: int = 1
    ) -> Float[np.ndarray, "n"]:
        """Evaluate the noise, in about [-1, 1].

        Args:
            points: metres.
            wavelength_m: size of a lattice cell, one for all axes or one per axis.
            order: of the spline; 1 for colours, 3 for displacements, which need a continuous slope.
        """
        cells = points.T / np.broadcast_to(np.asarray(wavelength_m, dtype=np.float32), 3)[:, None]
        return map_coordinates(self._values, cells, order=order, mode="grid-wrap", prefilter=order > 1)

    def fractal(
        self, points: Float[np.ndarray, "n 3"], wavelength_m: float, octaves: int = 3
    ) -> Float[np.ndarray, "n"]:
        """Evaluate the normalised sum of octaves with halved wavelength and amplitude, in about [-1, 1]."""
        total = np.zeros(len(points), dtype=np.float32)
        for octave in range(octaves):
            total += self(points + 7.31 * octave, wavelength_m / 2**octave) / 2**octave
        return total / (2.0 - 2.0 ** (1 - octaves))
