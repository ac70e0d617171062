"""Cast shadows: a depth picture of the person as a far light sees it (Williams, "Casting curved shadows on curved
surfaces", 1978), looked up with soft borders (percentage-closer filtering, Reeves et al. 1987)."""

from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from pipeline.geometry.mesh import Mesh
from pipeline.kernels.raster import rasterize

SHADOW_TEXEL_M = 0.003
PCF_RADIUS_PX = 2
"""Half width of the square of look-ups around a place: the border of a shadow is as soft as a small lamp's."""

NORMAL_BIAS_M = 0.012
"""Places are looked up so far off their surface, along its normal: a surface does not shade itself by rounding."""

_LIGHT_DISTANCE_M = 1000.0
"""The light's distance, at which depth is linear in float32 to a tenth of a millimetre."""

_N_VIEW_DIRECTIONS = 24
"""Directions of `find_exterior_faces`, a golden angle apart from top to bottom."""

_MARGIN_PX = 2 * PCF_RADIUS_PX + 1


@dataclass(frozen=True)
class ShadowMap:
    """Distance of what the light meets first, from a plane `_LIGHT_DISTANCE_M` before the origin; inf where it meets
    nothing.

    axes: rows are right, up and away from the light. corner: place of the picture's first pixel on right and up.
    """

    world_to_light: Float[Tensor, "3 3"]
    origin_m: Float[Tensor, "2"]
    depth: Float[Tensor, "h w"]

    def visibility(self, points: Float[Tensor, "n 3"], normals: Float[Tensor, "n 3"]) -> Float[Tensor, "n"]:
        """Share of the light that reaches each place of a surface, in [0, 1]; world, metres, unit normals."""
        points_light_m = (points + NORMAL_BIAS_M * normals) @ self.world_to_light.T
        cell = ((points_light_m[:, :2] - self.origin_m) / SHADOW_TEXEL_M).floor().long()
        height, width = self.depth.shape
        column, row = (
            cell[:, 0].clamp(PCF_RADIUS_PX, width - 1 - PCF_RADIUS_PX),
            cell[:, 1].clamp(PCF_RADIUS_PX, height - 1 - PCF_RADIUS_PX),
        )
        shifts = range(-PCF_RADIUS_PX, PCF_RADIUS_PX + 1)
        visible_samples = torch.zeros(len(points))
        for down in shifts:
            for across in shifts:
                visible_samples += (
                    self.depth[row + down, column + across] > points_light_m[:, 2] + _LIGHT_DISTANCE_M
                ).float()
        return visible_samples / len(shifts) ** 2


def render_shadow_map(
    vertices: Float[Tensor, "v 3"], faces: Int[Tensor, "f 3"], key_direction: tuple[float, float, float]
) -> ShadowMap:
    """The picture that a light in the direction `key_direction` (world, not along Y) takes of a surface."""
    away = -torch.nn.functional.normalize(torch.tensor(key_direction), dim=0)
    right = torch.nn.functional.normalize(torch.linalg.cross(away, torch.tensor([0.0, 1.0, 0.0])), dim=0)
    world_to_light = torch.stack([right, torch.linalg.cross(right, away), away])
    points_light_m = vertices @ world_to_light.T
    origin_m = points_light_m[:, :2].amin(0) - _MARGIN_PX * SHADOW_TEXEL_M
    position_px = (points_light_m[:, :2] - origin_m) / SHADOW_TEXEL_M
    width, height = (int(size) for size in position_px.amax(0).ceil() + _MARGIN_PX)
    _, _, depth = rasterize(position_px, points_light_m[:, 2] + _LIGHT_DISTANCE_M, faces, height, width)
    return ShadowMap(world_to_light, origin_m, depth)


def find_exterior_faces(mesh: Mesh) -> Bool[np.ndarray, "f"]:
    """Whether light from any of `_N_VIEW_DIRECTIONS` directions, spread evenly, reaches the middle of each face.

    What none reaches is inside: a mouth, the far side of an eye, a body beneath its clothes.
    """
    vertices, faces = torch.from_numpy(mesh.vertices).float(), torch.from_numpy(mesh.faces)
    centroids, normals = vertices[faces.long()].mean(1), torch.from_numpy(mesh.face_normals()).float()
    seen = torch.zeros(len(faces), dtype=torch.bool)
    number = np.arange(_N_VIEW_DIRECTIONS) + 0.5
    rise, angle = 1.0 - 2.0 * number / _N_VIEW_DIRECTIONS, number * np.pi * (3.0 - np.sqrt(5.0))
    for up, right, front in zip(rise, np.cos(angle), np.sin(angle), strict=True):
        level = np.sqrt(1.0 - up**2)
        shadows = render_shadow_map(vertices, faces, (float(right * level), float(up), float(front * level)))
        seen |= shadows.visibility(centroids, normals) > 0
    return seen.numpy()
