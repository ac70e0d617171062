"""How well the training frames show each part of the surface, judged by the fitted body in their poses.

Where frames do not show a surface, or at grazing angles only, the density there is arbitrary: clothes on the back of a
person filmed from the front, the neck under the chin, soles, armpits. Where all frames show it from nearly the same
side, its depth is arbitrary.
"""

from collections.abc import Sequence

import numpy as np
import torch
from jaxtyping import Float

from pipeline.body.body import Body
from pipeline.geometry.camera import project
from pipeline.kernels.raster import rasterize
from pipeline.mesh.views import PosedView
from pipeline.texture.views import vertex_view_cosine

ENOUGH_EVIDENCE = 0.05
"""Mean over frames of the squared cosine between normal and view direction from which on a vertex counts as seen, with
0 in frames that do not show it. On a full turn a convex surface has 0.25."""
ENOUGH_SPREAD = 0.04
"""One minus the length of the mean direction to the camera, weighted by the squared cosines, from which on frames tell
the depth of a vertex. A full turn has 0.15, an arc of 90 degrees 0.08, of 40 degrees 0.02."""
DEPTH_SHARE = 0.5
"""Part of its evidence that a vertex loses whose depth no frame tells: its outline is seen all the same."""
DEPTH_TOLERANCE_M = 0.02
"""Distance behind the nearest surface up to which a vertex is visible."""


def surface_evidence(body: Body, views: Sequence[PosedView]) -> Float[np.ndarray, "v"]:
    """Return how well the views show each body vertex: 0 if none does, 1 where enough do from sides that differ enough.

    views: at least one.
    """
    vertices, weights = torch.from_numpy(body.vertices), torch.from_numpy(body.skin_weights)
    faces = torch.from_numpy(body.faces)
    total, direction = torch.zeros(len(vertices)), torch.zeros(len(vertices), 3)
    nearest_joint = weights.argmax(dim=1)
    for view in views:
        posed, camera = view.pose_vertices(vertices, weights), view.camera
        cosine = vertex_view_cosine(posed, faces, camera)
        vertices_px, depth_m = project(posed, camera)
        _, _, nearest_m = rasterize(vertices_px, depth_m, faces, camera.height, camera.width)
        column, row = vertices_px.floor().long().unbind(dim=1)
        inside = (column >= 0) & (column < camera.width) & (row >= 0) & (row < camera.height) & (cosine > 0.0)
        shown = torch.zeros_like(inside)
        shown[inside] = depth_m[inside] < nearest_m[row[inside], column[inside]] + DEPTH_TOLERANCE_M
        weight = shown * cosine.square()
        towards = torch.nn.functional.normalize(torch.from_numpy(camera.centre_m()).to(posed) - posed, dim=1)
        rotation = view.canonical_to_world[nearest_joint, :3, :3]
        total += weight
        direction += weight[:, None] * (towards[:, None] @ rotation)[:, 0]
    spread = 1.0 - direction.norm(dim=1) / total.clamp_min(1e-12)
    seen = (total / len(views) / ENOUGH_EVIDENCE).clamp(0.0, 1.0)
    depth = (spread / ENOUGH_SPREAD).clamp(0.0, 1.0)
    return (seen * (1.0 - DEPTH_SHARE * (1.0 - depth))).numpy()
