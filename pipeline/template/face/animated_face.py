"""The avatar with a face that moves: the captured mesh, the template's face in it, one texture, and morph targets."""

from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Float, Int

from pipeline.body.body import Body
from pipeline.geometry.atlas import Atlas
from pipeline.geometry.mesh import Mesh
from pipeline.geometry.skinning import top_k_weights
from pipeline.geometry.surface import closest_points_on_mesh
from pipeline.geometry.surface_cut import UnsplitNormals
from pipeline.mesh.files import MeshArtifact
from pipeline.template.face.motion import (
    closing_factors,
    near_template,
    normal_changes,
    on_outline,
    template_units_m,
)
from pipeline.template.face.patch import (
    EYE_LEFT,
    EYE_RIGHT,
    MOUTH,
    SOCKET_LEFT,
    SOCKET_RIGHT,
    TEETH,
    TONGUE,
    FacePatch,
    FacePatchError,
    build_face_patch,
    cut_face_out,
    draw_to_template,
)
from pipeline.template.face.texture import CapturedSurface, layout_charts, paint_patch
from pipeline.template.face.units import add_visemes, load_face_units
from pipeline.template.level_set_cut import CutMesh, points_on_edges, split_boundary_faces
from pipeline.template.registration import Registration

MIN_DISPLACEMENT_M = 5e-5
"""Smaller displacements are not written: a twentieth of a millimetre is not seen."""

MIN_NORMAL_CHANGE = 0.03
"""Smaller changes of a unit normal are not written: less than two degrees."""

_RIGID_PARTS = (MOUTH, SOCKET_LEFT, SOCKET_RIGHT, TONGUE, EYE_LEFT, EYE_RIGHT, TEETH)


MAX_GAP_M = 0.012
"""A face whose cut lies farther from that of the captured surface is not joined to it: hair may hang before it."""

MAX_MEDIAN_MM = 3.0
"""A template that lies farther from the surface (median) is not used. Ten people: 0.1 to 0.4 mm."""


_Side = tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray, np.ndarray]


@dataclass(frozen=True)
class AnimatedFace:
    """An avatar with morph targets.

    Attributes:
        skinned: the mesh in the A-pose, the face being the template's.
        atlas: of that mesh; the captured charts are in the left half of the texture.
        diffuse, specular, roughness: maps, twice as wide as high; no roughness map where all highlights have one.
        names: of the morph targets.
        displacements_m: of the vertices at weight 1, in the A-pose.
        normal_changes: of the vertices' unit normals from weight 0 to 1.
        boundary_gap_m: largest distance between the cuts that were joined.
        eyeballs: vertices of the left and of the right eyeball.
    """

    skinned: MeshArtifact
    atlas: Atlas
    diffuse: Float[np.ndarray, "h w 3"]
    specular: Float[np.ndarray, "h w"]
    names: tuple[str, ...]
    displacements_m: Float[np.ndarray, "m v 3"]
    normal_changes: Float[np.ndarray, "m v 3"]
    boundary_gap_m: float
    eyeballs: tuple[Int[np.ndarray, "k"], Int[np.ndarray, "k"]]
    roughness: Float[np.ndarray, "h w"] | None = None


def eye_centres_m(
    vertices_m: Float[np.ndarray, "v 3"], eyeballs: tuple[Int[np.ndarray, "k"], ...]
) -> Float[np.ndarray, "2 3"]:
    """Return the middles of the eyeballs (rows of vertices) where the vertices are in any pose, m."""
    return np.stack([0.5 * (ball.min(axis=0) + ball.max(axis=0)) for ball in (vertices_m[rows] for rows in eyeballs)])


def build_animated_face(
    body: Body, registration: Registration | None, skinned: MeshArtifact, captured: CapturedSurface
) -> AnimatedFace:
    """Return the avatar with a face that moves.

    Args:
        body: the fitted body.
        registration: of the template on the captured mesh; None for a body of a model file.
        skinned: the captured mesh with its skin.
        captured: the same mesh with its texture.

    Raises:
        FacePatchError: the avatar gets no such face; the message says why.
    """
    if registration is None:
        raise FacePatchError("morph targets belong to the built-in body, and this run has a body of a model file")
    if not registration.has_face:
        raise FacePatchError("no face was found in the video's frames; it may be too small or hidden")
    median_mm, _ = registration.skin_distance_mm()
    if median_mm > MAX_MEDIAN_MM:
        raise FacePatchError(f"the body's surface is {median_mm:.0f} mm from the person's (median)")
    face = animate_face(body, registration, skinned, captured)
    if face.boundary_gap_m > MAX_GAP_M:
        raise FacePatchError(
            f"the outline of the face is {1e3 * face.boundary_gap_m:.0f} mm from the surface; hair may hide it"
        )
    return face


