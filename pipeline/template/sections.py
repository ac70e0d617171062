"""Horizontal sections of a mesh: where the surface is in front, behind, and in any direction at a height."""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float

from pipeline.geometry.mesh import Mesh

SLICE_M = 0.01
"""Distance of the horizontal sections that are searched."""


@dataclass(frozen=True)
class Section:
    """Line segments in a plane of constant height. ends_m: x and z of both ends of each segment."""

    ends_m: Float[np.ndarray, "s 2 2"]

    def depth_range_m(self, x_m: float) -> tuple[float, float]:
        """Return the smallest and the largest z of the section at an x; nan where it has none."""
        first, second = self.ends_m[:, 0], self.ends_m[:, 1]
        crosses = (first[:, 0] > x_m) != (second[:, 0] > x_m)
        if not crosses.any():
            return float("nan"), float("nan")
        first, second = first[crosses], second[crosses]
        z_m = first[:, 1] + (x_m - first[:, 0]) / (second[:, 0] - first[:, 0]) * (second[:, 1] - first[:, 1])
        return float(z_m.min()), float(z_m.max())

    def exit_point_m(
        self, origin_m: Float[np.ndarray, "2"], towards: Float[np.ndarray, "2"]
    ) -> Float[np.ndarray, "2"] | None:
        """Return where a ray of the plane (x and z) leaves the section last; None where it meets nothing."""
        across = np.array([-towards[1], towards[0]])
        offset = (self.ends_m - origin_m) @ np.stack([towards, across], axis=1)
        first, second = offset[:, 0], offset[:, 1]
        crosses = (first[:, 1] > 0.0) != (second[:, 1] > 0.0)
        first, second = first[crosses], second[crosses]
        distance_m = first[:, 0] + first[:, 1] / (first[:, 1] - second[:, 1]) * (second[:, 0] - first[:, 0])
        distance_m = distance_m[distance_m > 0.0]
        return None if not len(distance_m) else np.asarray(origin_m + distance_m.max() * towards)


def cut_at_height(mesh: Mesh, height_m: float) -> Section:
    """Return the section of a mesh at y = `height_m`."""
    corners = mesh.vertices[mesh.faces].astype(np.float64)
    above = corners[..., 1] > height_m
    corners, above = corners[above.any(axis=1) != above.all(axis=1)], above[above.any(axis=1) != above.all(axis=1)]
    # the corner that is alone on its side, then the two others
    alone = np.argmax(above == (above.sum(axis=1, keepdims=True) == 1), axis=1)
    turned = np.take_along_axis(corners, ((alone[:, None] + np.arange(3)) % 3)[..., None], axis=1)
    apex, others = turned[:, :1], turned[:, 1:]
    fraction = (height_m - apex[..., 1]) / (others[..., 1] - apex[..., 1])
    return Section((apex + fraction[..., None] * (others - apex))[..., [0, 2]])
