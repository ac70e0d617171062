"""The light of a video: irradiance by the surface normal, a key light that casts shadows, and a gain a frame.

The person turns and the lamps do not, so the irradiance is a function of the world normal n:

    E(n) = sum_i L_i Y_i(n) + K v max(0, n . d),

with real spherical harmonics Y_i up to degree 2, which hold 99 % of the energy of the irradiance of distant light
(Ramamoorthi and Hanrahan, "An efficient representation for irradiance environment maps", 2001), and a key light of
irradiance K from direction d, which a surface point sees (v = 1) or not (v = 0). A linear colour of the video is
albedo * E(n) * gain of the frame. The scale of each channel of E is a convention: the mean log E of what is observed
is 0, so that an unlit avatar is about as bright as the video.
"""

from dataclasses import dataclass, fields
from pathlib import Path

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from pipeline.core.command import rerun_command
from pipeline.core.errors import UserError
from pipeline.geometry.mesh import area_weighted_vertex_normals
from pipeline.geometry.shadow_map import render_shadow_map
from pipeline.io.npz import load_npz, save_npz

TERMS = ("1", "x", "y", "z", "xy", "yz", "3zz-1", "xz", "xx-yy")
"""The functions of `spherical_harmonics` at a unit vector (x, y, z)."""

MATTE_EXPONENT = 1.0
"""Exponent that is written for a surface without highlights."""

MIN_LAMP_IRRADIANCE = 0.2
"""Smallest irradiance of a lamp that makes highlights, relative to the mean."""

MIN_IRRADIANCE = 0.05
"""Smallest irradiance relative to the mean: degree 2 may be negative far from the lamps."""