def animate_face(
    body: Body, registration: Registration, skinned: MeshArtifact, captured: CapturedSurface
) -> AnimatedFace:
    """Return the avatar with the template's face in place of the captured one, and its morph targets.

    Args:
        body: the fitted built-in body.
        registration: of the body on the captured mesh.
        skinned: the captured mesh with its skin.
        captured: the same mesh with its texture.

    Raises:
        FacePatchError: the face cannot be cut out in one piece.
    """
    captured_atlas = captured.atlas
    patch = build_face_patch(body, registration)
    mesh = draw_to_template(skinned.mesh, registration, patch.frame)
    factors = closing_factors(patch)[:, None, None]
    patch = replace(patch, units_m=factors * patch.units_m)
    cut, cut_uv, loop = cut_face_out(mesh, captured_atlas.faces_uv, captured_atlas.vertex_of_uv, patch.frame)
    rest_m = cut.interpolate(mesh.vertices.astype(np.float64))
    outer_rad, inner_rad = (patch.frame.angle_rad(points_m) for points_m in (rest_m[loop], _boundary_m(patch)))
    on_patch_m = _at_angle(outer_rad, inner_rad, _boundary_m(patch))
    captured_loop_m = cut.interpolate(skinned.mesh.vertices.astype(np.float64))[loop]
    gap_m = float(np.linalg.norm(on_patch_m - captured_loop_m, axis=1).max())
    rest_m[loop] = on_patch_m
    uv = layout_charts(patch)
    half = np.array([0.5, 1.0])
    vertices = np.concatenate([rest_m, patch.mesh.vertices])
    faces, atlas = _join(
        (cut.faces, cut_uv.faces, cut_uv.interpolate(captured_atlas.uv) * half, loop, outer_rad),
        (patch.mesh.faces, patch.faces_uv, uv * half + [0.5, 0.0], patch.boundary, inner_rad),
        len(rest_m),
    )
    template_m = factors * template_units_m(body, registration)
    transfer = near_template(registration, rest_m, patch.frame)
    units_m, units = np.concatenate([transfer.apply(template_m), patch.units_m], axis=1), load_face_units().names
    turns = normal_changes(
        Mesh(vertices, faces),
        units_m,
        registration,
        template_m,
        transfer,
        on_outline(registration, patch, len(rest_m), len(vertices)),
    )
    names, displacements_m = add_visemes(units, units_m)
    _, turns = add_visemes(units, turns)
    displacements_m[np.linalg.norm(displacements_m, axis=2) < MIN_DISPLACEMENT_M] = 0.0
    turns[np.linalg.norm(turns, axis=2) < MIN_NORMAL_CHANGE] = 0.0
    maps = np.concatenate([captured.stacked_maps(), paint_patch(patch, uv, captured)], axis=1).astype(np.float32)
    return AnimatedFace(
        _skin(skinned, cut, patch, Mesh(vertices.astype(np.float32), faces), loop),
        atlas,
        np.ascontiguousarray(maps[..., :3]),
        np.ascontiguousarray(maps[..., 3]),
        names,
        displacements_m.astype(np.float32),
        turns.astype(np.float32),
        gap_m,
        _eyeballs(patch, len(rest_m)),
        None if captured.roughness is None else np.ascontiguousarray(maps[..., 4]),
    )


def _eyeballs(patch: FacePatch, first: int) -> tuple[Int[np.ndarray, "k"], Int[np.ndarray, "k"]]:
    """Return the vertices of both eyeballs in the joined mesh, where those of the patch begin at `first`."""
    left, right = (first + np.flatnonzero(patch.vertex_part == eye) for eye in (EYE_LEFT, EYE_RIGHT))
    return left, right


def _boundary_m(patch: FacePatch) -> Float[np.ndarray, "b 3"]:
    return patch.mesh.vertices[patch.boundary]


def _at_angle(
    angle_rad: Float[np.ndarray, "a"], loop_rad: Float[np.ndarray, "b"], values: Float[np.ndarray, "b c"]
) -> Float[np.ndarray, "a c"]:
    """Return the values of a closed loop, linear between its vertices, at some angles."""
    order = np.argsort(loop_rad)
    columns = [np.interp(angle_rad, loop_rad[order], column[order], period=2.0 * np.pi) for column in values.T]
    return np.stack(columns, axis=1)


