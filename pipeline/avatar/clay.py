"""Clay renders and normal maps: the shape of a mesh without its texture.

Clay is matte grey under one key light that is fixed to the camera, above and left of it, and ambient light that is
brighter from above. The key light grazes surfaces that face the camera, which makes dents and bumps visible.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import cv2
import numpy as np
import torch
from jaxtyping import Float, UInt8
from torch import Tensor

from pipeline.geometry.alpha import crop_empty_columns, unpremultiply_to_uint8
from pipeline.geometry.camera import Camera, project
from pipeline.geometry.colour import linear_to_srgb
from pipeline.geometry.mesh import Mesh
from pipeline.geometry.texture_rendering import turntable_cameras
from pipeline.kernels.raster import rasterize

ALBEDO = 0.62
"""Linear reflectance of the clay."""

KEY_DIRECTION_CAMERA = (-0.60, -0.62, -0.50)
"""Towards the key light; camera axes: x right, y down, z forward."""

KEY_IRRADIANCE = 1.15
AMBIENT_IRRADIANCE, AMBIENT_GRADIENT = 0.16, 0.09
"""Ambient irradiance on vertical surfaces, and its change with the upward component of the normal."""

SUPERSAMPLING = 2
"""Samples per pixel along each axis."""

HEAD_FRACTION = 0.15
"""The head is this uppermost fraction of the stature."""

Views = list[UInt8[np.ndarray, "_ _ 4"]]


@dataclass(frozen=True)
class ClayViews:
    """Views of one mesh: sRGB with straight alpha.

    Attributes:
        smooth: clay with interpolated vertex normals, as a viewer shows the exported mesh.
        flat: clay with face normals: the triangles.
        normals: interpolated normals as colours, (n + 1) / 2, in the axes of the vertices.
    """

    smooth: Views
    flat: Views
    normals: Views

    def cropped(self) -> "ClayViews":
        """Return the views without the empty columns left and right of the body."""
        return ClayViews(
            *([crop_empty_columns(view) for view in row] for row in (self.smooth, self.flat, self.normals))
        )


def render_clay(mesh: Mesh, vertex_normals: Float[np.ndarray, "v 3"], views: int, height_px: int) -> ClayViews:
    """Render the whole body in clay and as normal map; cameras and cropping as in `TexturedAvatar.render_turntable`.

    Args:
        mesh: m, +Y up.
        vertex_normals: of unit length.
        views: number of views.
        height_px: height of each image.
    """
    box_m = mesh.vertices.min(axis=0), mesh.vertices.max(axis=0)
    return render_clay_views(mesh, vertex_normals, turntable_cameras(*box_m, views, height_px)).cropped()


def render_clay_head(mesh: Mesh, vertex_normals: Float[np.ndarray, "v 3"], views: int, height_px: int) -> Views:
    """Render the head of a standing person in clay with interpolated normals; arguments as in `render_clay`."""
    return render_clay_views(mesh, vertex_normals, head_cameras(mesh, views, height_px)).cropped().smooth


def head_cameras(mesh: Mesh, views: int, height_px: int) -> list[Camera]:
    """Return cameras around the head of a standing person (m, +Y up), as `turntable_cameras`."""
    top_m, bottom_m = float(mesh.vertices[:, 1].max()), float(mesh.vertices[:, 1].min())
    neck_m = top_m - HEAD_FRACTION * (top_m - bottom_m)
    head = mesh.vertices[mesh.vertices[:, 1] > neck_m]
    box_m = np.minimum(head.min(axis=0), [np.inf, neck_m, np.inf]), head.max(axis=0)
    return turntable_cameras(*box_m, views, height_px)


def shade_clay(normals: Float[Tensor, "n 3"], world_to_camera: Float[np.ndarray, "4 4"]) -> Float[Tensor, "n"]:
    """Return the grey level (sRGB in [0, 1]) of clay with these unit normals (world, +Y up)."""
    towards_key = torch.nn.functional.normalize(torch.tensor(KEY_DIRECTION_CAMERA), dim=0)
    key = normals @ (torch.from_numpy(world_to_camera[:3, :3].copy()).float().T @ towards_key)
    irradiance = AMBIENT_IRRADIANCE + AMBIENT_GRADIENT * normals[:, 1] + KEY_IRRADIANCE * key.clamp_min(0.0)
    return linear_to_srgb((ALBEDO * irradiance).clamp(0.0, 1.0))


def render_clay_views(mesh: Mesh, vertex_normals: Float[np.ndarray, "v 3"], cameras: Sequence[Camera]) -> ClayViews:
    """Render one view of a mesh (m, world, +Y up) for each camera, of the size of its image."""
    vertices, faces = torch.from_numpy(mesh.vertices).float(), torch.from_numpy(mesh.faces)
    of_vertices, of_faces = (torch.from_numpy(each).float() for each in (vertex_normals, mesh.face_normals()))
    made = ClayViews([], [], [])
    for camera in cameras:
        fine = camera.scaled(float(SUPERSAMPLING))
        face_id, barycentric, _ = rasterize(*project(vertices, fine), faces, fine.height, fine.width)
        seen = face_id >= 0
        face = face_id[seen].long()
        smooth = (of_vertices[faces[face].long()] * barycentric[seen][..., None]).sum(1)
        smooth = torch.nn.functional.normalize(smooth, dim=1)
        grey = [shade_clay(normals, camera.world_to_camera)[:, None] for normals in (smooth, of_faces[face])]
        for views, colours in zip((made.smooth, made.flat, made.normals), (*grey, 0.5 * smooth + 0.5), strict=True):
            samples = np.zeros((fine.height, fine.width, 4), dtype=np.float32)
            samples[seen.numpy()] = torch.cat([colours.expand(-1, 3), torch.ones(len(face), 1)], dim=1).numpy()
            pixels = cv2.resize(samples, (camera.width, camera.height), interpolation=cv2.INTER_AREA)
            views.append(unpremultiply_to_uint8(pixels))
    return made
