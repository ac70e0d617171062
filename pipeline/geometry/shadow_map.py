"""Shadow map of a directional light, with percentage-closer filtering, and a test for exterior faces.

Shadow maps: Williams, "Casting curved shadows on curved surfaces", 1978. Percentage-closer filtering: Reeves, Salesin
and Cook, "Rendering antialiased shadows with depth maps", 1987. Light coordinates: right, up, away from the light.
"""

from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from pipeline.geometry.mesh import Mesh
from pipeline.kernels.raster import rasterize

SHADOW_TEXEL_M = 0.003
PCF_RADIUS_PX = 2
"""Radius of the square percentage-closer filter, in texels."""

NORMAL_BIAS_M = 0.012
"""Offset of query points along their normal, which prevents self-shadowing by rounding (shadow acne)."""

_LIGHT_DISTANCE_M = 1000.0
"""Distance of the depth origin; float32 depth then has a resolution of 0.1 mm."""

_MAX_UPRIGHT = 0.99
"""Vertical component from which on a light comes from above or below, and Z instead of Y defines the up axis."""

_N_VIEW_DIRECTIONS = 24
"""Directions of `find_exterior_faces`, on a golden-angle (Fibonacci) spiral."""

_MARGIN_PX = 2 * PCF_RADIUS_PX + 1


@dataclass(frozen=True)
class ShadowMap:
    """Depth of the first surface along the light direction.

    Attributes:
        world_to_light: rotation; rows are right, up and away from the light.
        origin_m: right and up coordinates of the first texel.
        depth: metres from the plane `_LIGHT_DISTANCE_M` in front of the world origin; inf where there is no surface.
    """

    world_to_light: Float[Tensor, "3 3"]
    origin_m: Float[Tensor, "2"]
    depth: Float[Tensor, "h w"]

    def visibility(self, points: Float[Tensor, "n 3"], normals: Float[Tensor, "n 3"]) -> Float[Tensor, "n"]:
        """Return the fraction of the light that reaches each surface point, in [0, 1].

        points: world, metres. normals: unit vectors.
        """
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
    """Rasterise the depth of a surface (world, metres) as seen by a directional light.

    key_direction: towards the light, in the world; any length > 0.
    """
    away = -torch.nn.functional.normalize(torch.tensor(key_direction), dim=0)
    across = torch.tensor([0.0, 1.0, 0.0] if abs(float(away[1])) < _MAX_UPRIGHT else [0.0, 0.0, 1.0])
    right = torch.nn.functional.normalize(torch.linalg.cross(away, across), dim=0)
    world_to_light = torch.stack([right, torch.linalg.cross(right, away), away])
    points_light_m = vertices @ world_to_light.T
    origin_m = points_light_m[:, :2].amin(0) - _MARGIN_PX * SHADOW_TEXEL_M
    position_px = (points_light_m[:, :2] - origin_m) / SHADOW_TEXEL_M
    width, height = (int(size) for size in position_px.amax(0).ceil() + _MARGIN_PX)
    _, _, depth = rasterize(position_px, points_light_m[:, 2] + _LIGHT_DISTANCE_M, faces, height, width)
    return ShadowMap(world_to_light, origin_m, depth)


def find_exterior_faces(mesh: Mesh) -> Bool[np.ndarray, "f"]:
    """Return which faces are visible from outside, by shadow maps from `_N_VIEW_DIRECTIONS` uniform directions.

    A face is exterior if its centroid is visible from at least one direction. Interior faces are, for example, the
    mouth cavity, the back of an eyeball, or skin under clothes.
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
