"""Skirts: cloth below the crotch that bridges both legs and ends in a hem, with a ring of chains around it.

Masks tell the height of its hem (`pipeline.body.filmed_legs`). The hem is a step of the surface as well: the convex
hull of its horizontal section is larger above it than below. That of trousers goes on.

A frontal video shows no back: there the surface lies on the legs of the fitted body. The ring is closed all the same.

Notation: v vertices, a directions around the legs, h heights.
"""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float
from scipy.interpolate import RegularGridInterpolator
from scipy.spatial import ConvexHull

from pipeline.body.body import Body
from pipeline.geometry.mesh import Mesh
from pipeline.geometry.surface import remove_unreferenced_vertices
from pipeline.mesh.extraction.between_legs import HEM_RANGE_M, crotch_height_m
from pipeline.mesh.face import smooth_step
from pipeline.mesh.files import MeshArtifact
from pipeline.template.chains import (
    Chain,
    LoosePart,
    between_angles,
    chain_weights,
    joint_count,
    smooth,
)
from pipeline.template.sections import SLICE_M, cut_at_height

MIN_SKIRT_M = 0.06
"""Least length of a skirt below the crotch of the body, which most long shirts do not reach."""

MIN_HEM_STEP, HEM_STEP_M = 1.6, 0.1
"""Least ratio of the hull's largest area above the hem to the median below it, each over this height. Generated skirts:
3.7 and more, real ones and coats 2.5; legs and trousers: up to 1.5. A tighter skirt does not swing."""

MAX_GAP_M = 0.03
"""Height over which a hem may be ragged."""

SKIRT_CHAINS = 8

RING_SHARE = 0.8
"""A joint is on the surface where that is at least this far out, as a share of the convex hull, otherwise on the hull:
between the legs, and where the surface is open."""

CLINGING_SHARE = 0.5
"""Cloth of a skirt that lies on the legs moves by this share with the chains half way to the hem. At its hem it moves
with the legs, whose skin continues it."""

_OUTER_TOLERANCE_M, _OUTER_DIRECTIONS = 0.015, 72
"""Surface farther inside than the outermost one in its direction is no cloth: legs inside the skirt."""

_CORE = (0.3, 0.8)
"""Shares of the convex hull up to which surface is no cloth, and from which it is: near the middle, where the underside
of a captured skirt closes it, directions and so the chains change from one vertex to the next."""


@dataclass(frozen=True)
class Hem:
    """The hem of a skirt, or of a closed coat.

    height_m, top_m: heights of the hem and of the hips, between which the skirt hangs.
    garment: the captured surface without arms, which hang beside a skirt.
    """

    height_m: float
    top_m: float
    garment: Mesh


def find_hem(mesh: Mesh, skin_weights: Float[np.ndarray, "v j"], body: Body) -> Hem | None:
    """Return the hem of a skirt, or of the lower part of a closed coat; None for a person without.

    Args:
        mesh: the captured surface in the A-pose.
        skin_weights: of its vertices.
        body: the fitted body in the same pose and frame, with the height of the hem.
    """
    crotch_m = crotch_height_m(body)
    if body.hem_m is None or crotch_m - body.hem_m < MIN_SKIRT_M:
        return None
    on_arms = _on_arms(skin_weights, body)
    garment = remove_unreferenced_vertices(Mesh(mesh.vertices, mesh.faces[~on_arms[mesh.faces].any(axis=1)]))
    hem_m = _lowest_full_section_m(garment, body.hem_m)
    if hem_m is None or hem_step(garment, body, hem_m) < MIN_HEM_STEP:
        return None
    return Hem(hem_m, body.height_on_legs_m(0.0), garment)


def hem_step(mesh: Mesh, body: Body, hem_m: float) -> float:
    """Return how many times larger the convex hull of the surface is above the hem than below; inf on the ankles."""
    below_m = np.arange(hem_m - HEM_STEP_M, hem_m - MAX_GAP_M, SLICE_M)
    below = [_hull_area_m2(mesh, height_m) for height_m in below_m[below_m > ankle_height_m(body)]]
    return _largest_hull_m2(mesh, hem_m) / float(np.median(below)) if below else np.inf


