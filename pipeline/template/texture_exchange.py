"""Another person's texture on this person: both templates, registered, say which points of two surfaces correspond.

A point of one surface has the coordinates of the nearest point of its registered template, a face and barycentric
coordinates in it; the same point of the other registered template leads to the nearest point of the other surface.
"""

from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Float, Int

from pipeline.body.body import Body
from pipeline.geometry.atlas import Atlas, rasterize_texels
from pipeline.geometry.mesh import Mesh
from pipeline.geometry.surface import closest_points_on_mesh
from pipeline.geometry.texture_rendering import sample_texture
from pipeline.template.regions import load_template

_HEAD_JOINTS = ("Neck", "Head")


@dataclass(frozen=True)
class RegisteredSurface:
    """A person's surface and the template on it.

    Attributes:
        mesh: the surface in the A-pose.
        template_m: vertices of the registered template, same frame.
    """

    mesh: Mesh
    template_m: Float[np.ndarray, "v 3"]

    def skin(self) -> Mesh:
        """Return the registered template without cavities, eyeballs and tongue."""
        template = load_template()
        return Mesh(self.template_m, template.faces[template.skin_faces])


@dataclass(frozen=True)
class SurfacePoints:
    """Points on a mesh: face and barycentric coordinates (>= 0, sum 1)."""

    face: Int[np.ndarray, "n"]
    barycentric: Float[np.ndarray, "n 3"]

    def interpolate(self, faces: Int[np.ndarray, "f 3"], values: Float[np.ndarray, "v c"]) -> Float[np.ndarray, "n c"]:
        """Return values of vertices (or of corners of an atlas) at the points."""
        return np.einsum("nk,nkc->nc", self.barycentric, values[faces[self.face]])


def template_points(points_m: Float[np.ndarray, "n 3"], surface: RegisteredSurface) -> SurfacePoints:
    """Return the points of the template nearest to points of a person; faces are those of `RegisteredSurface.skin`."""
    _, face, barycentric = closest_points_on_mesh(points_m, surface.skin())
    return SurfacePoints(face, barycentric)


def corresponding_points(points: SurfacePoints, surface: RegisteredSurface) -> SurfacePoints:
    """Return the points of a person's mesh that are nearest to points of the registered template."""
    skin = surface.skin()
    _, face, barycentric = closest_points_on_mesh(points.interpolate(skin.faces, skin.vertices), surface.mesh)
    return SurfacePoints(face, barycentric)


def below_neck(body: Body, points: SurfacePoints) -> Float[np.ndarray, "n"]:
    """Return 1 for points of the template from the neck down, 0 on head and neck, between them by the skin weights."""
    columns = [body.joint(name) for name in _HEAD_JOINTS]
    head = body.skin_weights[:, columns].sum(axis=1, keepdims=True).astype(np.float64)
    template = load_template()
    weight = points.interpolate(template.faces[template.skin_faces], head)[:, 0]
    return np.asarray(1.0 - np.clip(weight, 0.0, 1.0))


def exchanged_map(
    target: tuple[RegisteredSurface, Atlas],
    source: tuple[RegisteredSurface, Atlas],
    source_map: Float[np.ndarray, "t t c"],
    body: Body,
    mask: Float[np.ndarray, "s s"] | int,
) -> tuple[Float[np.ndarray, "s s c"], Float[np.ndarray, "s s"]]:
    """Return the source's map in the layout of the target, and where it applies, in [0, 1].

    Args:
        target, source: surfaces and their atlases.
        source_map: of the source person.
        body: of either person; tells where the head is.
        mask: where the map applies; or the side of the result, px, for a map that applies from the neck down.
    """
    (surface, atlas), (other, other_atlas) = target, source
    texels = rasterize_texels(atlas, mask if isinstance(mask, int) else len(mask))
    if not isinstance(mask, int):
        texels = texels.select(mask[texels.rows, texels.columns] > 0.0)
    points_m = texels.interpolate(surface.mesh.faces, surface.mesh.vertices).astype(np.float64)
    on_template = template_points(points_m, surface)
    on_other = corresponding_points(on_template, other)
    uv = on_other.interpolate(other_atlas.faces_uv, other_atlas.uv.astype(np.float64))
    colours = sample_texture(torch.from_numpy(source_map), torch.from_numpy(uv.astype(np.float32))).numpy()
    if not isinstance(mask, int):
        return texels.to_texture(colours), mask * texels.coverage_mask()
    return texels.to_texture(colours), texels.to_texture(below_neck(body, on_template)[:, None])[..., 0]
