"""How well the training frames show each part of the surface, judged by the fitted body in their poses.

Where frames do not show a surface, or at grazing angles only, the density there is arbitrary: clothes on the back of a
person filmed from the front, the neck under the chin, soles, armpits. Where all frames show it from nearly the same
side, its depth is arbitrary, unless it is an outline. Density that a frame cannot see, because another part of the body
takes the rays there, is arbitrary too; the masks of many frames together tell where nothing is. And where a pose brings
two canonical points to one place, at an arm on the hip, frames put density on both: the one that the pose brings near
to the body is a copy. What covers another part of the body in most frames, such as a collar before the shoulder that
moves with the head, is told by colours alone. Both are ambiguous, and near them density is arbitrary.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
import torch
from jaxtyping import Bool, Float, Int
from scipy import ndimage
from scipy.spatial import cKDTree
from torch import Tensor

from pipeline.body.body import Body
from pipeline.capture.frame_selection import evenly_spaced
from pipeline.field.skin_grid import smooth_skin_weights
from pipeline.geometry.camera import Camera, project
from pipeline.geometry.mesh import Mesh
from pipeline.geometry.surface import signed_distance_m
from pipeline.kernels.raster import rasterize
from pipeline.mesh.extraction.between_legs import closing, gaps_in_skirt
from pipeline.mesh.extraction.isosurface import CanonicalGrid, upsample
from pipeline.mesh.views import PosedView
from pipeline.texture.views import vertex_view_cosine

ENOUGH_EVIDENCE = 0.05
"""Mean over frames of the squared cosine between normal and view direction from which on a vertex counts as seen, with
0 in frames that do not show it. On a full turn a convex surface has 0.25."""
NO_SPREAD, ENOUGH_SPREAD = 0.05, 0.15
"""One minus the length of the mean direction to the camera, weighted by the squared cosines, up to which frames do not
tell the depth of a vertex, and from which on they do. A full turn has 0.15, an arc of 90 degrees 0.08, of 40 0.02."""
ENOUGH_RING_SPREAD = 0.12
"""The latter for a side of a skirt: a full turn leaves all of it as it is."""
OUTLINE_COSINE, ENOUGH_OUTLINES = 0.2, 0.15
"""Largest cosine between a normal and the direction to the camera with which a frame shows the outline there, and the
share of such frames that is enough. A full turn has 0.13, which tells by parallax."""
NORMALS = 72
"""Number of the normals along which the sides of a skirt are told."""
DEPTH_SHARE = 0.9
"""Part of its evidence that a vertex loses whose depth no frame tells. As an outline (`OUTLINE_COSINE`) it has all."""
CONTRADICTED_SHARE = 0.15
"""Share of the frames in which a point lies beside the person from which on nothing is there: strands below a wide
skirt have 0.3 and more, the surface of four people hardly anywhere more than 0.1."""
COPY_RATIO, MIN_COPY_DISTANCE_M = 0.8, 0.015
"""A point at least this far from the body is a copy if the poses bring it to less than this ratio of its distance. At
head, forearms and shins of a real turn 98 % of the samples with density keep 0.9 of it or more."""
PIT_RADIUS_M, PIT_ABOVE_CROTCH_M = 0.03, 0.1
"""A copy, farther above the crotch than this, is none where without it the surface would have a pit that a ball of this
radius does not enter: in an armpit poses bring cloth nearer to the body."""
COPY_VIEWS = 8
"""Views whose poses tell copies, evenly spaced: the median of their distances counts."""
FAR_FROM_BODY_M = 0.025
"""From this distance on, colours alone are not enough to tell of a point."""
ANOTHER_PART_M, FACING_COSINE = 0.06, 0.3
"""The surface behind a point is of another part if it is so far from the vertex that is nearest to the point, in the
canonical pose, and faces the camera: at its outline a part lies behind what surrounds it."""
COVERING_SHARE, COVERING_VIEWS = 0.6, 16
"""Share of the views that show a point in which it covers another part of the body, from which on colours alone tell
of it; and the views that are looked at, evenly spaced."""
AMBIGUOUS_REACH_M, AMBIGUOUS_FADE_M = 0.05, 0.02
"""The surface is arbitrary up to the first distance from an ambiguous sample, less and less over the second."""
EMPTY_MASK = 0.25
"""A pixel with less than this alpha is beside the person."""
CLOSE_TO_BODY_M = 0.01
"""Nothing is cleared up to this distance from the body: poses err by as much."""
MIN_DENSITY_PER_M = 2.0
"""Less density is nothing already: a quarter of the smallest isovalue."""
DEPTH_TOLERANCE_M = 0.02
"""Distance behind the nearest surface up to which a vertex is visible."""


@dataclass(frozen=True)
class RingEvidence:
    """What the frames tell of the sides of a skirt, in [0, 1] along the k normals of `ring_normals`.

    outline: that of its outline. depth: its depth, by parallax.
    """

    outline: Float[np.ndarray, "k"]
    depth: Float[np.ndarray, "k"]


@dataclass(frozen=True)
class Evidence:
    """What the frames tell of the surface.

    of_vertices: how well they show each body vertex, in [0, 1]. of_ring: what they tell of the sides of a skirt.
    """

    of_vertices: Float[np.ndarray, "v"]
    of_ring: RingEvidence


def gather_evidence(
    body: Body, views: Sequence[PosedView], ambiguous_m: Float[np.ndarray, "k 3"] | None = None
) -> Evidence:
    """Return what the views tell; see `surface_evidence`."""
    return Evidence(surface_evidence(body, views, ambiguous_m), ring_evidence(body, views))


def surface_evidence(
    body: Body, views: Sequence[PosedView], ambiguous_m: Float[np.ndarray, "k 3"] | None = None
) -> Float[np.ndarray, "v"]:
    """Return how well the views show each body vertex: 0 if none does, 1 where enough do from sides that differ enough.

    views: at least one. ambiguous_m: canonical points near which they do not tell (`CanonicalGrid.ambiguous_m`).
    """
    vertices, weights = torch.from_numpy(body.vertices), torch.from_numpy(body.skin_weights)
    faces = torch.from_numpy(body.faces)
    total, outline, direction = torch.zeros(len(vertices)), torch.zeros(len(vertices)), torch.zeros(len(vertices), 3)
    nearest_joint = weights.argmax(dim=1)
    for view in views:
        posed, camera = view.pose_vertices(vertices, weights), view.camera
        cosine = vertex_view_cosine(posed, faces, camera)
        vertices_px, depth_m = project(posed, camera)
        _, _, nearest_m = rasterize(vertices_px, depth_m, faces, camera.height, camera.width)
        row, column, inside = _pixels(vertices_px, camera)
        shown = inside.clone()
        shown[inside] = depth_m[inside] < nearest_m[row[inside], column[inside]] + DEPTH_TOLERANCE_M
        outline += shown & (cosine.abs() < OUTLINE_COSINE)
        weight = shown * cosine.clamp_min(0.0).square()
        towards = torch.nn.functional.normalize(torch.from_numpy(camera.centre_m()).to(posed) - posed, dim=1)
        rotation = view.canonical_to_world[nearest_joint, :3, :3]
        total += weight
        direction += weight[:, None] * (towards[:, None] @ rotation)[:, 0]
    seen = (total / len(views) / ENOUGH_EVIDENCE).clamp(0.0, 1.0)
    depth = _told_by_parallax(total, direction, ENOUGH_SPREAD)
    told_by_outline = (outline / len(views) / ENOUGH_OUTLINES).clamp(0.0, 1.0)
    evidence = torch.maximum(seen * (1.0 - DEPTH_SHARE * (1.0 - depth)), told_by_outline).numpy()
    if ambiguous_m is None:
        return evidence
    distance_m, _ = cKDTree(ambiguous_m).query(body.vertices)
    return evidence * np.clip((distance_m - AMBIGUOUS_REACH_M) / AMBIGUOUS_FADE_M, 0.0, 1.0)


def ring_normals() -> Float[np.ndarray, "k 2"]:
    """Return horizontal unit normals (x, z): the first along +Z, the others clockwise as seen from above."""
    angle_rad = 2.0 * np.pi * np.arange(NORMALS) / NORMALS
    return np.stack([np.sin(angle_rad), np.cos(angle_rad)], axis=1)


def ring_evidence(body: Body, views: Sequence[PosedView]) -> RingEvidence:
    """Return what the views tell of the sides of a skirt, which turns with the hips. views: at least one."""
    hips, normals = int(np.flatnonzero(body.parents < 0)[0]), torch.from_numpy(ring_normals())
    total, outline, direction = (normals.new_zeros(shape) for shape in (NORMALS, NORMALS, (NORMALS, 2)))
    for view in views:
        pose = view.canonical_to_world[hips].numpy()
        camera_m = pose[:3, :3].T @ (view.camera.centre_m() - pose[:3, 3])
        towards = torch.from_numpy((camera_m - body.joints_m[hips])[[0, 2]]).to(normals)
        towards = torch.nn.functional.normalize(towards, dim=0)
        cosine = normals @ towards
        outline += cosine.abs() < OUTLINE_COSINE
        weight = cosine.clamp_min(0.0).square()
        total += weight
        direction += weight[:, None] * towards
    seen = (total / len(views) / ENOUGH_EVIDENCE).clamp(0.0, 1.0)
    depth = _told_by_parallax(total, direction, ENOUGH_RING_SPREAD) * seen
    return RingEvidence((outline / len(views) / ENOUGH_OUTLINES).clamp(0.0, 1.0).numpy(), depth.numpy())


def _told_by_parallax(
    total: Float[Tensor, "v"], direction: Float[Tensor, "v d"], enough_spread: float
) -> Float[Tensor, "v"]:
    """Return how well depths are told, in [0, 1]. total, direction: sums of weights and of weighted directions."""
    spread = 1.0 - direction.norm(dim=1) / total.clamp_min(1e-12)
    return ((spread - NO_SPREAD) / (enough_spread - NO_SPREAD)).clamp(0.0, 1.0)


def share_beside_masks(
    points_m: Float[np.ndarray, "n 3"], body: Body, views: Sequence[PosedView]
) -> Float[np.ndarray, "n"]:
    """Return the share of the views in which a canonical point lies beside the mask, in [0, 1].

    Points move with the nearest body vertex. Where a point is outside the picture, the view does not say.
    """
    weights = torch.from_numpy(body.skin_weights[cKDTree(body.vertices).query(points_m)[1]])
    points, count = torch.from_numpy(points_m).float(), torch.zeros(len(points_m))
    for view in views:
        camera = view.camera
        row, column, inside = _pixels(project(view.pose_vertices(points, weights), camera)[0], camera)
        count[inside] += (view.mask[row[inside], column[inside]] < 255.0 * EMPTY_MASK).float()
    return (count / max(1, len(views))).numpy()


def _pixels(
    position_px: Float[Tensor, "n 2"], camera: Camera
) -> tuple[Int[Tensor, "n"], Int[Tensor, "n"], Bool[Tensor, "n"]]:
    """Return row and column of the pixel at each position, and whether it is in the picture."""
    column, row = position_px.floor().long().unbind(dim=1)
    return row, column, (column >= 0) & (column < camera.width) & (row >= 0) & (row < camera.height)


def is_copy(points_m: Float[np.ndarray, "n 3"], body: Body, views: Sequence[PosedView]) -> Bool[np.ndarray, "n"]:
    """Return the canonical points that the poses of the views bring much nearer to the body (`COPY_RATIO`).

    Clothes keep their distance from the body in all poses. Points move with the skin weights of the field, which
    chose between the copies.
    """
    distance_m = signed_distance_m(points_m, body.mesh())
    found, rows = np.zeros(len(points_m), dtype=bool), np.flatnonzero(distance_m > MIN_COPY_DISTANCE_M)
    if not len(rows):
        return found
    vertices, weights = torch.from_numpy(body.vertices), torch.from_numpy(body.skin_weights)
    points, point_weights = torch.from_numpy(points_m[rows]).float(), smooth_skin_weights(points_m[rows], body)
    posed_m = [
        signed_distance_m(
            view.pose_vertices(points, torch.from_numpy(point_weights)).numpy().astype(np.float64),
            Mesh(view.pose_vertices(vertices, weights).numpy(), body.faces),
        )
        for view in (views[k] for k in evenly_spaced(len(views), COPY_VIEWS))
    ]
    found[rows] = np.median(posed_m, axis=0) < COPY_RATIO * distance_m[rows]
    return found


def is_told_by_colours_alone(
    points_m: Float[np.ndarray, "n 3"], body: Body, views: Sequence[PosedView]
) -> Bool[np.ndarray, "n"]:
    """Return the canonical points far from the body that cover another part of it in most views that show them.

    No outline tells of such a point. If the views come from different sides, it is seen beside that part in some of
    them; if they come from one side, it has the colours of what is on that part, at a depth that nothing tells.
    """
    tree, vertices = cKDTree(body.vertices), torch.from_numpy(body.vertices)
    distance_m, nearest = tree.query(points_m)
    found, rows = np.zeros(len(points_m), dtype=bool), np.flatnonzero(distance_m > FAR_FROM_BODY_M)
    points, origin = torch.from_numpy(points_m[rows]).float(), vertices[nearest[rows]]
    weights, point_weights = (torch.from_numpy(body.skin_weights[k]) for k in (slice(None), nearest[rows]))
    faces = torch.from_numpy(body.faces)
    shown, covering = torch.zeros(len(rows)), torch.zeros(len(rows))
    for view in (views[k] for k in evenly_spaced(len(views), COVERING_VIEWS)):
        camera, posed = view.camera, view.pose_vertices(vertices, weights)
        drawn_px, drawn_m = project(posed, camera)
        cosine = vertex_view_cosine(posed, faces, camera)
        face, barycentric, surface_m = rasterize(drawn_px, drawn_m, faces, camera.height, camera.width)
        position_px, depth_m = project(view.pose_vertices(points, point_weights), camera)
        row, column, inside = _pixels(position_px, camera)
        inside[inside.clone()] = depth_m[inside] < surface_m[row[inside], column[inside]]
        face_behind = face[row[inside], column[inside]].long()
        corners, share = faces[face_behind.clamp_min(0)].long(), barycentric[row[inside], column[inside]]
        gap_m = ((vertices[corners] * share[..., None]).sum(dim=1) - origin[inside]).norm(dim=1)
        is_other = (gap_m > ANOTHER_PART_M) & ((cosine[corners] * share).sum(dim=1) > FACING_COSINE)
        shown[inside] += 1.0
        covering[inside] += ((face_behind >= 0) & is_other).float()
    found[rows] = ((covering > 0.0) & (covering >= COVERING_SHARE * shown)).numpy()
    return found


def with_emptiness(samples: CanonicalGrid, body: Body, views: Sequence[PosedView]) -> CanonicalGrid:
    """Return the grid with the emptiness that masks and poses tell, and with its ambiguous samples.

    Both are decided for every second sample.

    views: at least one.
    """
    coarse = samples.downsampled()
    solid = (coarse.density > MIN_DENSITY_PER_M) | (coarse.body_distance_m < 0.0)
    solid |= gaps_in_skirt(solid, coarse)
    candidates = ndimage.binary_dilation(solid) & (coarse.body_distance_m > CLOSE_TO_BODY_M)
    points_m = np.argwhere(candidates) * coarse.spacing_m + coarse.origin_m
    is_empty = np.zeros(candidates.shape, dtype=bool)
    is_empty[candidates] = share_beside_masks(points_m, body, views) > CONTRADICTED_SHARE
    # The samples next to what stays are left to the density, which tells the surface more finely.
    is_empty &= ~ndimage.binary_dilation(solid & ~is_empty)
    copies = np.zeros_like(is_empty)
    copies[candidates] = is_copy(points_m, body, views)
    trunk = np.s_[:, max(0, round((coarse.crotch_m + PIT_ABOVE_CROTCH_M - coarse.origin_m[1]) / coarse.spacing_m)) :]
    copies[trunk] &= ~closing(solid & ~is_empty & ~copies, PIT_RADIUS_M, coarse.spacing_m)[trunk]
    ambiguous = copies
    ambiguous[candidates] |= is_told_by_colours_alone(points_m, body, views)
    emptiness = upsample((is_empty | ambiguous).astype(np.float64), samples.density.shape).astype(np.float16)
    ambiguous_m = np.argwhere(ambiguous & solid) * coarse.spacing_m + coarse.origin_m
    # Cloth between the legs has rules of its own (`pipeline.mesh.extraction.between_legs`).
    ambiguous_m = ambiguous_m[ambiguous_m[:, 1] > coarse.crotch_m]
    return replace(samples, emptiness=emptiness, ambiguous_m=ambiguous_m)
