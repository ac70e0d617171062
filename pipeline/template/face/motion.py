"""How surface around the face follows the template's units: displacements, normals, and lids that close exactly."""

from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Float, Int

from pipeline.body.body import Body
from pipeline.geometry.mesh import Mesh
from pipeline.geometry.surface import closest_points_on_mesh
from pipeline.template.face.frame import FaceFrame
from pipeline.template.face.front_view import view_from_front
from pipeline.template.face.patch import EYE_LEFT, EYE_RIGHT, FacePatch, unit_transform
from pipeline.template.face.units import load_face_units
from pipeline.template.regions import load_template
from pipeline.template.registration import Registration

_FULL_M, _NONE_M = 0.012, 0.03
"""Captured surface nearer than the first distance to the template moves with it, farther than the second not at all:
a fringe of hair before the brows stays."""

_REACH_M = 0.30
"""Radius around the eyes outside of which no face unit moves anything."""

_CLOSED_SHARE = 0.01
"""An eye is closed when no more of the pixels that an open eye shows are seen."""

_CLOSING_STEPS, _OVERLAP = 7, 1.04
"""Halvings of the weight at which an eye closes, and what is added to it: closed eyes stay so from below."""


@dataclass(frozen=True)
class TemplateTransfer:
    """Where the skin of the template is nearest to points, and how much of its motion they take.

    Attributes:
        count: of the points.
        rows: of the points that take any.
        amount: of each of these, in [0, 1].
        corners, barycentric: vertices of the template and their shares.
    """

    count: int
    rows: Int[np.ndarray, "n"]
    amount: Float[np.ndarray, "n"]
    corners: Int[np.ndarray, "n 3"]
    barycentric: Float[np.ndarray, "n 3"]

    def apply(self, values: Float[np.ndarray, "m t 3"]) -> Float[np.ndarray, "m v 3"]:
        """Return values of the template's vertices at the points; 0 at points that take none."""
        moved = np.zeros((len(values), self.count, 3))
        weights = self.amount[:, None] * self.barycentric
        moved[:, self.rows] = np.einsum("nk,mnkc->mnc", weights, values[:, self.corners])
        return moved


def near_template(registration: Registration, points_m: Float[np.ndarray, "v 3"], frame: FaceFrame) -> TemplateTransfer:
    """Return how points around the face follow the skin of the registered template."""
    template = load_template()
    rows = np.flatnonzero(np.linalg.norm(points_m - frame.origin_m, axis=1) < _REACH_M)
    skin = Mesh(registration.vertices, template.faces[template.skin_faces])
    distance_m, face, barycentric = closest_points_on_mesh(points_m[rows], skin)
    amount = np.clip((_NONE_M - distance_m) / (_NONE_M - _FULL_M), 0.0, 1.0)
    return TemplateTransfer(len(points_m), rows, amount, skin.faces[face], barycentric)


def template_units_m(body: Body, registration: Registration) -> Float[np.ndarray, "m t 3"]:
    """Return the face units of the vertices of the registered template, m at weight 1."""
    return np.asarray(load_face_units().template_m @ unit_transform(body, registration).T)


def closing_factors(patch: FacePatch) -> Float[np.ndarray, "m"]:
    """Return the factor of each face unit with which `eyeBlinkLeft` and `eyeBlinkRight` close the lids at weight 1.

    Narrow eyes are closed by a part of the template's motion: with all of it the upper lid would cross the lower one.
    The lids meet as seen from in front; an eye that all of the motion does not close has the factor 1, as other units.
    """
    units = load_face_units().names
    factors = np.ones(len(units))
    for name, eye in (("eyeBlinkLeft", EYE_LEFT), ("eyeBlinkRight", EYE_RIGHT)):
        factors[units.index(name)] = _closing_weight(patch, units.index(name), eye)
    return factors


def _closing_weight(patch: FacePatch, unit: int, eye: int) -> float:
    def seen_px(weight: float) -> int:
        moved = Mesh(patch.mesh.vertices + weight * patch.units_m[unit], patch.mesh.faces)
        face_id = view_from_front(moved, patch.frame).face_id
        return int(np.count_nonzero(patch.part[face_id[face_id >= 0]] == eye))

    limit_px = _CLOSED_SHARE * seen_px(0.0)
    low, high = 0.0, 1.0
    if seen_px(high) > limit_px:
        return 1.0
    for _ in range(_CLOSING_STEPS):
        middle = 0.5 * (low + high)
        low, high = (low, middle) if seen_px(middle) <= limit_px else (middle, high)
    return min(1.0, _OVERLAP * high)


def normal_changes(
    mesh: Mesh,
    units_m: Float[np.ndarray, "m v 3"],
    registration: Registration,
    template_m: Float[np.ndarray, "m t 3"],
    transfer: TemplateTransfer,
    boundary: TemplateTransfer,
) -> Float[np.ndarray, "m v 3"]:
    """Return how the unit normals of the joined mesh change with each unit, from weight 0 to 1.

    On the captured surface and on the outline they are those of the template, whose faces are well shaped: slivers
    along the outline would be shaded as a crease.

    Args:
        mesh: captured surface, then the patch, in the pose of the units.
        units_m: displacements of its vertices.
        registration: of the template.
        template_m: units of the template's vertices.
        transfer: of the captured vertices, the first ones of the mesh.
        boundary: of the vertices of the mesh that lie on the outline; `rows` are theirs.
    """
    template = load_template()
    skin = Mesh(registration.vertices, template.faces[template.skin_faces])
    of_template = _changes(skin, template_m)
    changes = _changes(mesh, units_m)
    changes[:, : transfer.count] = transfer.apply(of_template)
    changes[:, boundary.rows] = boundary.apply(of_template)[:, boundary.rows]
    return changes


def _changes(mesh: Mesh, units_m: Float[np.ndarray, "m v 3"]) -> Float[np.ndarray, "m v 3"]:
    rest = mesh.vertex_normals()
    return np.stack([Mesh(mesh.vertices + moved_m, mesh.faces).vertex_normals() - rest for moved_m in units_m])


def on_outline(registration: Registration, patch: FacePatch, first: int, count: int) -> TemplateTransfer:
    """Return how the outline of a patch follows the template, where the patch's vertices begin at `first`."""
    found = near_template(registration, patch.mesh.vertices[patch.boundary], patch.frame)
    return replace(found, count=count, rows=first + patch.boundary[found.rows])
