"""The part of the true surface that the frames of a capture show.

The inside of a coat, or legs under a skirt, are part of the true surface but of no picture: what an avatar has there is
a guess, and so is its distance from the truth.
"""

import numpy as np
import torch
from jaxtyping import Bool

from data_tools.evaluate.comparison import MatchedRigs
from pipeline.geometry.camera import project
from pipeline.kernels.raster import rasterize
from pipeline.texture.views import vertex_view_cosine

MIN_TOLERANCE_M = 0.003
"""Distance behind the nearest surface up to which a vertex is shown; at least the width of a pixel there."""
MIN_COSINE = 0.1
"""Cosine between normal and view direction from which on a vertex is shown."""
FRAME_STEP = 2
"""Every second frame is looked at."""


def shown_faces(rigs: MatchedRigs) -> Bool[np.ndarray, "f"]:
    """Return which exterior faces of the truth (`MatchedRigs.true_faces`) have corners that frames show."""
    truth, camera = rigs.truth, rigs.truth.camera
    faces = torch.from_numpy(rigs.true_faces.astype(np.int64))
    shown = np.zeros(len(truth.subject.body.vertices), dtype=bool)
    for pose in truth.canonical_to_world[::FRAME_STEP]:
        vertices = torch.from_numpy(rigs.true_surface(pose).vertices).float()
        vertices_px, depth_m = project(vertices, camera)
        nearest_m = rasterize(vertices_px, depth_m, faces, camera.height, camera.width)[2]
        column, row = vertices_px.floor().long().unbind(dim=1)
        inside = (column >= 0) & (column < camera.width) & (row >= 0) & (row < camera.height)
        inside &= vertex_view_cosine(vertices, faces, camera) > MIN_COSINE
        tolerance_m = (depth_m / camera.fx).clamp_min(MIN_TOLERANCE_M)
        in_front = (depth_m - tolerance_m)[inside] < nearest_m[row[inside], column[inside]]
        shown[np.flatnonzero(inside.numpy())[in_front.numpy()]] = True
    return shown[rigs.true_faces].all(axis=1)