@dataclass(frozen=True)
class VideoLight:
    """Light and exposure of a video, in linear RGB.

    Attributes:
        coefficients: of `spherical_harmonics`, one column a channel.
        key_irradiance: of a surface that faces the key light; 0 without a key light.
        key_direction: towards the key light, unit, world.
        gain: exposure of each selected frame relative to the mean, in the order of the capture.
    """

    coefficients: Float[np.ndarray, "9 3"]
    key_irradiance: Float[np.ndarray, "3"]
    key_direction: Float[np.ndarray, "3"]
    gain: Float[np.ndarray, "n"]

    @staticmethod
    def uniform(frames: int) -> "VideoLight":
        """Return the light that shows a texture as it is, for a number of selected frames."""
        coefficients = np.zeros((9, 3), dtype=np.float32)
        coefficients[0] = 1.0
        upwards = np.array([0.0, 1.0, 0.0], dtype=np.float32)
        return VideoLight(coefficients, np.zeros(3, dtype=np.float32), upwards, np.ones(frames, dtype=np.float32))

    @property
    def is_uniform(self) -> bool:
        """Whether the irradiance is 1 everywhere."""
        return not self.casts_shadows and not self.coefficients[1:].any() and bool((self.coefficients[0] == 1.0).all())

    @property
    def casts_shadows(self) -> bool:
        """Whether there is a key light."""
        return bool(self.key_irradiance.any())

    def irradiance(
        self, normals: Float[np.ndarray, "k 3"], visibility: Float[np.ndarray, "k"]
    ) -> Float[np.ndarray, "k 3"]:
        """Return E at unit normals (world); visibility: of the key light, in [0, 1]. At least `MIN_IRRADIANCE`."""
        lambert = visibility * np.maximum(normals @ self.key_direction, 0.0)
        smooth = spherical_harmonics(normals) @ self.coefficients
        return np.maximum(smooth + lambert[:, None] * self.key_irradiance, MIN_IRRADIANCE).astype(np.float32)

    def dominant_direction(self) -> Float[np.ndarray, "3"]:
        """Return the direction from which most light comes: the optimal linear direction of the luminance.

        Sloan, "Stupid spherical harmonics tricks", 2008. Upwards under a light that comes from everywhere.
        """
        vector = self.coefficients[1:4].mean(axis=1) + self.key_irradiance.mean() * self.key_direction
        length = float(np.linalg.norm(vector))
        return vector / length if length > 0 else np.array([0.0, 1.0, 0.0])

    def lamp_irradiance(self, direction: Float[np.ndarray, "3"]) -> float:
        """Return the irradiance that the lamp in a direction adds, at a surface that faces it."""
        if self.casts_shadows:
            return max(float(self.key_irradiance.mean()), MIN_LAMP_IRRADIANCE)
        facing, away = self.irradiance(np.stack([direction, -direction]), np.ones(2)).mean(axis=1)
        return max(float(facing - away), MIN_LAMP_IRRADIANCE)

    def shade_vertices(
        self, vertices_world: Float[Tensor, "v 3"], faces: Tensor, frame: int | None = None
    ) -> Float[Tensor, "v 3"]:
        """Return the irradiance of each vertex of a posed mesh (m, world), times the gain of a selected frame.

        frame: position in the capture; None for the mean exposure.
        """
        if self.is_uniform:
            return torch.full_like(vertices_world, self._gain(frame))
        normals = area_weighted_vertex_normals(vertices_world, faces)
        seen = self.visibility(vertices_world, faces, normals)
        return torch.from_numpy(self._gain(frame) * self.irradiance(normals.numpy(), seen.numpy()))

    def _gain(self, frame: int | None) -> float:
        return 1.0 if frame is None else float(self.gain[frame])

    def shade_specular(
        self,
        vertices_world: Float[Tensor, "v 3"],
        faces: Tensor,
        frame: int | None,
        gloss: "VertexGloss",
        camera_centre_m: Float[np.ndarray, "3"],
    ) -> Float[Tensor, "v 4"]:
        """Return `shade_vertices`, and the radiance of the highlight of each vertex as a fourth column.

        camera_centre_m: world.
        """
        normals = area_weighted_vertex_normals(vertices_world, faces)
        seen = self.visibility(vertices_world, faces, normals).numpy()
        to_camera = torch.nn.functional.normalize(torch.from_numpy(camera_centre_m).float() - vertices_world, dim=1)
        exponent = None if gloss.roughness is None else exponent_of_roughness(gloss.roughness.numpy())
        lobe = torch.from_numpy(gloss.highlights.lobe(normals.numpy(), to_camera.numpy(), seen, exponent)).float()
        irradiance = torch.from_numpy(self.irradiance(normals.numpy(), seen))
        return self._gain(frame) * torch.cat([irradiance, (gloss.strength * lobe)[:, None]], dim=1)

    def visibility(
        self, vertices_world: Float[Tensor, "v 3"], faces: Tensor, normals: Float[Tensor, "v 3"]
    ) -> Float[Tensor, "v"]:
        """Return the fraction of the key light that reaches each vertex, in [0, 1]; 1 without a key light."""
        if not self.casts_shadows:
            return torch.ones(len(normals))
        return key_visibility(vertices_world, faces, normals, self.key_direction)


@dataclass(frozen=True)
class Highlights:
    """The specular lobe of the surface under the lamp of a video: Blinn-Phong.

    Attributes:
        direction: towards the lamp, unit, world.
        exponent: of the cosine between normal and half vector.
    """

    direction: Float[np.ndarray, "3"]
    exponent: float

    @staticmethod
    def none() -> "Highlights":
        """Return a lobe for a matte surface, whose strength is 0 everywhere."""
        return Highlights(np.array([0.0, 1.0, 0.0], dtype=np.float32), MATTE_EXPONENT)

    @property
    def roughness(self) -> float:
        """The roughness of glTF with the same width of the lobe."""
        return float(roughness_of_exponent(np.array([self.exponent]))[0])

    def lobe(
        self,
        normals: Float[np.ndarray, "k 3"],
        to_camera: Float[np.ndarray, "k 3"],
        visibility: Float[np.ndarray, "k"],
        exponent: Float[np.ndarray, "k"] | None = None,
    ) -> Float[np.ndarray, "k"]:
        """Return the highlight at surface points relative to its peak, in [0, 1]; 0 where the lamp is behind.

        normals, to_camera: unit, world. visibility: of the lamp, in [0, 1]. exponent: of each point; None: of the lobe.
        """
        half = self.direction + to_camera
        half /= np.maximum(np.linalg.norm(half, axis=1, keepdims=True), 1e-9)
        cosine = np.maximum(np.sum(normals * half, axis=1), 0.0)
        own = self.exponent if exponent is None else exponent
        return np.asarray(visibility * (normals @ self.direction > 0.0) * cosine**own)


