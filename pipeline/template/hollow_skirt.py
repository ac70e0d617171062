"""The inside of a skirt or coat: hollow, open at its hem, with the legs in it.

A camera at the height of a person sees no inside, so that the captured surface closes a skirt at its hem. But cloth is
thin, and the legs that are seen below a hem go on above it. The cavity is what lies deeper in the garment than its
thickness and farther from the legs of the bare body than what is worn below the hem; it is cut out of the surface.
"""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float, Int
from scipy import ndimage

from pipeline.body.body import Body
from pipeline.geometry.mesh import Mesh
from pipeline.geometry.surface import (
    closest_points_on_mesh,
    collapse_edges,
    is_inside,
    isosurface,
    largest_component,
    remesh_isotropic,
    resolve_self_intersections,
    signed_distance_m,
    subtract,
)
from pipeline.mesh.skin_transfer import SkinnedTopology, skin_as_exported, transfer_skin_weights
from pipeline.template.regions import outer_surface
from pipeline.template.skirt import Hem, ankle_height_m, find_hem, leg_axis_m

SPACING_M = 0.008
"""Spacing of the samples."""

THICKNESS_M = 0.008
"""Thickness of the cloth, measured horizontally: captured surfaces have ripples of some millimetres."""

MIN_WIDTH_M = 0.02
"""A narrower gap between cloth and legs is filled: cloth that lies on the body."""

TOP_ABOVE_HIPS_M = 0.15
"""Height above the hip joints up to which a garment is hollow."""

BELOW_HEM_M = 0.04
"""The cavity goes on below the hem by this height, through the surface that closes it, ragged as nothing shows it."""

WORN_BELOW_HEM_M = 0.15
"""Height below the hem over which the distance of the surface from the bare legs is measured."""

TAPER = 0.3
"""The legs below the hem become thicker or thinner on each side by this share of the height."""

FULL_SECTION, RAGGED_M = 0.9, 0.08
"""The hem is ragged where the section of the garment is smaller than this share of the largest one up to a height
above its lowest place."""

ON_CAVITY_M = 0.001
"""Vertices up to this distance from the cavity are on it."""

FLOOR_M = 0.008
"""The floor of the cavity is flat to this height: one sample."""

MAX_LINING_M = 0.02
"""Distance of a vertex inside from the outer side up to which both are sides of one cloth."""

HEM_QUANTILE = 0.05
"""Quantile of the heights of a lining that is its lower edge."""

EDGE_RATIO, TOLERANCE_M = 6.0, 0.003
"""Edge length of the cavity, in edge lengths of the mesh; and the distance by which longer edges may move it."""


@dataclass(frozen=True)
class Lining:
    """The inner side of the cloth of a skirt or coat.

    Attributes:
        vertices: on the inner side.
        corners, barycentric: the nearest place of the outer side for each of them: vertices of a face, and shares.
    """

    vertices: Int[np.ndarray, "k"]
    corners: Int[np.ndarray, "k 3"]
    barycentric: Float[np.ndarray, "k 3"]

    def of_outer_side(self, values: Float[np.ndarray, "v c"]) -> Float[np.ndarray, "k c"]:
        """Return the values of vertices on the outer side for the vertices of the lining."""
        return np.asarray(np.einsum("kn,knc->kc", self.barycentric, values[self.corners]))

    def hem_m(self, vertices_m: Float[np.ndarray, "v 3"]) -> float:
        """Return the height of its lower edge; below everything without a lining."""
        return float(np.quantile(vertices_m[self.vertices, 1], HEM_QUANTILE)) if len(self.vertices) else -np.inf


def find_lining(mesh: Mesh, is_inside: Bool[np.ndarray, "v"]) -> Lining:
    """Return the lining of a hollow skirt. is_inside: from `vertices_inside`."""
    inside, outside = np.flatnonzero(is_inside), np.flatnonzero(~is_inside[mesh.faces].any(axis=1))
    if not len(inside) or not len(outside):
        return Lining(np.zeros(0, np.int64), np.zeros((0, 3), np.int64), np.zeros((0, 3)))
    outer = Mesh(mesh.vertices, mesh.faces[outside])
    distance_m, face, barycentric = closest_points_on_mesh(mesh.vertices[inside], outer)
    facing = np.sum(mesh.vertex_normals()[inside] * outer.face_normals()[face], axis=1)
    found = (distance_m < MAX_LINING_M) & (facing < 0.0)
    return Lining(inside[found], outer.faces[face[found]].astype(np.int64), barycentric[found])


