"""The ring of a skirt or coat, completed where frames do not tell its distance from the legs.

Filmed from one side, a skirt has no back, and its front is at any depth: its hem stands off, or lies on the legs. Cloth
hangs from the widest place above it, and a skirt widens on all sides alike. Each horizontal slice is therefore the
convex shape with the support function of what the body has above the slice, moved outwards by as much as the outlines
of the frames show at the sides. Where they show the outline, it is that of the slice itself.

The support function of a shape is the largest coordinate along each of the k normals of `ring_normals`.
"""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float
from scipy import ndimage
from scipy.spatial import cKDTree

from pipeline.body.body import Body
from pipeline.mesh.extraction.between_legs import HEM_RANGE_M, SKIRT_ABOVE_CROTCH_M, LegGrid
from pipeline.mesh.extraction.evidence import NORMALS, RingEvidence, ring_normals

TOP_FADE_M = 0.1
"""Slices are completed from `SKIRT_ABOVE_CROTCH_M` down to the last that holds both legs, at most `HEM_RANGE_M` below
the told hem. Below the top the completion fades in over this distance."""
SMOOTHING_M, SMOOTHING_NORMALS = 0.015, 1.4
"""Standard deviations of the smoothing of the support functions, in height and in normals."""
DEPTH_SMOOTHING_NORMALS = 2.0
STRAIGHT_M = 0.12
"""Slices become no narrower over this height above the told hem: one that moves from frame to frame has no edge."""


@dataclass(frozen=True)
class CompletedSkirt:
    """A signed distance with a completed skirt, m, and the share in [0, 1] in which each sample was replaced."""

    distance_m: Float[np.ndarray, "x y z"]
    share: Float[np.ndarray, "x y z"]


def complete_skirt(
    surface_m: Float[np.ndarray, "x y z"], grid: LegGrid, body: Body, evidence: RingEvidence
) -> CompletedSkirt:
    """Complete the ring of a skirt or coat where its depth is not told; nothing changes without a hem.

    Args:
        surface_m: signed distance to the extracted surface, negative inside.
        grid: the fitted body on the same samples.
        body: the fitted body; what is nearest to its arms is kept.
        evidence: what the frames tell of the skirt.
    """
    share = np.zeros_like(surface_m)
    if grid.hem_m is None or not grid.middle() or evidence.depth.min() >= 1.0:
        return CompletedSkirt(surface_m, share)
    top_m = grid.crotch_m + SKIRT_ABOVE_CROTCH_M
    span = slice(grid.row(grid.hem_m - HEM_RANGE_M), grid.row(top_m))
    is_arm, coordinate_m = _is_arm(grid, body, span), _coordinates_m(grid, span)
    slices = _slices(surface_m, grid, is_arm, coordinate_m, span)
    if not slices.has_ring.any():
        return CompletedSkirt(surface_m, share)
    rows, support_m = np.arange(span.start, span.stop)[slices.has_ring], slices.completed_m(evidence, grid.spacing_m)
    at_hem = rows <= grid.row(grid.hem_m + STRAIGHT_M)
    support_m[at_hem] = np.maximum.accumulate(support_m[at_hem][::-1], axis=0)[::-1]
    told = ndimage.gaussian_filter1d(evidence.depth, DEPTH_SMOOTHING_NORMALS, mode="wrap")
    untold = 1.0 - told[coordinate_m.argmax(axis=-1)]
    height_m, distance_m = grid.origin_m[1] + grid.spacing_m * rows, surface_m.copy()
    lowest_m = height_m[0] - 0.5 * grid.spacing_m
    for row, of_row_m, y_m in zip(rows, support_m, height_m, strict=True):
        ring_m = np.maximum((coordinate_m - of_row_m).max(axis=-1), lowest_m - y_m)
        fade = np.clip((top_m - y_m) / TOP_FADE_M, 0.0, 1.0)
        share[:, row] = fade * untold * ~is_arm[:, row - span.start]
        distance_m[:, row] += share[:, row] * (ring_m - surface_m[:, row])
    return CompletedSkirt(distance_m, share)


