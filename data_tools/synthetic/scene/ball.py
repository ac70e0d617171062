"""A ball that somebody juggles: it passes before the person, elsewhere in each frame."""

from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Float

from data_tools.synthetic.scene.renderer import Light, shade
from pipeline.geometry.camera import Camera, pixel_rays

RADIUS_M = 0.11
AHEAD_M = 0.45
"""How far before the person it flies."""
LOWEST, HIGHEST, ASIDE = 0.25, 0.70, 0.13
"""Its lowest and highest place and how far it strays from the middle, in heights of the person."""
BOUNCE_S, SWAY_S = 1.1, 2.7
WHITE, DARK = 0.92, 0.25


@dataclass(frozen=True)
class Ball:
    """A ball before a person of this height who stands on `ground_m`, between the person and the world's origin."""

    ground_m: Float[np.ndarray, "3"]
    height_m: float

    def centre_m(self, time_s: float) -> Float[np.ndarray, "3"]:
        """Where it is: parabolas up and down, a slow sway to the sides."""
        part = 2.0 * ((time_s / BOUNCE_S) % 1.0) - 1.0
        up = LOWEST + (HIGHEST - LOWEST) * (1.0 - part**2)
        aside = ASIDE * np.sin(2.0 * np.pi * time_s / SWAY_S)
        return self.ground_m + [aside * self.height_m, up * self.height_m, AHEAD_M]

    def picture(self, camera: Camera, time_s: float, light: Light, samples: int) -> Float[np.ndarray, "h w 4"]:
        """Premultiplied sRGB and coverage in [0, 1], each pixel the mean of `samples` x `samples` rays."""
        fine = camera.scaled(float(samples))
        rows, columns = torch.meshgrid(torch.arange(fine.height), torch.arange(fine.width), indexing="ij")
        origin, direction = pixel_rays(fine, torch.stack([columns, rows], dim=-1).reshape(-1, 2).float() + 0.5)
        to_centre = torch.from_numpy(self.centre_m(time_s)).float() - origin
        along = (to_centre * direction).sum(1)
        inside = RADIUS_M**2 - (to_centre.square().sum(1) - along**2)
        hit = torch.nonzero((inside > 0) & (along > 0))[:, 0]
        point = (along[hit] - inside[hit].sqrt())[:, None] * direction[hit]
        normal = (point - to_centre[hit]) / RADIUS_M
        patches = torch.sin(9.0 * normal).prod(dim=1) > 0.25
        albedo = torch.where(patches, DARK, WHITE)[:, None].expand(-1, 3)
        image = torch.zeros(len(direction), 4)
        image[hit, :3] = shade(albedo, normal, -direction[hit], torch.ones(len(hit)), light)
        image[hit, 3] = 1.0
        return image.reshape(camera.height, samples, camera.width, samples, 4).mean(dim=(1, 3)).numpy()