def find_cavity(
    mesh: Mesh, skin_weights: Float[np.ndarray, "v j"], body: Body, bare: Body, edge_m: float, max_faces: int
) -> Mesh | None:
    """Return the surface of the inside of a skirt or coat, to be cut out of the mesh; None for a person without.

    Args:
        mesh: the captured surface in the A-pose, closed, m.
        skin_weights: of its vertices.
        body: the fitted body, which fills its clothes.
        bare: the body below the clothes, in the same pose.
        edge_m: edge length of the mesh.
        max_faces: of the result.

    Raises:
        OpenSurfaceError: the result could not be repaired.
    """
    hem = find_hem(mesh, skin_weights, body)
    sampled = None if hem is None else _sampled_cavity(mesh, hem, body, bare)
    if sampled is None:
        return None
    cavity = remesh_isotropic(sampled, EDGE_RATIO * edge_m, tolerance_m=TOLERANCE_M)
    if len(cavity.faces) <= max_faces:
        return cavity
    return collapse_edges(cavity, np.ones(len(cavity.faces), dtype=bool), max_faces)


def cut_out(mesh: Mesh, cavity: Mesh, max_faces: int | None = None) -> Mesh:
    """Return a mesh without a cavity, with at most `max_faces` faces if they are given.

    Raises:
        OpenSurfaceError: the result could not be repaired.
    """
    hollow = subtract(mesh, cavity)
    if max_faces is None or len(hollow.faces) <= max_faces:
        return hollow
    every = np.ones(len(hollow.faces), dtype=bool)
    return resolve_self_intersections(collapse_edges(hollow, every, max_faces - 2))


def vertices_inside(mesh: Mesh, cavity: Mesh) -> Bool[np.ndarray, "v"]:
    """Return which vertices of a mesh from `cut_out` are on the cavity: the lining, and the legs in the garment.

    Its floor below the hem leaves a ledge around the filmed legs, which is part of them.
    """
    above_floor = mesh.vertices[:, 1] > cavity.vertices[:, 1].min() + FLOOR_M
    return above_floor & (closest_points_on_mesh(mesh.vertices, cavity)[0] < ON_CAVITY_M)


def hollow_skin(
    mesh: Mesh, solid: Mesh, skin: SkinnedTopology, body: Body, is_inside: Bool[np.ndarray, "v"]
) -> SkinnedTopology:
    """Return the skin of a mesh with a hollow skirt.

    The outside moves as before, as the poses of the frames were aligned to it. Both sides of the cloth move together,
    and the legs in the skirt with the body.

    solid, skin: the mesh before the skirt was cut out, and its skin. is_inside: vertices of the mesh inside of the
    skirt.
    """
    weights, before = transfer_skin_weights(mesh, body), skin.weights.numpy()
    distance_m, face, barycentric = closest_points_on_mesh(mesh.vertices, solid)
    outside = ~is_inside | (distance_m < ON_CAVITY_M)
    weights[outside] = np.einsum("vk,vkj->vj", barycentric[outside], before[solid.faces[face[outside]]])
    lining = find_lining(mesh, is_inside)
    weights[lining.vertices] = lining.of_outer_side(weights)
    return skin_as_exported(mesh, weights)


def _sampled_cavity(mesh: Mesh, hem: Hem, body: Body, bare: Body) -> Mesh | None:
    """Return the surface of the largest cavity that is open at the hem; None without one."""
    bottom_m = hem.height_m - BELOW_HEM_M
    height_m = hem.garment.vertices[:, 1]
    part_m = hem.garment.vertices[(height_m > bottom_m) & (height_m < hem.top_m + TOP_ABOVE_HIPS_M)]
    origin_m = part_m.min(axis=0).astype(np.float64) - 2.0 * SPACING_M
    shape = tuple(np.ceil(np.ptp(part_m, axis=0) / SPACING_M).astype(int) + 4)
    x_m, y_m, z_m = (start + SPACING_M * np.arange(count) for start, count in zip(origin_m, shape, strict=True))
    points_m = np.stack(np.meshgrid(x_m, y_m, z_m, indexing="ij"), axis=-1).reshape(-1, 3)
    axes = np.stack([_leg_axes(body, height_m, origin_m) for height_m in y_m.tolist()])
    inside = is_inside(points_m, mesh).reshape(shape)
    legs = outer_surface(bare)
    free_m = signed_distance_m(points_m, legs).reshape(shape) - _offset_of_legs_m(hem, legs, body)
    depth_m, lowest = _depth_m(inside, axes, int(np.searchsorted(y_m, hem.height_m)))
    free_m = np.minimum(free_m, _beside_filmed_legs_m(inside, axes, lowest))
    value_m = np.minimum(depth_m - THICKNESS_M, free_m)
    cavity = _open_below(value_m > 0.0, lowest)
    if not cavity.any():
        return None
    value_m = np.where(ndimage.binary_dilation(cavity), value_m, np.minimum(value_m, -0.25 * SPACING_M))
    limit_m = 3.0 * SPACING_M
    smooth_m = ndimage.gaussian_filter(np.clip(value_m, -limit_m, limit_m), 1.0)
    return largest_component(isosurface(smooth_m, 0.0, origin_m, SPACING_M))


