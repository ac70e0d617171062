"""Shading of each pixel by a normal map: what viewers of the .glb draw, for renders under a known light."""

from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Float, Float32, Int
from scipy.ndimage import distance_transform_edt
from torch import Tensor

from pipeline.geometry.camera import Camera, project
from pipeline.geometry.mesh import area_weighted_vertex_normals
from pipeline.geometry.tangents import tangent_frames, vertex_tangents
from pipeline.kernels.raster import rasterize
from pipeline.texture.light import VertexGloss, VideoLight, exponent_of_roughness
from pipeline.texture.normal_map import decode_normals


@dataclass(frozen=True)
class NormalMappedMesh:
    """A posed mesh with a normal map.

    Attributes:
        vertices_world: m. faces: corners, indices into the vertices.
        uv: origin bottom-left. faces_uv: corners of the same faces, indices into `uv`.
        normal_map: tangent space, in [0, 1]; row 0 is v = 1.
    """

    vertices_world: Float[Tensor, "v 3"]
    faces: Int[Tensor, "f 3"]
    uv: Float[Tensor, "t 2"]
    faces_uv: Int[Tensor, "f 3"]
    normal_map: Float32[np.ndarray, "n n 3"]

    def shade(
        self, camera: Camera, light: VideoLight, frame: int | None, gloss: VertexGloss | None
    ) -> Float[Tensor, "h w d"] | None:
        """Return irradiance and, with highlights, their radiance at each pixel, see `VideoLight.shade_specular`.

        Pixels whose centre shows no surface have the shading of the nearest one that does; None if no pixel does.

        frame: selected frame whose exposure is used; None: the mean exposure.
        """
        vertices_px, depth_m = project(self.vertices_world, camera)
        face_id, barycentric, _ = rasterize(vertices_px, depth_m, self.faces, camera.height, camera.width)
        seen = (face_id >= 0).numpy()
        if not seen.any():
            return None
        face, blend = face_id.numpy()[seen], barycentric.numpy()[seen].astype(np.float64)
        corners = self.faces.numpy()[face]
        vertex_normals = area_weighted_vertex_normals(self.vertices_world, self.faces)
        visibility = _blend(light.visibility(self.vertices_world, self.faces, vertex_normals).numpy(), corners, blend)
        normals = self._normals(vertex_normals.numpy(), face, blend)
        shading = light.irradiance(normals, visibility)
        if gloss is not None:
            to_camera = camera.centre_m() - _blend(self.vertices_world.numpy(), corners, blend)
            to_camera /= np.maximum(np.linalg.norm(to_camera, axis=1, keepdims=True), 1e-9)
            exponent = None
            if gloss.roughness is not None:
                exponent = exponent_of_roughness(_blend(gloss.roughness.numpy(), corners, blend))
            lobe = gloss.highlights.lobe(normals, to_camera, visibility, exponent)
            shading = np.column_stack([shading, _blend(gloss.strength.numpy(), corners, blend) * lobe])
        gain = 1.0 if frame is None else float(light.gain[frame])
        image = np.zeros((*seen.shape, shading.shape[1]), dtype=np.float32)
        image[seen] = gain * shading
        nearest = distance_transform_edt(~seen, return_distances=False, return_indices=True)
        return torch.from_numpy(image[tuple(nearest)])

    def _normals(
        self, vertex_normals: Float[np.ndarray, "v 3"], face: Int[np.ndarray, "k"], blend: Float[np.ndarray, "k 3"]
    ) -> Float[np.ndarray, "k 3"]:
        """Return the unit normals, world, at points of faces; blend: barycentric."""
        faces_uv, uv = self.faces_uv.numpy(), self.uv.numpy()
        vertex_of_uv = np.zeros(len(uv), dtype=np.int64)
        vertex_of_uv[faces_uv] = self.faces.numpy()
        normals = vertex_normals[vertex_of_uv]
        tangents = vertex_tangents(self.vertices_world.numpy()[vertex_of_uv], normals, uv, faces_uv)
        corners = faces_uv[face]
        frames = tangent_frames(_blend(normals, corners, blend), _blend(tangents, corners, blend))
        return decode_normals(self.normal_map, _blend(uv, corners, blend), frames)


def _blend(values: np.ndarray, corners: Int[np.ndarray, "k 3"], blend: Float[np.ndarray, "k 3"]) -> np.ndarray:
    """Return interpolated values of vertices at points of faces."""
    return np.asarray(np.einsum("kc,kc...->k...", blend, values[corners].astype(np.float64)))