def _join(outer: _Side, inner: _Side, first: int) -> tuple[Int[np.ndarray, "f 3"], Atlas]:
    """Join two parts along a common outline: each takes the other's vertices on it.

    Args:
        outer, inner: faces, their corners in the texture coordinates, these, the outline, and its angles.
        first: number of vertices of the outer part, which come before those of the inner one.
    """
    faces_a, faces_uv_a, uv_a, loop_a, rad_a = outer
    faces_b, faces_uv_b, uv_b, loop_b, rad_b = (inner[0] + first, *inner[1:3], inner[3] + first, inner[4])
    forwards = points_on_edges(loop_a, rad_a, loop_b, rad_b, ties_after=True)
    backwards = {(v, u): [(p, 1.0 - f) for p, f in row[::-1]] for (u, v), row in forwards.items()}
    faces_a, faces_uv_a, uv_a = split_boundary_faces(faces_a, faces_uv_a, uv_a, backwards)
    on_b = points_on_edges(loop_b, rad_b, loop_a, rad_a, ties_after=False)
    faces_b, faces_uv_b, uv_b = split_boundary_faces(faces_b, faces_uv_b, uv_b, on_b)
    faces = np.concatenate([faces_a, faces_b]).astype(np.int32)
    faces_uv = np.concatenate([faces_uv_a, faces_uv_b + len(uv_a)]).astype(np.int32)
    used, corners = np.unique(faces_uv, return_inverse=True)
    atlas = Atlas(
        np.concatenate([uv_a, uv_b]).astype(np.float32)[used],
        corners.reshape(-1, 3).astype(np.int32),
        np.zeros(len(used), np.int32),
    )
    atlas.vertex_of_uv[atlas.faces_uv] = faces
    return faces, atlas


def _skin(
    skinned: MeshArtifact, cut: CutMesh, patch: FacePatch, mesh: Mesh, loop: Int[np.ndarray, "l"]
) -> MeshArtifact:
    """Return the joined mesh with the captured skin; parts behind lids and lips have one skin each.

    loop: outline of the captured part.
    """
    joints = int(skinned.joint_indices.max()) + 1
    dense = skinned.dense_skin_weights(joints).numpy().astype(np.float64)
    _, face, barycentric = closest_points_on_mesh(patch.mesh.vertices, skinned.mesh)
    corners = skinned.mesh.faces[face]
    weights = np.einsum("nk,nkj->nj", barycentric, dense[corners])
    colours = np.einsum("nk,nkc->nc", barycentric, skinned.vertex_colours[corners].astype(np.float64))
    for part in _RIGID_PARTS:
        rows = patch.vertex_part == part
        weights[rows] = weights[rows].mean(axis=0)
    weights = np.concatenate([cut.interpolate(dense), weights])
    indices, values = top_k_weights(weights, skinned.joint_indices.shape[1])
    before = skinned.unsplit or UnsplitNormals.of_whole(skinned.mesh.faces)
    return MeshArtifact(
        mesh,
        indices,
        values,
        np.concatenate([cut.interpolate(skinned.vertex_colours.astype(np.float64)), colours]).astype(np.float32),
        _shaded_by_patch(cut.keep_unsplit(before, mesh.faces), patch, loop, len(cut.edge), len(mesh.vertices)),
    )


def _shaded_by_patch(
    normals: UnsplitNormals, patch: FacePatch, loop: Int[np.ndarray, "l"], first: int, count: int
) -> UnsplitNormals:
    """Return normals that come from the patch alone along the outline.

    The captured triangles there are long or slivers: their mean with the patch's would be seen as a line.

    Args:
        normals: of the joined mesh.
        patch: the face.
        loop: outline of the captured part.
        first, count: number of vertices of the captured part, which come first, and of all.
    """
    is_outline = np.zeros(count, dtype=bool)
    is_outline[loop], is_outline[first + patch.boundary] = True, True
    is_inside = ~is_outline & (np.arange(count) >= first)
    left_out = is_outline[normals.faces].any(axis=1) & ~is_inside[normals.faces].any(axis=1)
    has_normal = np.zeros(count, dtype=bool)
    has_normal[normals.faces[~left_out]] = True
    left_out &= has_normal[normals.faces].all(axis=1)
    return replace(normals, faces=normals.faces[~left_out])
