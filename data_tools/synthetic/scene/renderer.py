"""Lit, antialiased pictures of a textured skinned surface: what the synthetic camera sees."""

from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from data_tools.synthetic.rig.subject import Subject
from data_tools.synthetic.scene.shadow import ShadowMap, render_shadow_map
from pipeline.geometry.camera import Camera, project
from pipeline.geometry.colour import linear_to_srgb, srgb_to_linear
from pipeline.geometry.skinning import linear_blend_skinning
from pipeline.geometry.texture_rendering import sample_texture
from pipeline.kernels.raster import rasterize


@dataclass(frozen=True)
class Light:
    """One key light from a fixed direction of the world, and ambient light that is stronger from above.

    A key of 0 and an ambient of 1 with no sky shows the bare texture (shadow-free). wrap: how far the key reaches round
    the terminator (0: Lambert). casts_shadows: the person hides the key from parts of the person.
    """

    key: float = 0.55
    key_direction: tuple[float, float, float] = (0.45, 0.65, 0.75)
    ambient: float = 0.62
    sky_gradient: float = 0.10
    specular_strength: float = 0.0
    diffuse_wrap: float = 0.25
    casts_shadows: bool = False


STUDIO = Light()
FLAT = Light(key=0.0, ambient=1.0, sky_gradient=0.0)
SHINY = Light(specular_strength=0.35)
HARD = Light(key=0.75, ambient=0.42, diffuse_wrap=0.0, casts_shadows=True)
LIGHTING_PRESETS = {"studio": STUDIO, "flat": FLAT, "shiny": SHINY, "hard": HARD}

BLINN_PHONG_EXPONENT = 24.0


def pose_vertices(subject: Subject, canonical_to_world: Float[Tensor, "j 4 4"]) -> Float[Tensor, "v 3"]:
    """The clothed surface in one pose, world, metres."""
    body = subject.body
    weights = torch.from_numpy(body.skin_weights)
    return linear_blend_skinning(torch.from_numpy(body.vertices), weights, canonical_to_world[None])[0]


def render_subject(
    subject: Subject, vertices_world: Float[Tensor, "v 3"], camera: Camera, light: Light, samples: int
) -> Float[np.ndarray, "h w 4"]:
    """sRGB colours premultiplied by coverage, and the coverage, in [0, 1].

    Each pixel is the mean of `samples` x `samples` shaded look-ups at regular places. Composite with
    ``rgb + (1 - coverage) * background``.
    """
    image = np.zeros((camera.height, camera.width, 4), dtype=np.float32)
    window = _bounding_window_px(vertices_world, camera)
    if window is None:
        return image
    left, top, width, height = window
    supersampled_camera = camera.cropped(left, top, width, height).scaled(float(samples))
    faces = torch.from_numpy(subject.body.faces)
    shadows = render_shadow_map(vertices_world, faces, light.key_direction) if light.casts_shadows else None
    shaded = _shade_window(subject, vertices_world, supersampled_camera, light, shadows)
    mean = shaded.reshape(height, samples, width, samples, 4).mean(axis=(1, 3))
    image[top : top + height, left : left + width] = mean
    return image


def _bounding_window_px(vertices_world: Float[Tensor, "v 3"], camera: Camera) -> tuple[int, int, int, int] | None:
    """Left, top, width and height (px) of the part of the image that the surface can touch; None when it is outside."""
    position_px, _ = project(vertices_world, camera)
    size = torch.tensor([camera.width, camera.height])
    low = position_px.amin(0).floor().clamp_min(0).int()
    high = torch.minimum(position_px.amax(0).ceil(), size).int()
    if bool((high <= low).any()):
        return None
    return int(low[0]), int(low[1]), int(high[0] - low[0]), int(high[1] - low[1])


def _shade_window(
    subject: Subject, vertices_world: Float[Tensor, "v 3"], camera: Camera, light: Light, shadows: ShadowMap | None
) -> Float[np.ndarray, "h w 4"]:
    """One shaded look-up a pixel."""
    faces, faces_uv = torch.from_numpy(subject.body.faces), torch.from_numpy(subject.faces_uv)
    position_px, depth_m = project(vertices_world, camera)
    face_id, barycentric, _ = rasterize(position_px, depth_m, faces, camera.height, camera.width)
    seen = face_id >= 0
    face, blend = face_id[seen].long(), barycentric[seen][:, :, None]
    uv = (torch.from_numpy(subject.uv)[faces_uv[face].long()] * blend).sum(1)
    albedo = sample_texture(subject.texture_tensor(), uv)
    normals = _normals(vertices_world, faces)
    corners = faces[face].long()
    normal = torch.nn.functional.normalize((normals[corners] * blend).sum(1), dim=1)
    point = (vertices_world[corners] * blend).sum(1)
    to_camera = torch.nn.functional.normalize(torch.from_numpy(camera.centre_m()) - point, dim=1)
    image = np.zeros((camera.height, camera.width, 4), dtype=np.float32)
    visibility = shadows.visibility(point, normal) if shadows else torch.ones(len(point))
    image[seen.numpy(), :3] = shade(albedo, normal, to_camera, visibility, light).numpy()
    image[seen.numpy(), 3] = 1.0
    return image


def _normals(vertices: Float[Tensor, "v 3"], faces: Tensor) -> Float[Tensor, "v 3"]:
    """Area-weighted vertex normals."""
    corners = vertices[faces.long()]
    cross = torch.linalg.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    normals = torch.zeros_like(vertices)
    for corner in range(3):
        normals.index_add_(0, faces[:, corner].long(), cross)
    return torch.nn.functional.normalize(normals, dim=1)


def shade(
    albedo: Float[Tensor, "n 3"],
    normal: Float[Tensor, "n 3"],
    to_camera: Float[Tensor, "n 3"],
    visibility: Float[Tensor, "n"],
    light: Light,
) -> Float[Tensor, "n 3"]:
    """sRGB colours under the light: Lambert with a wrapped key light, hemispheric ambient, Blinn-Phong shine.

    All directions are unit vectors in the world; albedo is sRGB, the sum is taken in linear light. lit: share of the
    key light that nothing hides.
    """
    key_direction = torch.nn.functional.normalize(torch.tensor(light.key_direction), dim=0)
    diffuse = visibility * ((normal @ key_direction + light.diffuse_wrap) / (1.0 + light.diffuse_wrap)).clamp_min(0.0)
    irradiance = light.ambient + light.sky_gradient * normal[:, 1] + light.key * diffuse
    half_vector = torch.nn.functional.normalize(key_direction + to_camera, dim=1)
    specular = (
        light.specular_strength * visibility * (normal * half_vector).sum(1).clamp_min(0.0) ** BLINN_PHONG_EXPONENT
    )
    return linear_to_srgb((srgb_to_linear(albedo) * irradiance[:, None] + specular[:, None]).clamp(0.0, 1.0))