def find_skirt(body: Body, skinned: MeshArtifact, looseness: Float[np.ndarray, "v"]) -> LoosePart | None:
    """Return the skirt, or the lower part of a closed coat; None for a person without.

    Args:
        body: the fitted body in the A-pose.
        skinned: the captured mesh in the same pose and frame.
        looseness: of each vertex, 0 on the body, 1 away from it.
    """
    skin_weights = skinned.dense_skin_weights(len(body.joint_names)).numpy()
    hem = find_hem(skinned.mesh, skin_weights, body)
    if hem is None:
        return None
    mesh, hem_m, top_m = hem.garment, hem.height_m, hem.top_m
    angles_rad = 2.0 * np.pi * np.arange(SKIRT_CHAINS) / SKIRT_CHAINS
    levels_m = np.linspace(top_m, hem_m + 0.5 * SLICE_M, joint_count(top_m - hem_m))
    rings_m = np.stack([_ring_m(mesh, body, float(height_m), angles_rad) for height_m in levels_m])
    vertices = skinned.mesh.vertices.astype(np.float64)
    along = (top_m - vertices[:, 1]) / (top_m - hem_m)
    heights_m = np.arange(hem_m, top_m + SLICE_M, SLICE_M)
    middle_m = np.array([leg_axis_m(body, height_m)[0] for height_m in heights_m.tolist()])
    offset_m = vertices[:, [0, 2]] - np.stack([np.interp(vertices[:, 1], heights_m, x) for x in middle_m.T], axis=1)
    around_rad = np.arctan2(*offset_m.T)
    places = np.column_stack([vertices[:, 1], around_rad, offset_m])
    amount = _cloth_amount(mesh, body, (hem_m, top_m), places, looseness) * ~_on_arms(skin_weights, body)
    of_chain = between_angles(around_rad, angles_rad)
    weights = chain_weights(smooth(amount, skinned.mesh), of_chain, along, len(levels_m) - 1)
    return LoosePart("skirt", tuple(Chain("Hips", rings_m[:, k]) for k in range(SKIRT_CHAINS)), weights)


def _ring_m(mesh: Mesh, body: Body, height_m: float, angles_rad: Float[np.ndarray, "a"]) -> Float[np.ndarray, "a 3"]:
    """Return a point of the outer surface in each direction; across gaps one of the convex hull."""
    surface_m, hull_m = _reach_m(mesh, body, height_m, angles_rad)
    distance_m = np.where(surface_m > RING_SHARE * hull_m, surface_m, hull_m)  # nan is False
    points_m = leg_axis_m(body, height_m)[0] + distance_m[:, None] * _directions(angles_rad)
    return np.column_stack([points_m[:, 0], np.full(len(points_m), height_m), points_m[:, 1]])


def _reach_m(mesh: Mesh, body: Body, height_m: float, angles_rad: Float[np.ndarray, "a"]) -> Float[np.ndarray, "2 a"]:
    """Return how far the outermost surface (nan: none) and the convex hull are from midway between the legs."""
    section, (middle_m, _) = cut_at_height(mesh, height_m), leg_axis_m(body, height_m)
    towards = _directions(angles_rad)
    points = [section.exit_point_m(middle_m, direction) for direction in towards]
    surface_m = [np.nan if point is None else float(np.linalg.norm(point - middle_m)) for point in points]
    sides = ConvexHull(section.ends_m.reshape(-1, 2)).equations  # outward normal and offset of each side
    facing = towards @ sides[:, :2].T
    inside_m = -(sides[:, :2] @ middle_m + sides[:, 2])
    hull_m = np.where(facing > 1e-9, inside_m / np.maximum(facing, 1e-9), np.inf).min(axis=1)
    return np.stack([np.array(surface_m), hull_m])


def _directions(angles_rad: Float[np.ndarray, "a"]) -> Float[np.ndarray, "a 2"]:
    """Return x and z of directions, from the front towards the person's left."""
    return np.stack([np.sin(angles_rad), np.cos(angles_rad)], axis=1)


