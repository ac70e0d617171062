"""The surface of an exported avatar as a viewer shows it at rest: with the face that moves and the file's normals."""

from dataclasses import dataclass

import cv2
import numpy as np
import torch
from jaxtyping import Float, UInt8

from pipeline.avatar.clay import head_cameras
from pipeline.avatar.textured_avatar import TexturedAvatar
from pipeline.geometry.alpha import crop_empty_columns, unpremultiply_to_uint8
from pipeline.geometry.atlas import Atlas, rasterize_texels
from pipeline.geometry.mesh import Mesh
from pipeline.geometry.surface import closest_points_on_mesh
from pipeline.geometry.texture_rendering import render_textured
from pipeline.io.glb import GlbFile
from pipeline.io.image import to_float
from pipeline.template.face.patch import EYE_LEFT, EYE_RIGHT, SKIN
from pipeline.template.face.texture import CHART_BOXES

FACE_COVERAGE_PX = 512
"""Side in which the coverage of a moving face is computed: that of its half of the map in the report's 3D view."""


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

    def coverage_map(self, avatar: TexturedAvatar, coverage: UInt8[np.ndarray, "s s"]) -> UInt8[np.ndarray, "s w"]:
        """Return a coverage map of the captured avatar in the layout of this file.

        A face that moves is in the right half of a map twice as wide. Its skin and eyes have the coverage at the
        nearest point of the captured surface; what is behind lips and lids has none, as no video shows it.

        Args:
            avatar: the captured one, in the A-pose.
            coverage: in the layout of `avatar`; row 0 is v = 1.
        """
        height, width = self.base_colour.shape[:2]
        if width == height:
            return coverage
        faces = self.mesh.faces[self.uv[self.mesh.faces, 0].mean(axis=1) > 0.5]
        in_half = np.asarray(self.uv * [2.0, 1.0] - [1.0, 0.0], np.float32)
        texels = rasterize_texels(Atlas(in_half, faces, np.arange(len(in_half))), FACE_COVERAGE_PX)
        place = np.stack([texels.columns + 0.5, FACE_COVERAGE_PX - texels.rows - 0.5], axis=1) / FACE_COVERAGE_PX
        boxes = [np.reshape(CHART_BOXES[part], (2, 2)) for part in (SKIN, EYE_LEFT, EYE_RIGHT)]
        texels = texels.select(np.any([((place >= low) & (place <= high)).all(axis=1) for low, high in boxes], axis=0))
        captured = Mesh(avatar.vertices.numpy(), avatar.faces.numpy())
        points = texels.interpolate(faces, self.mesh.vertices)
        points[:, 1] += captured.vertices[:, 1].min() - self.mesh.vertices[:, 1].min()  # files stand on their soles
        _, face, barycentric = closest_points_on_mesh(points, captured)
        uv = np.einsum("nk,nkc->nc", barycentric, avatar.uv.numpy()[avatar.faces_uv.numpy()[face]])
        side_px = len(coverage)
        columns, rows = np.clip((np.stack([uv[:, 0], 1.0 - uv[:, 1]]) * side_px).astype(int), 0, side_px - 1)
        of_face = texels.to_texture(coverage[rows, columns, None].astype(np.float32))[..., 0].astype(np.uint8)
        return np.hstack([coverage, cv2.resize(of_face, (side_px, side_px), interpolation=cv2.INTER_NEAREST)])
