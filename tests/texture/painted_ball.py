"""A rotating painted ball with two knobs that occlude it, rendered for a static camera: ground truth for the bake."""

import math

import numpy as np
import torch
import trimesh

from pipeline.geometry.atlas import Atlas, rasterize_texels, unwrap
from pipeline.geometry.camera import Camera
from pipeline.geometry.mesh import Mesh
from pipeline.geometry.texture_rendering import render_textured
from pipeline.io.image import to_uint8
from pipeline.texture.bake import TexturedSurface
from pipeline.texture.edge_padding import fill_unknown_texels
from pipeline.texture.views import BakeView, crop_bake_view

SIZE_PX = 256
CAMERA = Camera(fx=420.0, fy=420.0, cx=100.0, cy=105.0, width=200, height=210)
DISTANCE_M = 3.0


def ball_mesh() -> Mesh:
    parts = [trimesh.creation.icosphere(subdivisions=3, radius=0.5)]
    for side in (-1.0, 1.0):
        knob = trimesh.creation.icosphere(subdivisions=2, radius=0.12)
        knob.apply_translation([side * 0.66, 0.1, 0.0])
        parts.append(knob)
    whole = trimesh.util.concatenate(parts)
    return Mesh(np.array(whole.vertices, dtype=np.float32), np.array(whole.faces, dtype=np.int32))


def ball_atlas(mesh: Mesh) -> Atlas:
    return unwrap(mesh, (mesh.vertices[mesh.faces].mean(axis=1)[:, 1] > 0).astype(np.int32), SIZE_PX, padding_px=4)


def ball_colours(points: np.ndarray) -> np.ndarray:
    """Colours of surface points: smooth waves with wavelengths of 0.3 to 0.5 m."""
    return (0.5 + 0.35 * np.sin(np.array([17.0, 21.0, 13.0]) * points + np.array([0.3, 1.0, 2.0]))).astype(np.float32)


def turned(vertices: np.ndarray, angle: float) -> torch.Tensor:
    """World positions: rotated about +Y and slightly about +X, in front of the camera, which looks along -Z."""
    c, s = math.cos(angle), math.sin(angle)
    tilt = 0.35 * math.sin(2.0 * angle)
    turn = np.array([[c, 0, s], [0, 1, 0], [-s, 0, c]])
    lean = np.array([[1, 0, 0], [0, math.cos(tilt), -math.sin(tilt)], [0, math.sin(tilt), math.cos(tilt)]])
    return torch.from_numpy((vertices @ (lean @ turn).T + [0.0, 0.0, -DISTANCE_M]).astype(np.float32))


class PaintedBall:
    """The true texture, and views from `count` evenly spaced angles on a green background."""

    def __init__(self, count: int, shift_px: float = 0.0, angles: np.ndarray | None = None) -> None:
        self.mesh = ball_mesh()
        self.atlas = ball_atlas(self.mesh)
        self.texels = rasterize_texels(self.atlas, SIZE_PX)
        self.surface = TexturedSurface.from_arrays(self.mesh.faces, self.atlas, self.texels)
        self.truth = ball_colours(self.texels.interpolate(self.mesh.faces, self.mesh.vertices))
        self._fine_truth = true_texture(self.mesh, self.atlas)
        angles = 2.0 * math.pi * np.arange(count) / count if angles is None else angles
        random = np.random.default_rng(0)
        self.views = [self._render_view(angle, random.normal(size=2) * shift_px) for angle in angles]

    def _render_view(self, angle: float, shift_px: np.ndarray) -> BakeView:
        """A view whose image is shifted by `shift_px` against the camera, as under a wrong pose."""
        vertices = turned(self.mesh.vertices, angle)
        filmed = Camera(CAMERA.fx, CAMERA.fy, CAMERA.cx + shift_px[0], CAMERA.cy + shift_px[1], 200, 210)
        faces_and_uv = (self.surface.faces, self.surface.faces_uv, self.surface.uv)
        rgba = render_textured(vertices, *faces_and_uv, self._fine_truth, filmed, supersampling=4).numpy()
        green = rgba[..., :3] + (1.0 - rgba[..., 3:]) * np.array([0.0, 1.0, 0.0])
        return crop_bake_view(to_uint8(green), to_uint8(rgba[..., 3]), CAMERA, vertices, self.surface.faces)


def true_texture(mesh: Mesh, atlas: Atlas) -> torch.Tensor:
    """The true texture at four times the size, with filled gutters."""
    texels = rasterize_texels(atlas, 4 * SIZE_PX)
    values = ball_colours(texels.interpolate(mesh.faces, mesh.vertices))
    return torch.from_numpy(fill_unknown_texels(texels.to_texture(values), texels.coverage_mask()))
