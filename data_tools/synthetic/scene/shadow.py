"""Cast shadows: a depth picture of the person as a far light sees it (Williams, "Casting curved shadows on curved
surfaces", 1978), looked up with soft borders (percentage-closer filtering, Reeves et al. 1987)."""

from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from pipeline.geometry.mesh import Mesh
from pipeline.kernels.raster import rasterize

PIXEL_M = 0.003
SOFT_PX = 2
"""Half width of the square of look-ups around a place: the border of a shadow is as soft as a small lamp's."""

LIFT_M = 0.012
"""Places are looked up so far off their surface, along its normal: a surface does not shade itself by rounding."""

_FAR_M = 1000.0
"""The light's distance, at which depth is linear in float32 to a tenth of a millimetre."""

_AROUND = 24
"""Directions of `seen_from_outside`, a golden angle apart from top to bottom."""

_MARGIN_PX = 2 * SOFT_PX + 1


@dataclass(frozen=True)
class ShadowMap:
    """Distance of what the light meets first, from a plane `_FAR_M` before the origin; inf where it meets nothing.

    axes: rows are right, up and away from the light. corner: place of the picture's first pixel on right and up.
    """

    axes: Float[Tensor, "3 3"]
    corner: Float[Tensor, "2"]
    depth: Float[Tensor, "h w"]

    def lit(self, points: Float[Tensor, "n 3"], normals: Float[Tensor, "n 3"]) -> Float[Tensor, "n"]:
        """Share of the light that reaches each place of a surface, in [0, 1]; world, metres, unit normals."""
        along = (points + LIFT_M * normals) @ self.axes.T
        cell = ((along[:, :2] - self.corner) / PIXEL_M).floor().long()
        height, width = self.depth.shape
        column, row = cell[:, 0].clamp(SOFT_PX, width - 1 - SOFT_PX), cell[:, 1].clamp(SOFT_PX, height - 1 - SOFT_PX)
        shifts = range(-SOFT_PX, SOFT_PX + 1)
        reached = torch.zeros(len(points))
        for down in shifts:
            for across in shifts:
                reached += (self.depth[row + down, column + across] > along[:, 2] + _FAR_M).float()
        return reached / len(shifts) ** 2


def cast_shadows(
    vertices: Float[Tensor, "v 3"], faces: Int[Tensor, "f 3"], key_from: tuple[float, float, float]
) -> ShadowMap:
    """The picture that a light in the direction `key_from` (world, not along Y) takes of a surface."""
    away = -torch.nn.functional.normalize(torch.tensor(key_from), dim=0)
    right = torch.nn.functional.normalize(torch.linalg.cross(away, torch.tensor([0.0, 1.0, 0.0])), dim=0)
    axes = torch.stack([right, torch.linalg.cross(right, away), away])
    along = vertices @ axes.T
    corner = along[:, :2].amin(0) - _MARGIN_PX * PIXEL_M
    position_px = (along[:, :2] - corner) / PIXEL_M
    width, height = (int(size) for size in position_px.amax(0).ceil() + _MARGIN_PX)
    _, _, depth = rasterize(position_px, along[:, 2] + _FAR_M, faces, height, width)
    return ShadowMap(axes, corner, depth)


def seen_from_outside(mesh: Mesh) -> Bool[np.ndarray, "f"]:
    """Whether light from any of `_AROUND` directions, spread evenly, reaches the middle of each face.

    What none reaches is inside: a mouth, the far side of an eye, a body beneath its clothes.
    """
    vertices, faces = torch.from_numpy(mesh.vertices).float(), torch.from_numpy(mesh.faces)
    middles, normals = vertices[faces.long()].mean(1), torch.from_numpy(mesh.face_normals()).float()
    seen = torch.zeros(len(faces), dtype=torch.bool)
    number = np.arange(_AROUND) + 0.5
    rise, angle = 1.0 - 2.0 * number / _AROUND, number * np.pi * (3.0 - np.sqrt(5.0))
    for up, right, front in zip(rise, np.cos(angle), np.sin(angle), strict=True):
        level = np.sqrt(1.0 - up**2)
        shadows = cast_shadows(vertices, faces, (float(right * level), float(up), float(front * level)))
        seen |= shadows.lit(middles, normals) > 0
    return seen.numpy()
