"""The exported avatar, a skinned mesh with UV atlas and diffuse map: posing and rendering."""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float, Float32, Int, UInt8
from torch import Tensor

from pipeline.avatar.pixel_shading import NormalMappedMesh
from pipeline.geometry.alpha import crop_empty_columns, unpremultiply_to_uint8
from pipeline.geometry.camera import Camera
from pipeline.geometry.mesh import Mesh
from pipeline.geometry.skinning import dense_weights, linear_blend_skinning
from pipeline.geometry.texture_rendering import apply_shading, render_textured, turntable_cameras
from pipeline.mesh.files import MeshArtifact
from pipeline.texture.light import VertexGloss, VideoLight


@dataclass(frozen=True)
class TexturedAvatar:
    """A skinned mesh in the canonical A-pose with a diffuse texture.

    Attributes:
        vertices: m; those on sharp folds once for each side.
        faces: counter-clockwise.
        joint_indices: four influences per vertex.
        joint_weights: rows sum to 1.
        uv: origin bottom-left.
        faces_uv: corners of each face, as indices into `uv`.
        diffuse: sRGB in [0, 1]; row 0 is v = 1.
        light: of the video; None or uniform if the diffuse texture holds it.
        gloss: highlights of the vertices under that light; None for a matte surface.
        normal_map: tangent space, in [0, 1]; None: the normals of the vertices. Drawn under a light, not unlit.
        skinned: the same vertices, with the triangles that normals are those of and the folds; None: normals are those
            of `faces`, and no vertex is a copy.
    """

    vertices: Float[Tensor, "v 3"]
    faces: Int[Tensor, "f 3"]
    joint_indices: Int[Tensor, "v 4"]
    joint_weights: Float[Tensor, "v 4"]
    uv: Float[Tensor, "t 2"]
    faces_uv: Int[Tensor, "f 3"]
    diffuse: Float[Tensor, "th tw 3"]
    light: VideoLight | None = None
    gloss: VertexGloss | None = None
    normal_map: Float32[np.ndarray, "n n 3"] | None = None
    skinned: MeshArtifact | None = None

    def mesh(self) -> Mesh:
        """Return the canonical mesh without texture and skin, connected across folds."""
        if self.skinned is None or self.skinned.creases is None:
            return Mesh(self.vertices.numpy(), self.faces.numpy())
        return self.skinned.creases.join(self.vertices.numpy())

    def pose_vertices(self, canonical_to_world: Float[Tensor, "j 4 4"]) -> Float[Tensor, "v 3"]:
        """Pose the vertices (m, world) by linear blend skinning, as a glTF viewer does."""
        weights = dense_weights(self.joint_indices, self.joint_weights, len(canonical_to_world))
        return linear_blend_skinning(self.vertices, weights, canonical_to_world[None])[0]

    def vertex_normals(self, posed: Float[np.ndarray, "v 3"]) -> Float[np.ndarray, "v 3"]:
        """Return the unit normals of posed vertices, as the exported files have them."""
        if self.skinned is None:
            return Mesh(posed, self.faces.numpy()).vertex_normals()
        return self.skinned.vertex_normals(posed)

    def render(
        self,
        vertices_world: Float[Tensor, "v 3"],
        camera: Camera,
        supersampling: int,
        light: VideoLight | None = None,
        frame: int | None = None,
    ) -> Float[np.ndarray, "h w 4"]:
        """Render premultiplied colours and coverage, in [0, 1]; see `render_textured`.

        light: None: unlit. frame: selected frame whose exposure is used; None: the mean exposure.
        """
        shading = None
        is_lit = light is not None and not (light.is_uniform and frame is None)
        if light is not None and is_lit and self.normal_map is None:
            shading = self._shade(vertices_world, camera, light, frame)
        drawn = render_textured(
            vertices_world, self.faces, self.faces_uv, self.uv, self.diffuse, camera, supersampling, shading
        )
        if light is not None and is_lit and self.normal_map is not None:
            mesh = NormalMappedMesh(vertices_world, self.faces, self.uv, self.faces_uv, self.normal_map)
            pixels = mesh.shade(camera, light, frame, self.gloss if light is self.light else None)
            drawn = drawn if pixels is None else apply_shading(drawn, pixels)
        return drawn.numpy()

    def _shade(
        self, vertices_world: Float[Tensor, "v 3"], camera: Camera, light: VideoLight, frame: int | None
    ) -> Float[Tensor, "v d"]:
        """Return the irradiance of each vertex and, under the light of the video, its highlight as a fourth column."""
        if self.gloss is None or light is not self.light:
            return light.shade_vertices(vertices_world, self.faces, frame)
        return light.shade_specular(vertices_world, self.faces, frame, self.gloss, camera.centre_m())

    def irradiance(self, vertices_world: Float[Tensor, "v 3"]) -> Float[Tensor, "v 3"] | None:
        """Return the irradiance of posed vertices under the light of the video; None if the texture holds it."""
        if self.light is None or self.light.is_uniform:
            return None
        return self.light.shade_vertices(vertices_world, self.faces)

    def render_turntable(
        self,
        vertices_world: Float[Tensor, "v 3"],
        views: int,
        height_px: int,
        supersampling: int,
        light: VideoLight | None = None,
    ) -> list[UInt8[np.ndarray, "_ _ 4"]]:
        """Render views at evenly spaced azimuths, the first from +Z.

        Images are sRGB with straight alpha, cropped horizontally to the body; they share height and scale.

        views: number of images. height_px: of each image. light: None: unlit.
        """
        box_m = vertices_world.numpy().min(axis=0), vertices_world.numpy().max(axis=0)
        return [
            crop_empty_columns(unpremultiply_to_uint8(self.render(vertices_world, camera, supersampling, light)))
            for camera in turntable_cameras(*box_m, views, height_px)
        ]
