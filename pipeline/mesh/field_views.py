"""Renders of the field as training views of the mesh, from cameras that did not film the pose.

The second stage of IHM (Wang et al. 2025, section 2.3) aligns the mesh with renders of the field instead of frames of
the video. Here they are added to the frames.
"""

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from pipeline.body.body import Body
from pipeline.capture.frame_selection import evenly_spaced
from pipeline.core.progress import track
from pipeline.field.field import RadianceField
from pipeline.field.occupancy import BinaryOccupancy
from pipeline.field.rendering import render_field
from pipeline.field.skin_grid import build_skin_grid, skin_margin_m
from pipeline.geometry.alpha import unpremultiply_to_uint8
from pipeline.geometry.camera import Camera, project
from pipeline.geometry.rotation import axis_angle_to_matrix
from pipeline.mesh.views import PosedView

AZIMUTH_STEP_RAD = np.pi * (3.0 - np.sqrt(5.0))
"""Golden angle: any number of successive azimuths is spread over the circle."""
ELEVATIONS_RAD = tuple(np.radians((15.0, -15.0, 35.0)))
"""Elevations of successive cameras above the filming camera; none is zero, so that no camera is one that filmed."""
BODY_MARGIN_RATIO = 0.12
"""Margin of the image around the fitted body, which has no hair or clothes; a fraction of its height in the image."""


def render_field_views(
    field: RadianceField, occupancy: BinaryOccupancy, body: Body, views: Sequence[PosedView], count: int
) -> list[PosedView]:
    """Render the field in the poses of at most `count` of the views, each from a camera in another direction.

    The cameras are on spheres around the posed body, at the distance of the filming camera.

    Args:
        field, occupancy: the trained field.
        body: the fitted body, which places the cameras.
        views: filmed views; evenly spaced ones are used.
        count: largest number of renders; more than there are views gives one for each view.
    """
    vertices, weights = torch.from_numpy(body.vertices), torch.from_numpy(body.skin_weights)
    skin = build_skin_grid(body, skin_margin_m(body, occupancy.bounds_m.cpu().numpy()))
    renders = []
    for number, k in enumerate(track(evenly_spaced(len(views), count).tolist(), "rendering the field")):
        view = views[k]
        elevation_rad = ELEVATIONS_RAD[number % len(ELEVATIONS_RAD)]
        posed = view.pose_vertices(vertices, weights)
        camera = orbit_camera(view.camera, posed, (number + 1) * AZIMUTH_STEP_RAD, elevation_rad)
        rgba = render_field(field, occupancy, body, view.canonical_to_world, camera, skin).numpy()
        straight = torch.from_numpy(unpremultiply_to_uint8(rgba))
        renders.append(PosedView(straight[..., :3].contiguous(), straight[..., 3], camera, view.canonical_to_world))
    return renders


def orbit_camera(camera: Camera, posed: Float[Tensor, "v 3"], azimuth_rad: float, elevation_rad: float) -> Camera:
    """Move a camera on a sphere around the centre of a posed body; its image is the box of the body with a margin.

    Args:
        camera: the camera; focal length and distance to the centre of the body stay.
        posed: vertices of the body, m, world.
        azimuth_rad: angle around +Y of the world, counter-clockwise from above.
        elevation_rad: angle about the horizontal axis of the camera, positive upwards.
    """
    centre = (0.5 * (posed.amin(0) + posed.amax(0))).double().numpy()
    right = camera.world_to_camera[0, :3].astype(np.float64)
    axis_angles = np.stack([np.array([0.0, azimuth_rad, 0.0]), -elevation_rad * right])
    turn, lift = axis_angle_to_matrix(torch.from_numpy(axis_angles)).numpy()
    # The new camera sees what the old one would see of the world turned the opposite way about the centre.
    world_turn = np.eye(4)
    world_turn[:3, :3] = (turn @ lift).T
    world_turn[:3, 3] = centre - world_turn[:3, :3] @ centre
    moved = replace(camera, world_to_camera=(camera.world_to_camera @ world_turn).astype(np.float32))
    pixels = project(posed, moved)[0].numpy()
    low, high = pixels.min(axis=0), pixels.max(axis=0)
    margin = BODY_MARGIN_RATIO * (high[1] - low[1])
    left, top = (int(value) for value in np.floor(low - margin))
    width, height = (int(value) for value in np.ceil(high - low + 2.0 * margin))
    return moved.cropped(left, top, width, height)