def _offset_of_legs_m(hem: Hem, legs: Mesh, body: Body) -> float:
    """Return how far the surface below the hem is off the bare legs: negative if these are too thick.

    It is the median over the outer sides: the inner ones of legs that stand side by side are hardly seen.
    """
    height_m, top_m = hem.garment.vertices[:, 1], hem.height_m - BELOW_HEM_M
    bottom_m = max(top_m - WORN_BELOW_HEM_M, ankle_height_m(body))
    below_m = hem.garment.vertices[(height_m > bottom_m) & (height_m < top_m)]
    (middle_m, _), (half_m, _) = leg_axis_m(body, 0.5 * (bottom_m + top_m))
    below_m = below_m[np.abs(below_m[:, 0] - middle_m) > half_m]
    return float(np.median(signed_distance_m(below_m, legs))) if len(below_m) else 0.0


def _beside_filmed_legs_m(
    inside: Bool[np.ndarray, "x y z"], axes: Float[np.ndarray, "y 2 2"], lowest: int
) -> Float[np.ndarray, "x y z"]:
    """Return the horizontal distance to legs that are those of the lowest samples, and change little with the height.

    They may become thicker by `TAPER` up to the hem, the row `lowest`, for they are seen there, and thinner above it.

    axes: of the legs in each slice, from `_leg_axes`.
    """
    filmed = _section(inside[:, 0], axes[0])
    is_left = np.arange(len(filmed))[:, None] > axes[0][:, 0].mean()
    distance_m = np.full(inside.shape, np.inf)
    for side, part in enumerate((filmed & ~is_left, filmed & is_left)):
        if part.any():
            outside, within = (ndimage.distance_transform_edt(each) for each in (~part, part))
            of_part_m = SPACING_M * (outside - within)
            for row, axis in enumerate(axes):
                moved_m = ndimage.shift(of_part_m, axis[side] - axes[0][side], order=1, mode="nearest")
                taper_m = TAPER * SPACING_M * (max(row - lowest, 0) - min(row, lowest))
                distance_m[:, row] = np.minimum(distance_m[:, row], moved_m + taper_m)
    return distance_m


def _depth_m(
    inside: Bool[np.ndarray, "x y z"], axes: Float[np.ndarray, "y 2 2"], start: int
) -> tuple[Float[np.ndarray, "x y z"], int]:
    """Return the horizontal depth below the surface of the garment, negative outside; and its lowest full section.

    Sections below the lowest full one have its depth.

    axes: of the legs in each slice, from `_leg_axes`. start: row of the hem's lowest place.
    """
    depth_m = np.full(inside.shape, -SPACING_M)
    sections = np.stack([_section(inside[:, row], axis) for row, axis in enumerate(axes)], axis=1)
    areas = sections[:, start : start + round(RAGGED_M / SPACING_M) + 1].sum(axis=(0, 2))
    lowest = start + int(np.argmax(areas >= FULL_SECTION * areas.max()))
    for row in range(lowest, inside.shape[1]):
        within, beyond = (ndimage.distance_transform_edt(part) for part in (sections[:, row], ~sections[:, row]))
        depth_m[:, row] = SPACING_M * np.where(sections[:, row], within - 0.5, 0.5 - beyond)
    depth_m[:, :lowest] = depth_m[:, lowest, None]
    return depth_m, lowest


def _leg_axes(body: Body, height_m: float, origin_m: Float[np.ndarray, "3"]) -> Float[np.ndarray, "2 2"]:
    """Return row and column of the axes of the right and the left leg in a slice."""
    middle_m, half_m = leg_axis_m(body, height_m)
    return np.asarray((np.stack([middle_m - half_m, middle_m + half_m]) - origin_m[[0, 2]]) / SPACING_M)


def _section(inside: Bool[np.ndarray, "x z"], axes: Float[np.ndarray, "2 2"]) -> Bool[np.ndarray, "x z"]:
    """Return the pieces of a slice that hold the axes of the legs, without holes."""
    labels, _ = ndimage.label(inside, np.ones((3, 3), dtype=int))
    row, column = np.clip(np.rint(axes).astype(int), 0, np.array(inside.shape) - 1).T
    held = labels[row, column]
    return np.asarray(ndimage.binary_fill_holes(np.isin(labels, held[held > 0])))


def _open_below(cavity: Bool[np.ndarray, "x y z"], lowest: int) -> Bool[np.ndarray, "x y z"]:
    """Return the largest piece of a cavity, without what is narrower than `MIN_WIDTH_M`, that goes below a row."""
    radius = 0.5 * MIN_WIDTH_M / SPACING_M
    wide = ndimage.distance_transform_edt(cavity) > radius
    if not wide.any():
        return wide
    labels, count = ndimage.label(cavity & (ndimage.distance_transform_edt(~wide) <= radius))
    sizes = np.bincount(labels.ravel(), minlength=count + 1)
    sizes[0] = 0
    is_open = np.isin(np.arange(count + 1), labels[:, :lowest])
    best = int(np.argmax(np.where(is_open, sizes, 0)))
    return np.asarray(labels == best) if best else np.zeros_like(cavity)