def _cloth_amount(
    mesh: Mesh, body: Body, range_m: tuple[float, float], places: Float[np.ndarray, "v 4"], looseness: np.ndarray
) -> Float[np.ndarray, "v"]:
    """Return by which share vertices move with chains around them: 1 where loose, less where they lie on the legs.

    range_m: heights of hem and top. places: height, direction (rad), and x and z from midway between the legs, of each
    vertex.
    """
    hem_m, top_m = range_m
    heights_m, angles_rad = np.arange(hem_m, top_m, SLICE_M), np.linspace(-np.pi, np.pi, _OUTER_DIRECTIONS + 1)
    reach_m = np.stack([_reach_m(mesh, body, height_m, angles_rad) for height_m in heights_m.tolist()], axis=2)
    at = np.column_stack([places[:, 1], places[:, 0].clip(heights_m[0], heights_m[-1])])
    surface_m, hull_m = (RegularGridInterpolator((angles_rad, heights_m), r, method="nearest")(at) for r in reach_m)
    distance_m = np.linalg.norm(places[:, 2:], axis=1)
    along = (top_m - places[:, 0]) / (top_m - hem_m)
    is_outer = (along > 0.0) & (along < 1.0) & (distance_m > surface_m - _OUTER_TOLERANCE_M)  # nan is False
    clinging = CLINGING_SHARE * (1.0 - smooth_step(along, 0.5, 1.0)) * is_outer
    amount = smooth_step(along, 0.0, 0.5) * (looseness + (1.0 - looseness) * clinging)
    return amount * smooth_step(distance_m / hull_m, *_CORE) * (places[:, 0] > hem_m - MAX_GAP_M)


def _largest_hull_m2(mesh: Mesh, hem_m: float) -> float:
    """Return the largest area of the convex hull of sections above a hem, m²."""
    return max(_hull_area_m2(mesh, height_m) for height_m in np.arange(hem_m, hem_m + HEM_STEP_M, SLICE_M))


def _lowest_full_section_m(mesh: Mesh, told_m: float) -> float | None:
    """Return the lowest height near a told one at which the convex hull is larger than half way from legs to skirt.

    None if it is at no height.
    """
    heights_m = np.arange(told_m - HEM_RANGE_M, told_m + HEM_RANGE_M, SLICE_M)
    areas_m2 = np.array([_hull_area_m2(mesh, height_m) for height_m in heights_m])
    is_full = areas_m2 > 0.5 * (areas_m2.min() + _largest_hull_m2(mesh, told_m))
    return float(heights_m[np.argmax(is_full)]) if is_full.any() else None


def _hull_area_m2(mesh: Mesh, height_m: float) -> float:
    points_m = cut_at_height(mesh, height_m).ends_m.reshape(-1, 2)
    return float(ConvexHull(points_m).volume) if len(points_m) else 0.0  # of a plane, "volume" is the area


def ankle_height_m(body: Body) -> float:
    """Return the height of the ankles, m."""
    return float(body.joints_m[[body.joint("LeftFoot"), body.joint("RightFoot")], 1].mean())


def leg_axis_m(body: Body, height_m: float) -> tuple[Float[np.ndarray, "2"], Float[np.ndarray, "2"]]:
    """Return x and z midway between the axes of the legs at a height, and half the way from right to left."""
    points = []
    for side in ("Right", "Left"):
        leg_m = body.joints_m[[body.joint(f"{side}{name}") for name in ("Foot", "Leg", "UpLeg")]].astype(np.float64)
        points.append(np.array([np.interp(height_m, leg_m[:, 1], leg_m[:, axis]) for axis in (0, 2)]))
    return 0.5 * (points[0] + points[1]), 0.5 * (points[1] - points[0])


def _on_arms(skin_weights: Float[np.ndarray, "v j"], body: Body) -> Bool[np.ndarray, "v"]:
    return np.asarray(skin_weights[:, body.arm_joints()].sum(axis=1) > 0.5)
