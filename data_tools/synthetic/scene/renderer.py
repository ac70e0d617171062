"""Render a textured skinned surface with lighting and supersampling antialiasing.

Shading: wrapped Lambert diffuse and Blinn-Phong specular of one key light, plus hemispheric ambient light, computed in
linear colour. The reflection model is Blinn, "Models of light reflection for computer synthesized pictures" (1977).
"""

from dataclasses import dataclass, replace

import numpy as np
import torch
from jaxtyping import Bool, Float
from torch import Tensor

from data_tools.synthetic.rig.subject import Subject
from pipeline.geometry.camera import Camera, project
from pipeline.geometry.colour import linear_to_srgb, srgb_to_linear
from pipeline.geometry.shadow_map import ShadowMap, render_shadow_map
from pipeline.geometry.skinning import linear_blend_skinning
from pipeline.geometry.texture_rendering import sample_texture
from pipeline.kernels.raster import rasterize


@dataclass(frozen=True)
class Light:
    """One directional key light and hemispheric ambient light.

    `key_intensity=0, ambient_intensity=1, sky_gradient=0` shows the texture without shading.

    Attributes:
        key_intensity: irradiance of the key light at normal incidence.
        key_direction: direction towards the light (world, any length > 0).
        ambient_intensity: ambient irradiance on vertical surfaces.
        sky_gradient: change of the ambient irradiance with the y component of the normal.
        specular_strength: Blinn-Phong coefficient.
        diffuse_wrap: wrap of the diffuse term around the terminator; 0 is Lambert.
        casts_shadows: the person casts shadows of the key light on itself.
        shiny_heights: the surface is specular where its height in the A-pose, as a fraction of the stature, is in this
            range.
        specular_exponent: of the Blinn-Phong term there.
        second_shiny_heights: range of heights of another material, which has the same strength; empty: none.
        second_exponent: of that material.
    """

    key_intensity: float = 0.55
    key_direction: tuple[float, float, float] = (0.45, 0.65, 0.75)
    ambient_intensity: float = 0.62
    sky_gradient: float = 0.10
    specular_strength: float = 0.0
    diffuse_wrap: float = 0.25
    casts_shadows: bool = False
    shiny_heights: tuple[float, float] = (0.0, 1.0)
    specular_exponent: float = 24.0
    second_shiny_heights: tuple[float, float] = (0.0, 0.0)
    second_exponent: float = 24.0


STUDIO = Light()
FLAT = Light(key_intensity=0.0, ambient_intensity=1.0, sky_gradient=0.0)
SHINY = Light(specular_strength=0.35)
PATCH = replace(SHINY, shiny_heights=(0.58, 0.74))
TWO_SHINES = replace(PATCH, specular_exponent=64.0, second_shiny_heights=(0.3, 0.5), second_exponent=16.0)
HARD = Light(key_intensity=0.75, ambient_intensity=0.42, diffuse_wrap=0.0, casts_shadows=True)
LIGHTING_PRESETS = {
    "studio": STUDIO,
    "flat": FLAT,
    "shiny": SHINY,
    "patch": PATCH,
    "two-shines": TWO_SHINES,
    "hard": HARD,
}


def pose_vertices(subject: Subject, canonical_to_world: Float[Tensor, "j 4 4"]) -> Float[Tensor, "v 3"]:
    """Return the vertices of the clothed surface in one pose (world, metres)."""
    body = subject.body
    weights = torch.from_numpy(body.skin_weights)
    return linear_blend_skinning(torch.from_numpy(body.vertices), weights, canonical_to_world[None])[0]


def render_subject(
    subject: Subject, vertices_world: Float[Tensor, "v 3"], camera: Camera, light: Light, samples: int
) -> Float[np.ndarray, "h w 4"]:
    """Render premultiplied sRGB and coverage, in [0, 1].

    Each pixel is the mean of `samples` x `samples` shaded samples on a regular grid. Composite with
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
    """Return left, top, width and height (px) of the projected bounding box, clipped to the image; None if empty."""
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
    """Shade one sample per pixel: premultiplied sRGB and coverage (0 or 1)."""
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
    shine = (torch.from_numpy(values)[face] for values in (shiny_faces(subject, light), face_exponents(subject, light)))
    image[seen.numpy(), :3] = shade(albedo, normal, to_camera, visibility, light, *shine).numpy()
    image[seen.numpy(), 3] = 1.0
    return image


def shiny_faces(subject: Subject, light: Light) -> Float[np.ndarray, "f"]:
    """Return 1 for faces that are specular under a light, 0 for others."""
    first, second = (_between(subject, heights) for heights in (light.shiny_heights, light.second_shiny_heights))
    return (first | second).astype(np.float32)


def face_exponents(subject: Subject, light: Light) -> Float[np.ndarray, "f"]:
    """Return the Blinn-Phong exponent of each face; `specular_exponent` where faces are not specular."""
    second = _between(subject, light.second_shiny_heights)
    return np.where(second, light.second_exponent, light.specular_exponent).astype(np.float32)


def _between(subject: Subject, heights: tuple[float, float]) -> Bool[np.ndarray, "f"]:
    """Return which faces are at these heights in the A-pose, fractions of the stature; none in an empty range."""
    height = subject.body.vertices[subject.body.faces, 1].mean(axis=1)
    low, high = subject.body.vertices[:, 1].min(), subject.body.vertices[:, 1].max()
    relative = (height - low) / (high - low)
    return np.asarray((relative >= heights[0]) & (relative <= heights[1]) & (heights[0] < heights[1]))


def _normals(vertices: Float[Tensor, "v 3"], faces: Tensor) -> Float[Tensor, "v 3"]:
    """Return area-weighted unit vertex normals."""
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
    shiny: Float[Tensor, "n"] | None = None,
    exponent: Float[Tensor, "n"] | None = None,
) -> Float[Tensor, "n 3"]:
    """Compute sRGB colours in [0, 1]: wrapped Lambert diffuse, hemispheric ambient and Blinn-Phong specular.

    Args:
        albedo: sRGB in [0, 1]; the terms are summed in linear colour.
        normal, to_camera: unit vectors in the world.
        visibility: fraction of the key light that is not shadowed, in [0, 1].
        light: the light.
        shiny: factor of the specular term; None: 1.
        exponent: of the specular term; None: that of the light.
    """
    key_direction = torch.nn.functional.normalize(torch.tensor(light.key_direction), dim=0)
    diffuse = visibility * ((normal @ key_direction + light.diffuse_wrap) / (1.0 + light.diffuse_wrap)).clamp_min(0.0)
    irradiance = light.ambient_intensity + light.sky_gradient * normal[:, 1] + light.key_intensity * diffuse
    half_vector = torch.nn.functional.normalize(key_direction + to_camera, dim=1)
    sharpness = light.specular_exponent if exponent is None else exponent
    specular = light.specular_strength * visibility * (normal * half_vector).sum(1).clamp_min(0.0) ** sharpness
    if shiny is not None:
        specular = specular * shiny
    return linear_to_srgb((srgb_to_linear(albedo) * irradiance[:, None] + specular[:, None]).clamp(0.0, 1.0))
