"""Where each point of a person's surface lies on the template, how far it stands off the body, and what it is.

The registered template lies on clothes and hair as well, so the distance to it tells only what it did not follow. What
stands off the fitted body is told by the distance to the body itself.
"""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float, Int

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
"""Surface of the head that stands farther off, outside of the face, is hair or a hat."""

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


def correspond(body: Body, registration: Registration, mesh: Mesh) -> Correspondence:
    """Return where the vertices of a mesh lie on the template.

    Args:
        body: the fitted built-in body in the A-pose.
        registration: of the body on the mesh.
        mesh: the person's surface in the A-pose.
    """
    skin = np.flatnonzero(load_template().skin_faces)
    distance_m, row, barycentric = closest_points_on_mesh(mesh.vertices, registration.skin())
    offset_m = _offset_m(body, mesh)
    found = Correspondence(skin[row], barycentric, distance_m, offset_m, np.zeros(len(row), np.int64))
    head = found.interpolate(body.skin_weights[:, [body.joint("Head")]].astype(np.float64))[:, 0]
    return Correspondence(
        skin[row], barycentric, distance_m, offset_m, _labels(mesh, found, head > 0.5, _in_front(body, mesh))
    )


def _offset_m(body: Body, mesh: Mesh) -> Float[np.ndarray, "v"]:
    """Return the distance of the vertices to the body, negative where the body's nearest normal points away."""
    surface = Mesh(body.vertices, body.faces[load_template().skin_faces])
    distance_m, face, barycentric = closest_points_on_mesh(mesh.vertices, surface)
    nearest = np.einsum("vk,vkc->vc", barycentric, surface.vertices[surface.faces[face]])
    outside = np.sum((mesh.vertices - nearest) * surface.face_normals()[face], axis=1) >= 0.0
    return np.where(outside, distance_m, -distance_m)


def _in_front(body: Body, mesh: Mesh) -> Bool[np.ndarray, "v"]:
    """Return which vertices lie in front of the ears."""
    return np.asarray(mesh.vertices[:, 2] > body.joints_m[body.joint("Head"), 2] + 0.03)


def _labels(
    mesh: Mesh, found: Correspondence, on_head: Bool[np.ndarray, "v"], in_front: Bool[np.ndarray, "v"]
) -> Int[np.ndarray, "v"]:
    neighbours = adjacency(mesh, np.ones(len(mesh.edges())))
    degree = np.maximum(neighbours.sum(axis=1), 1.0)
    offset_m, unreached_m = found.offset_m.copy(), found.distance_m.copy()
    for _ in range(_SMOOTHING_STEPS):
        offset_m, unreached_m = ((values + neighbours @ values / degree) / 2.0 for values in (offset_m, unreached_m))
    label = np.where(offset_m > CLOTH_OFFSET_M, CLOTH, CLOSE)
    label[(offset_m > LOOSE_OFFSET_M) | (unreached_m > UNREACHED_M)] = LOOSE
    label[on_head] = np.where((offset_m > HAIR_OFFSET_M) & ~in_front, HAIR, CLOSE)[on_head]
    return np.asarray(label)