@dataclass(frozen=True)
class VertexGloss:
    """Highlights of the vertices of a mesh.

    Attributes:
        highlights: the lamp and the lobe.
        strength: linear radiance that a highlight adds at its peak.
        roughness: glTF's, of each vertex; None: that of the lobe.
    """

    highlights: Highlights
    strength: Float[Tensor, "v"]
    roughness: Float[Tensor, "v"] | None = None


def roughness_of_exponent(exponent: Float[np.ndarray, "*n"]) -> Float[np.ndarray, "*n"]:
    """Return glTF's roughness of Blinn-Phong lobes: alpha^2 = 2 / (exponent + 2), alpha = roughness^2.

    Walter et al., "Microfacet models for refraction through rough surfaces", 2007.
    """
    return np.asarray((2.0 / (exponent + 2.0)) ** 0.25)


def exponent_of_roughness(roughness: Float[np.ndarray, "*n"]) -> Float[np.ndarray, "*n"]:
    """Return the inverse of `roughness_of_exponent`; roughness: above 0."""
    return np.asarray(2.0 / roughness**4 - 2.0)


def directional_light(direction: tuple[float, float, float], ambient: float) -> VideoLight:
    """Return a white key light of irradiance 1 with cast shadows, and uniform ambient light.

    direction: towards the light, world, any length > 0. ambient: irradiance without the key light.
    """
    coefficients = np.zeros((9, 3), dtype=np.float32)
    coefficients[0] = ambient
    towards = np.array(direction, dtype=np.float32)
    return VideoLight(coefficients, np.ones(3, np.float32), towards / np.linalg.norm(towards), np.ones(1, np.float32))


def spherical_harmonics(directions: Float[np.ndarray, "k 3"]) -> Float[np.ndarray, "k 9"]:
    """Evaluate real spherical harmonics up to degree 2 at unit vectors: orthogonal, the constant is 1."""
    x, y, z = directions.astype(np.float64).T
    return np.stack(
        [np.ones_like(x), x, y, z, x * y, y * z, 3.0 * z * z - 1.0, x * z, x * x - y * y],
        axis=1,
    )


def key_visibility(
    vertices_world: Float[Tensor, "v 3"],
    faces: Tensor,
    normals: Float[Tensor, "v 3"],
    key_direction: Float[np.ndarray, "3"],
) -> Float[Tensor, "v"]:
    """Return the fraction of the key light that other parts of the mesh let through to each vertex, in [0, 1]."""
    x, y, z = (float(value) for value in key_direction)
    return render_shadow_map(vertices_world, faces, (x, y, z)).visibility(vertices_world, normals)


_LIGHT_ARRAYS = tuple(field.name for field in fields(VideoLight))
_HIGHLIGHT_DIRECTION, _HIGHLIGHT_EXPONENT = "highlight_direction", "highlight_exponent"


def save_light(path: Path, light: VideoLight, highlights: Highlights) -> None:
    """Write light.npz; `load_light` is the inverse."""
    arrays = {name: getattr(light, name).astype(np.float32) for name in _LIGHT_ARRAYS}
    arrays[_HIGHLIGHT_DIRECTION] = highlights.direction.astype(np.float32)
    arrays[_HIGHLIGHT_EXPONENT] = np.float32(highlights.exponent)
    save_npz(path, arrays)


def load_light(path: Path) -> tuple[VideoLight, Highlights]:
    """Read the file of `save_light`.

    Raises:
        UserError: the file is missing, is no npz, or lacks an array.
    """
    arrays = load_npz(path)
    missing = [name for name in (*_LIGHT_ARRAYS, _HIGHLIGHT_DIRECTION, _HIGHLIGHT_EXPONENT) if name not in arrays]
    if missing:
        raise UserError(f"{path} lacks the array {missing[0]}; run {rerun_command('texture', path.parent)}")
    light = VideoLight(*(arrays[name] for name in _LIGHT_ARRAYS))
    return light, Highlights(arrays[_HIGHLIGHT_DIRECTION], float(arrays[_HIGHLIGHT_EXPONENT]))