def _is_arm(grid: LegGrid, body: Body, span: slice) -> Bool[np.ndarray, "x r z"]:
    """Return the samples of some rows that are nearest to an arm or a hand."""
    is_arm = body.skin_weights[:, body.arm_joints()].sum(axis=1) > 0.5
    indices = np.argwhere(np.ones_like(grid.body_distance_m[:, span], dtype=bool)) + [0, span.start, 0]
    _, nearest = cKDTree(body.vertices).query(indices * grid.spacing_m + grid.origin_m)
    return np.asarray(is_arm[nearest].reshape(grid.body_distance_m[:, span].shape))


def _coordinates_m(grid: LegGrid, span: slice) -> Float[np.ndarray, "x z k"]:
    """Return the coordinates of the samples of a row along the normals, from the axis of the pelvis."""
    middle, pelvis = grid.middle(), slice(grid.row(grid.crotch_m), span.stop)
    _, _, depth = np.nonzero(grid.body_distance_m[middle - 1 : middle + 2, pelvis] < 0.0)
    across, _, along = grid.body_distance_m.shape
    axis = np.array([middle, depth.mean() if len(depth) else 0.5 * along])
    samples = np.stack(np.meshgrid(np.arange(across), np.arange(along), indexing="ij"), axis=-1)
    return np.asarray(grid.spacing_m * (samples - axis) @ ring_normals().T)


@dataclass(frozen=True)
class _Slices:
    """Support functions of some rows, upwards, m.

    has_ring: rows whose solid holds both legs. ring_m: of that solid, with the other rows 0. body_m: of the body.
    """

    has_ring: Bool[np.ndarray, "r"]
    ring_m: Float[np.ndarray, "r k"]
    body_m: Float[np.ndarray, "r k"]

    def completed_m(self, evidence: RingEvidence, spacing_m: float) -> Float[np.ndarray, "n k"]:
        """Return the completed support functions of the rows with a ring."""
        above_m = np.maximum.accumulate(self.body_m[::-1], axis=0)[::-1]
        hanging_m, ring_m = above_m[self.has_ring], self.ring_m[self.has_ring]
        widening_m = (ring_m - hanging_m) @ evidence.outline / evidence.outline.sum()
        hanging_m += ndimage.gaussian_filter1d(widening_m, SMOOTHING_M / spacing_m, mode="nearest")[:, None]
        support_m = hanging_m + evidence.outline * (ring_m - hanging_m)
        sigmas = (SMOOTHING_M / spacing_m, SMOOTHING_NORMALS)
        return np.asarray(ndimage.gaussian_filter(support_m, sigmas, mode=("nearest", "wrap")))


def _slices(
    surface_m: Float[np.ndarray, "x y z"],
    grid: LegGrid,
    is_arm: Bool[np.ndarray, "x r z"],
    coordinate_m: Float[np.ndarray, "x z k"],
    span: slice,
) -> _Slices:
    """Return the support functions of the rows of the span, without arms.

    Up to the crotch the solid of a row is the pieces that hold both legs, above it those that hold the pelvis.
    """
    middle, crotch = grid.middle(), grid.row(grid.crotch_m)
    count = span.stop - span.start
    has_ring, ring_m, body_m = np.zeros(count, dtype=bool), np.zeros((count, NORMALS)), np.zeros((count, NORMALS))
    for k, row in enumerate(range(span.start, span.stop)):
        own_m, of_row_m = grid.body_distance_m[:, row], surface_m[:, row]
        own = (own_m < 0.0) & ~is_arm[:, k]
        pieces, _ = ndimage.label((of_row_m < 0.0) & ~is_arm[:, k], np.ones((3, 3), dtype=int))
        of_body = np.where(own, pieces, 0)
        held = np.intersect1d(of_body[:middle], of_body[middle:]) if row < crotch else np.unique(of_body)
        inside = np.isin(pieces, held[held > 0])
        if own.any():
            body_m[k] = (coordinate_m[own] - own_m[own][:, None]).max(axis=0)
        if inside.any():
            has_ring[k], ring_m[k] = True, (coordinate_m[inside] - of_row_m[inside][:, None]).max(axis=0)
    return _Slices(has_ring, ring_m, body_m)
