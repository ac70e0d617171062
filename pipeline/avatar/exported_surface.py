"""The surface of an exported avatar as a viewer shows it at rest: with the face that moves and the file's normals."""

from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Float, UInt8

from pipeline.avatar.clay import head_cameras
from pipeline.geometry.alpha import crop_empty_columns, unpremultiply_to_uint8
from pipeline.geometry.mesh import Mesh
from pipeline.geometry.texture_rendering import render_textured
from pipeline.io.glb import GlbFile
from pipeline.io.image import to_float


@dataclass(frozen=True)
class ExportedSurface:
    """The triangles of an exported .glb, in its rest pose.

    Attributes:
        mesh: m, +Y up.
        vertex_normals: of unit length.
        uv: origin bottom-left.
        base_colour: sRGB; row 0 is v = 1.
    """

    mesh: Mesh
    vertex_normals: Float[np.ndarray, "v 3"]
    uv: Float[np.ndarray, "v 2"]
    base_colour: UInt8[np.ndarray, "h w 3"]

    @classmethod
    def of_glb(cls, glb: GlbFile) -> "ExportedSurface":
        """Read the surface of a .glb. UserError if the file is damaged or holds no skinned triangles."""
        part = glb.skinned_primitives()[0]  # an exported avatar has one
        uv = np.stack([part.uv[:, 0], 1.0 - part.uv[:, 1]], axis=1)
        return cls(Mesh(part.positions, part.faces), part.normals, uv, glb.base_colour(part.material))

    def render_head(self, views: int, height_px: int, supersampling: int) -> list[UInt8[np.ndarray, "_ _ 4"]]:
        """Render the head from all sides, unlit: sRGB with straight alpha, cropped horizontally."""
        vertices, uv = torch.from_numpy(self.mesh.vertices), torch.from_numpy(self.uv.astype(np.float32))
        faces, texture = torch.from_numpy(self.mesh.faces), torch.from_numpy(to_float(self.base_colour))
        return [
            crop_empty_columns(
                unpremultiply_to_uint8(
                    render_textured(vertices, faces, faces, uv, texture, camera, supersampling).numpy()
                )
            )
            for camera in head_cameras(self.mesh, views, height_px)
        ]
