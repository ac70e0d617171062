"""Two vertical legs, which are one trunk above the crotch."""

import numpy as np

from pipeline.mesh.extraction.between_legs import LegGrid

LEG_X_M, LEG_RADIUS_M, CROTCH_M = 0.12, 0.06, 0.5
TRUNK_RADIUS_M = 0.18
GRID_M = 0.005


def leg_grid(
    leg_x_m: float = LEG_X_M, hem_m: float | None = None, spacing_m: float = GRID_M
) -> tuple[LegGrid, tuple[np.ndarray, ...]]:
    """The legs on a grid; coordinates of its samples."""
    axes = tuple(np.arange(low, high + 1e-4, spacing_m) for low, high in ((-0.3, 0.3), (0.0, 0.6), (-0.2, 0.2)))
    x, y, z = np.meshgrid(*axes, indexing="ij")
    legs_m = np.hypot(np.abs(x) - leg_x_m, z) - LEG_RADIUS_M
    trunk_m = np.maximum(np.hypot(x, z) - TRUNK_RADIUS_M, CROTCH_M - y)
    origin_m = np.array([axis[0] for axis in axes])
    return LegGrid(origin_m, spacing_m, np.minimum(legs_m, trunk_m), CROTCH_M, hem_m), (x, y, z)
