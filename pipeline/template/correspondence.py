"""Where each point of a person's surface lies on the template, how far it stands off the body, and what it is.

The registered template lies on clothes and hair as well, so the distance to it tells only what it did not follow. What
stands off the fitted body is told by the distance to the body itself.
"""

from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Bool, Float, Int
from skimage.color import rgb2lab

from pipeline.body.body import Body
from pipeline.geometry.mesh import Mesh
from pipeline.geometry.surface import adjacency, closest_points_on_mesh
from pipeline.template.regions import load_template
from pipeline.template.registration import Registration

CLOSE, CLOTH, LOOSE, HAIR = range(4)
LABELS = ("close", "cloth", "loose", "hair")
"""What a vertex is: skin or tight cloth; cloth that follows the body; skirts, coats and wide cloth; hair or a hat."""

CLOTH_OFFSET_M = 0.008
"""Surface farther from the fitted body is no skin: a shirt stands off by one to three centimetres, a shape that was not
fitted exactly by some millimetres."""

LOOSE_OFFSET_M = 0.05
"""Surface farther from the fitted body does not follow it: skirts, coats, long hair."""

UNREACHED_M = 0.015
"""Surface farther from the registered template was not reached by it: it has no place of its own on the body."""

HAIR_OFFSET_M = 0.008
"""Surface of the head that stands farther off, behind the face, is hair or a hat."""

FOREHEAD_M, CROWN_M = 0.03, 0.08
"""Heights above the eyes: below the first a face has no hair but brows and beard, above the second lies the crown."""

MIN_HAIR_CONTRAST = 15.0
"""Least difference (CIELAB) of crown and face at which colour tells hair from skin: a bald head has less."""

_SMOOTHING_STEPS = 8
"""Steps of a mean over neighbours before offsets are compared with thresholds: a label has no single vertices."""


@dataclass(frozen=True)
class Correspondence:
    """Points of the template for the vertices of a person's mesh.

    Attributes:
        face: of `Template.faces`, always one of the skin.
        barycentric: in that face, >= 0, sum 1.
        distance_m: to that point of the registered template.
        offset_m: distance to the fitted body, negative inside it: clothes are an offset.
        label: index into `LABELS`.
    """

    face: Int[np.ndarray, "v"]
    barycentric: Float[np.ndarray, "v 3"]
    distance_m: Float[np.ndarray, "v"]
    offset_m: Float[np.ndarray, "v"]
    label: Int[np.ndarray, "v"]

    def interpolate(self, values: Float[np.ndarray, "t c"]) -> Float[np.ndarray, "v c"]:
        """Return values of the template's vertices at the vertices of the person."""
        corners = load_template().faces[self.face]
        return np.asarray(np.einsum("vk,vkc->vc", self.barycentric, values[corners]))

    def shares(self) -> dict[str, float]:
        """Return the share of vertices of each label."""
        return {name: float((self.label == number).mean()) for number, name in enumerate(LABELS)}


def correspond(
    body: Body, registration: Registration, mesh: Mesh, vertex_colours: Float[np.ndarray, "v 3"]
) -> Correspondence:
    """Return where the vertices of a mesh lie on the template.

    Args:
        body: the fitted built-in body in the A-pose.
        registration: of the body on the mesh.
        mesh: the person's surface in the A-pose.
        vertex_colours: sRGB in [0, 1], which tell hair from skin.
    """
    skin = np.flatnonzero(load_template().skin_faces)
    distance_m, row, barycentric = closest_points_on_mesh(mesh.vertices, registration.skin())
    offset_m = _offset_m(body, mesh)
    found = Correspondence(skin[row], barycentric, distance_m, offset_m, np.zeros(len(row), np.int64))
    head = found.interpolate(body.skin_weights[:, [body.joint("Head")]].astype(np.float64))[:, 0]
    return replace(found, label=_labels(mesh, found, head > 0.5, body, vertex_colours))


def _offset_m(body: Body, mesh: Mesh) -> Float[np.ndarray, "v"]:
    """Return the distance of the vertices to the body, negative where the body's nearest normal points away."""
    surface = Mesh(body.vertices, body.faces[load_template().skin_faces])
    distance_m, face, barycentric = closest_points_on_mesh(mesh.vertices, surface)
    nearest = np.einsum("vk,vkc->vc", barycentric, surface.vertices[surface.faces[face]])
    outside = np.sum((mesh.vertices - nearest) * surface.face_normals()[face], axis=1) >= 0.0
    return np.where(outside, distance_m, -distance_m)


def _labels(
    mesh: Mesh,
    found: Correspondence,
    on_head: Bool[np.ndarray, "v"],
    body: Body,
    vertex_colours: Float[np.ndarray, "v 3"],
) -> Int[np.ndarray, "v"]:
    neighbours = adjacency(mesh, np.ones(len(mesh.edges())))
    degree = np.maximum(neighbours.sum(axis=1), 1.0)

    def smooth(values: Float[np.ndarray, "v"]) -> Float[np.ndarray, "v"]:
        for _ in range(_SMOOTHING_STEPS):
            values = (values + neighbours @ values / degree) / 2.0
        return values

    offset_m = smooth(found.offset_m)
    label = np.where(offset_m > CLOTH_OFFSET_M, CLOTH, CLOSE)
    label[(offset_m > LOOSE_OFFSET_M) | (smooth(found.distance_m) > UNREACHED_M)] = LOOSE
    eyes_m = body.vertices[load_template().vertices_of(load_template().eye_faces.any(axis=0))].mean(axis=0)
    in_front = mesh.vertices[:, 2] > body.joints_m[body.joint("Head"), 2] + 0.03
    above_eyes_m = mesh.vertices[:, 1] - eyes_m[1]
    stands_off = (offset_m > HAIR_OFFSET_M) & ~in_front
    has_colour = smooth(_hair_likeness(vertex_colours, on_head, in_front, above_eyes_m)) > 0.5
    on_face = in_front & (above_eyes_m < FOREHEAD_M)
    label[on_head] = np.where(stands_off | (has_colour & ~on_face), HAIR, CLOSE)[on_head]
    return np.asarray(label)


def _hair_likeness(
    vertex_colours: Float[np.ndarray, "v 3"],
    on_head: Bool[np.ndarray, "v"],
    in_front: Bool[np.ndarray, "v"],
    above_eyes_m: Float[np.ndarray, "v"],
) -> Float[np.ndarray, "v"]:
    """Return 1 where a colour is nearer to that of the crown than to that of the face; 0 where both are alike."""
    crown = on_head & (above_eyes_m > CROWN_M)
    face = on_head & in_front & (np.abs(above_eyes_m + FOREHEAD_M) < FOREHEAD_M)
    if not crown.any() or not face.any():
        return np.zeros(len(on_head))
    lab = rgb2lab(np.clip(vertex_colours, 0.0, 1.0))
    of_crown, of_face = np.median(lab[crown], axis=0), np.median(lab[face], axis=0)
    if np.linalg.norm(of_crown - of_face) < MIN_HAIR_CONTRAST:
        return np.zeros(len(on_head))
    return (np.linalg.norm(lab - of_crown, axis=1) < np.linalg.norm(lab - of_face, axis=1)).astype(np.float64)
