"""The ceiling of novel views and poses: the true mesh with the best texture that does not change with the light.

An avatar is unlit, so its texture can contain the light of the video only as a mean over the frames. The ceiling is the
true mesh in the true pose with the true texture, multiplied at each vertex by its mean brightness in training frames.
Under flat light that is the true texture itself, and only the samples per pixel differ from the truth.
"""

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from data_tools.evaluate.comparison import Comparison
from data_tools.synthetic.rig.subject import Subject
from data_tools.synthetic.scene.renderer import pose_vertices, shade
from pipeline.capture.frame_selection import TRAIN, evenly_spaced
from pipeline.geometry.camera import Camera, project
from pipeline.geometry.mesh import area_weighted_vertex_normals
from pipeline.geometry.shadow_map import render_shadow_map
from pipeline.geometry.texture_rendering import sample_texture
from pipeline.kernels.raster import rasterize

MAX_FRAMES = 48
_GREY = 0.5
"""Colour (sRGB) whose brightness under the light stands for that of all colours."""

_BACK_FACING_WEIGHT = 1e-3


def static_brightness(comparison: Comparison) -> Float[Tensor, "v"]:
    """Return the brightness of each true vertex under the light, relative to the texture, as a mean over the video.

    The mean is over training frames, at most `MAX_FRAMES`, weighted by the cosine between normal and viewing direction.
    """
    truth, light, capture = comparison.truth, comparison.truth.light, comparison.run.capture
    positions = capture.positions(TRAIN)
    chosen = positions[evenly_spaced(len(positions), MAX_FRAMES)]
    faces = torch.from_numpy(truth.subject.body.faces)
    summed, weight = (torch.zeros(len(truth.subject.body.vertices)) for _ in range(2))
    for frame in capture.frame_index[chosen].tolist():
        vertices = pose_vertices(truth.subject, truth.canonical_to_world[frame])
        normals = area_weighted_vertex_normals(vertices, faces)
        to_camera = torch.nn.functional.normalize(torch.from_numpy(truth.camera.centre_m()) - vertices, dim=1).float()
        shadows = render_shadow_map(vertices, faces, light.key_direction) if light.casts_shadows else None
        visibility = shadows.visibility(vertices, normals) if shadows else torch.ones(len(vertices))
        grey = torch.full((len(vertices), 3), _GREY)
        view_cosine = (normals * to_camera).sum(1).clamp_min(_BACK_FACING_WEIGHT)
        summed += view_cosine * shade(grey, normals, to_camera, visibility, light)[:, 0] / _GREY
        weight += view_cosine
    return summed / weight


def render_static(
    subject: Subject,
    vertices_world: Float[Tensor, "v 3"],
    brightness: Float[Tensor, "v"],
    camera: Camera,
    samples: int,
) -> Float[np.ndarray, "h w 4"]:
    """Render the true texture times the brightness of the vertices: premultiplied sRGB and coverage, in [0, 1].

    samples: per pixel and axis.
    """
    fine = camera.scaled(float(samples))
    faces = torch.from_numpy(subject.body.faces)
    face_id, barycentric, _ = rasterize(*project(vertices_world, fine), faces, fine.height, fine.width)
    seen = face_id >= 0
    face, blend = face_id[seen].long(), barycentric[seen]
    uv = (torch.from_numpy(subject.uv)[torch.from_numpy(subject.faces_uv)[face].long()] * blend[..., None]).sum(1)
    gain = (brightness[faces[face].long()] * blend).sum(1)
    colours = (sample_texture(subject.texture_tensor(), uv) * gain[:, None]).clamp(0.0, 1.0)
    image = torch.zeros(fine.height, fine.width, 4)
    image[seen] = torch.cat([colours, torch.ones(len(face), 1)], dim=1)
    return image.reshape(camera.height, samples, camera.width, samples, 4).mean(dim=(1, 3)).numpy()
