"""A juggled ball that occludes the person at a different position in each frame."""

from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Float

from data_tools.synthetic.scene.renderer import Light, shade
from pipeline.geometry.camera import Camera, pixel_rays

RADIUS_M = 0.11
DISTANCE_TO_PERSON_M = 0.45
"""Distance from the person towards the camera, along +Z."""
MIN_HEIGHT_RATIO, MAX_HEIGHT_RATIO, MAX_SIDEWAYS_RATIO = 0.25, 0.70, 0.13
"""Range of its height above the ground and largest sideways offset, in units of the person's height."""
BOUNCE_PERIOD_S, SWAY_PERIOD_S = 1.1, 2.7
LIGHT_ALBEDO, DARK_ALBEDO = 0.92, 0.25


@dataclass(frozen=True)
class Ball:
    """A ball between the camera and a person of this height who stands at `ground_m` (world, metres)."""

    ground_m: Float[np.ndarray, "3"]
    height_m: float

    def centre_m(self, time_s: float) -> Float[np.ndarray, "3"]:
        """Return its centre (world, metres): parabolic bounces and a slow sideways oscillation."""
        phase = 2.0 * ((time_s / BOUNCE_PERIOD_S) % 1.0) - 1.0
        height_ratio = MIN_HEIGHT_RATIO + (MAX_HEIGHT_RATIO - MIN_HEIGHT_RATIO) * (1.0 - phase**2)
        sideways_ratio = MAX_SIDEWAYS_RATIO * np.sin(2.0 * np.pi * time_s / SWAY_PERIOD_S)
        return self.ground_m + [sideways_ratio * self.height_m, height_ratio * self.height_m, DISTANCE_TO_PERSON_M]

    def render_rgba(self, camera: Camera, time_s: float, light: Light, samples: int) -> Float[np.ndarray, "h w 4"]:
        """Render premultiplied sRGB and coverage in [0, 1]; each pixel is the mean of `samples` x `samples` rays."""
        supersampled_camera = camera.scaled(float(samples))
        rows, columns = torch.meshgrid(
            torch.arange(supersampled_camera.height), torch.arange(supersampled_camera.width), indexing="ij"
        )
        origin, direction = pixel_rays(
            supersampled_camera, torch.stack([columns, rows], dim=-1).reshape(-1, 2).float() + 0.5
        )
        to_centre = torch.from_numpy(self.centre_m(time_s)).float() - origin
        depth_along_ray = (to_centre * direction).sum(1)
        discriminant = RADIUS_M**2 - (to_centre.square().sum(1) - depth_along_ray**2)
        hit = torch.nonzero((discriminant > 0) & (depth_along_ray > 0))[:, 0]
        point = (depth_along_ray[hit] - discriminant[hit].sqrt())[:, None] * direction[hit]
        normal = (point - to_centre[hit]) / RADIUS_M
        patches = torch.sin(9.0 * normal).prod(dim=1) > 0.25
        albedo = torch.where(patches, DARK_ALBEDO, LIGHT_ALBEDO)[:, None].expand(-1, 3)
        image = torch.zeros(len(direction), 4)
        image[hit, :3] = shade(albedo, normal, -direction[hit], torch.ones(len(hit)), light)
        image[hit, 3] = 1.0
        return image.reshape(camera.height, samples, camera.width, samples, 4).mean(dim=(1, 3)).numpy()
