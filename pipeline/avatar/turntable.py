"""Render a turntable sheet of a mesh in its canonical pose: colours in the upper row, shaded geometry below."""

import numpy as np
import torch
from jaxtyping import Float, UInt8

from pipeline.geometry.differentiable_raster import face_adjacency, render_attributes, render_shaded
from pipeline.geometry.mesh import Mesh
from pipeline.geometry.texture_rendering import turntable_camera
from pipeline.mesh.views import Shader

LIGHT_DIRECTION_CAMERA = np.array([-0.35, 0.45, 0.82])


@torch.no_grad()
def turntable_sheet(
    mesh: Mesh, shader: Shader, views: int = 6, height_px: int = 640, width_px: int = 360
) -> UInt8[np.ndarray, "h w 3"]:
    """Render two rows of `views` images on white at evenly spaced azimuths, the first from the front.

    The upper row shows the colours of `shader`, the lower row the Lambert-shaded grey surface.
    """
    vertices, faces = torch.from_numpy(mesh.vertices), torch.from_numpy(mesh.faces.astype(np.int64))
    adjacency, normals = face_adjacency(faces), mesh.vertex_normals()
    rows: tuple[list[torch.Tensor], list[torch.Tensor]] = ([], [])
    for angle in np.arange(views) * (2.0 * np.pi / views):
        camera = turntable_camera(mesh.vertices.min(axis=0), mesh.vertices.max(axis=0), angle, width_px, height_px)
        image, alpha, _ = render_shaded(vertices, faces, camera, vertices, shader, adjacency)
        rows[0].append(image + 1.0 - alpha[..., None])
        grey = _lambert_shading(normals, camera.world_to_camera[:3, :3])
        image, alpha = render_attributes(vertices, faces, camera, grey, adjacency)
        rows[1].append((image + 1.0 - alpha[..., None]).expand(-1, -1, 3))
    sheet = torch.cat([torch.cat(row, dim=1) for row in rows], dim=0)
    return (255.0 * sheet.clamp(0.0, 1.0)).round().to(torch.uint8).numpy()


def _lambert_shading(
    normals: Float[np.ndarray, "v 3"], world_to_camera: Float[np.ndarray, "3 3"]
) -> Float[torch.Tensor, "v 1"]:
    """Return Lambert shading per vertex, in [0.18, 0.9], under a light fixed to the camera.

    Camera axes: x right, y down, z forward.
    """
    right, down, forward = world_to_camera
    x, y, z = LIGHT_DIRECTION_CAMERA
    light = (x * right - y * down - z * forward).astype(np.float32)
    lit = 0.18 + 0.72 * np.clip(normals @ light, 0.0, 1.0)
    return torch.from_numpy(lit[:, None].astype(np.float32))
