"""Extraction of the initial mesh from the canonical density.

No ray ends inside a person, so the density of a trained field may be empty there, and it is arbitrary where no frame
shows the surface. The solid whose surface is extracted therefore contains all points with a density above an isovalue
and all points deeper inside the fitted body than a given depth. Its cavities are filled; hands are those of the fitted
body.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field, replace

import numpy as np
import torch
from jaxtyping import Bool, Float, Int
from scipy import ndimage
from scipy.spatial import cKDTree
from torch import Tensor

from pipeline.body.body import Body
from pipeline.geometry.mesh import Mesh
from pipeline.geometry.surface import isosurface, largest_solid, repair, signed_distance_m
from pipeline.kernels.common.thread_pool import shared_thread_pool
from pipeline.mesh.extraction.between_legs import (
    LegGrid,
    closing,
    crotch_height_m,
    excess_between_legs,
    gaps_in_skirt,
    parted_legs,
)
from pipeline.mesh.settings import MeshSettings

BODY_PADDING_VOXELS = 4
"""Samples around the body where the box of the density ends nearer to it."""
HAND_REACH_M = 0.12
"""Density up to this distance from the body belongs to a hand where a hand is nearest, m."""
VOID_OPENING_RADIUS_M = 0.025
"""Radius of the ball that cannot roll into a void, m."""
DISTANCE_GRID_STRIDE = 4
HAND_NARROW_BAND_VOXELS = 4.0
GRID_SIZE_MULTIPLE = 8
"""Sample counts minus one are multiples of this, so that downsampling by 2 or 4 keeps the last sample of each axis."""
SURFACE_ISOVALUE = 0.5
"""Isovalue of the indicator function, which is 1 inside the solid and 0 outside."""


_GRIDS = ("density", "body_distance_m", "hand_weight", "emptiness")


@dataclass(frozen=True)
class CanonicalGrid(LegGrid):
    """Density beside the signed distance to the body on a regular grid in canonical space.

    density: 1/m. hand_weight: skin weight of the hand joints, in [0, 1]. emptiness: 1 where nothing is whatever the
    density, 0 elsewhere.
    ambiguous_m: empty samples above the crotch with density, which frames put there for another part of the body; see
    `pipeline.mesh.extraction.evidence`.

    Weight and emptiness are kept in half precision, because a fine grid has 25 million samples.
    """

    density: Float[np.ndarray, "x y z"]
    hand_weight: Float[np.ndarray, "x y z"]
    emptiness: Float[np.ndarray, "x y z"]
    ambiguous_m: Float[np.ndarray, "k 3"] = field(default_factory=lambda: np.zeros((0, 3)))

    def downsampled(self) -> CanonicalGrid:
        """Return the grid with every second sample."""
        grids = {name: getattr(self, name)[::2, ::2, ::2] for name in _GRIDS}
        return replace(self, spacing_m=2.0 * self.spacing_m, **grids)


def sample_canonical_grid(
    density_fn: Callable[[Tensor], Tensor],
    bounds_m: Float[np.ndarray, "2 3"],
    body: Body,
    voxel_size_m: float,
    settings: MeshSettings,
) -> CanonicalGrid:
    """Sample the density on a grid that covers the body and everything around it that has density.

    Args:
        density_fn: maps canonical points (n, 3) in m to densities (n,) in 1/m, 0 in empty space.
        bounds_m: low and high corner of a box that holds all density, m: cloth and hair as far as the field has them.
        body: the fitted body in its canonical pose.
        voxel_size_m: spacing of the samples, m.
        settings: see `MeshSettings`.
    """
    padding_m = BODY_PADDING_VOXELS * voxel_size_m
    origin_m = np.minimum(bounds_m[0], body.vertices.min(axis=0) - padding_m).astype(np.float64)
    counts = np.ceil((np.maximum(bounds_m[1], body.vertices.max(axis=0) + padding_m) - origin_m) / voxel_size_m)
    counts = GRID_SIZE_MULTIPLE * np.ceil(counts / GRID_SIZE_MULTIPLE).astype(int) + 1
    mesh = body.mesh()
    distance_m = signed_distance_grid(mesh, origin_m, counts, voxel_size_m)
    density = _density_grid(density_fn, origin_m, distance_m.shape, voxel_size_m)
    hand_weight, emptiness = np.zeros(density.shape, np.float16), np.zeros(density.shape, np.float16)
    if settings.hands_from_body:
        vertex_hand_weight = hand_skin_weights(body)
        near_hand = _indices_in_side_boxes(
            origin_m, voxel_size_m, distance_m.shape, body.vertices[vertex_hand_weight > 0.0], HAND_REACH_M
        )
        near_hand = near_hand[distance_m[tuple(near_hand.T)] < HAND_REACH_M]
        _, nearest = cKDTree(body.vertices).query(near_hand * voxel_size_m + origin_m)
        hand_weight[tuple(near_hand.T)] = vertex_hand_weight[nearest]
        narrow_band = np.abs(distance_m) < HAND_NARROW_BAND_VOXELS * voxel_size_m
        exact = np.argwhere((hand_weight > 0.0) & narrow_band)
        distance_m[tuple(exact.T)] = signed_distance_m(exact * voxel_size_m + origin_m, mesh)
    return CanonicalGrid(
        origin_m, voxel_size_m, distance_m, crotch_height_m(body), body.hem_m, density, hand_weight, emptiness
    )


def _density_grid(
    density_fn: Callable[[Tensor], Tensor],
    origin_m: Float[np.ndarray, "3"],
    shape: tuple[int, ...],
    spacing_m: float,
) -> Float[np.ndarray, "x y z"]:
    """Return the density at all samples, slab by slab, so that a wide box needs little memory."""
    density = np.empty(shape, dtype=np.float32)
    y, z = (origin_m[axis] + spacing_m * np.arange(shape[axis]) for axis in (1, 2))
    slab = np.stack(np.broadcast_arrays(origin_m[0], y[:, None], z[None, :]), axis=-1).reshape(-1, 3)
    points = torch.from_numpy(slab.astype(np.float32))
    for row in range(shape[0]):
        points[:, 0] = float(origin_m[0] + spacing_m * row)
        density[row] = density_fn(points).detach().numpy().reshape(shape[1:])
    return density


def hand_skin_weights(body: Body) -> Float[np.ndarray, "v"]:
    """Return the summed skin weight of the hand and finger joints of each body vertex, in [0, 1]."""
    hands = [i for i, name in enumerate(body.joint_names) if "Hand" in name]
    return body.skin_weights[:, hands].sum(axis=1)


def indicator_grid(samples: CanonicalGrid, isovalue_per_m: float, settings: MeshSettings) -> Float[np.ndarray, "x y z"]:
    """Return a soft indicator function of the solid in [0, 1]; its surface is at `SURFACE_ISOVALUE`.

    Args:
        samples: the canonical grid.
        isovalue_per_m: density (1/m) at which the indicator of the density is 0.5.
        settings: see `MeshSettings`.
    """
    # A fine grid has 100 MB: results replace their operands.
    value = samples.density / (samples.density + isovalue_per_m)
    if settings.blur_sigma_voxels > 0.0:
        ndimage.gaussian_filter(value, settings.blur_sigma_voxels, output=value, truncate=3.0)
    ramp_m = 3.0 * samples.spacing_m
    core = _clipped_ramp(_depth_inside_m(samples) - np.float32(settings.solid_core_depth_m), ramp_m)
    np.maximum(value, core, out=value)
    del core
    closed = _close_concavities(value >= SURFACE_ISOVALUE, samples, settings.closing_radius_m)
    np.maximum(value, closed, out=value)
    del closed
    hands = samples.hand_weight > 0.0
    hand = _clipped_ramp(-samples.body_distance_m[hands], ramp_m)
    value[hands] += samples.hand_weight[hands] * (hand - value[hands])
    np.maximum(value, _close_skirt(value >= SURFACE_ISOVALUE, samples), out=value)
    np.maximum(value, _fill_voids(value >= SURFACE_ISOVALUE, samples), out=value)
    np.maximum(value, fill_trousers(value >= SURFACE_ISOVALUE, samples), out=value)
    value *= 1.0 - samples.emptiness
    np.minimum(value, parted_legs(samples), out=value)
    value[excess_between_legs(value >= SURFACE_ISOVALUE, samples)] = 0.0
    is_solid = value >= SURFACE_ISOVALUE
    inside = largest_solid(is_solid)
    # Filled cavities become 1; other components become empty.
    value[inside & ~is_solid] = 1.0
    return np.minimum(value, SURFACE_ISOVALUE - 1e-3, out=value, where=~inside)


def _clipped_ramp(depth_m: Float[np.ndarray, "*n"], ramp_m: float) -> Float[np.ndarray, "*n"]:
    """Replace depths by an indicator that rises from 0 to 1 over `ramp_m`, and return it."""
    depth_m /= np.float32(ramp_m)
    depth_m += np.float32(SURFACE_ISOVALUE)
    return np.clip(depth_m, 0.0, 1.0, out=depth_m)


def extract_mesh(samples: CanonicalGrid, isovalue_per_m: float, settings: MeshSettings) -> Mesh:
    """Extract the watertight surface of the solid by marching cubes, one component, before decimation.

    Raises:
        ValueError: the solid is empty at this isovalue.
    """
    indicator = indicator_grid(samples, isovalue_per_m, settings)
    return repair(isosurface(indicator, SURFACE_ISOVALUE, samples.origin_m, samples.spacing_m))


def select_isovalue(
    samples: CanonicalGrid, settings: MeshSettings, score: Callable[[Mesh], float]
) -> tuple[float, float]:
    """Select the density isovalue (1/m) of `settings.isovalues_per_m` whose surface has the highest score.

    The surfaces are extracted from every second sample.

    Returns:
        The isovalue and its score.
    """
    coarse = samples.downsampled()

    def score_of(isovalue_per_m: float) -> float:
        indicator = indicator_grid(coarse, isovalue_per_m, settings)
        return score(isosurface(indicator, SURFACE_ISOVALUE, coarse.origin_m, coarse.spacing_m))

    scores = shared_thread_pool(torch.get_num_threads()).map(score_of, settings.isovalues_per_m)
    best = int(np.argmax(scores))
    return float(settings.isovalues_per_m[best]), scores[best]


def _indices_in_side_boxes(
    origin_m: Float[np.ndarray, "3"],
    spacing_m: float,
    shape: tuple[int, ...],
    targets: Float[np.ndarray, "m 3"],
    margin_m: float,
) -> Int[np.ndarray, "k 3"]:
    """Return the indices of the samples in the padded bounding box of the left (x >= 0) or the right targets."""
    found = np.zeros(shape, dtype=bool)
    for side in (targets[targets[:, 0] < 0], targets[targets[:, 0] >= 0]):
        if len(side):
            low = np.maximum(np.ceil((side.min(axis=0) - margin_m - origin_m) / spacing_m).astype(int), 0)
            high = np.floor((side.max(axis=0) + margin_m - origin_m) / spacing_m).astype(int) + 1
            found[tuple(map(slice, low, high))] = True
    return np.argwhere(found)


def signed_distance_grid(
    mesh: Mesh, origin_m: Float[np.ndarray, "3"], counts: Int[np.ndarray, "3"], spacing_m: float
) -> Float[np.ndarray, "x y z"]:
    """Return the signed distance to a mesh, exact at every fourth sample and interpolated between.

    Only the hands need a finer distance, see `sample_canonical_grid`.
    """
    coarse_axes = [
        origin + spacing_m * np.arange(0, count, DISTANCE_GRID_STRIDE)
        for origin, count in zip(origin_m, counts, strict=True)
    ]
    coarse_points = np.stack(np.meshgrid(*coarse_axes, indexing="ij"), axis=-1)
    coarse = signed_distance_m(coarse_points.reshape(-1, 3), mesh).reshape(coarse_points.shape[:3])
    return upsample(coarse, tuple(counts.tolist()))


def _depth_inside_m(samples: CanonicalGrid) -> Float[np.ndarray, "x y z"]:
    """Return the depth (m) below the surface of the body, computed on every second sample.

    A morphological closing fills the mouth, nostrils and eye sockets first.
    """
    inside = samples.body_distance_m[::2, ::2, ::2] < 0.0
    closed = largest_solid(ndimage.binary_closing(inside, ndimage.generate_binary_structure(3, 1), iterations=2))
    depth_m = 2.0 * samples.spacing_m * ndimage.gaussian_filter(ndimage.distance_transform_edt(closed), 1.0)
    return upsample(depth_m, samples.density.shape)


def _close_concavities(
    inside: Bool[np.ndarray, "x y z"], samples: CanonicalGrid, radius_m: float
) -> Float[np.ndarray, "x y z"]:
    """Return an indicator in [0, 1] of the morphological closing by a ball, restricted to the inside of the body.

    The density of surfaces that moved little relative to the camera has holes; the fitted body shows that they are no
    real holes. Computed on every second sample.
    """
    spacing_m = 2.0 * samples.spacing_m
    filled = closing(inside[::2, ::2, ::2], radius_m, spacing_m) & (samples.body_distance_m[::2, ::2, ::2] < 0.0)
    return upsample(ndimage.gaussian_filter(filled.astype(np.float64), 0.7), samples.density.shape)


def _close_skirt(inside: Bool[np.ndarray, "x y z"], samples: CanonicalGrid) -> Float[np.ndarray, "x y z"]:
    """Return an indicator in [0, 1] of the gaps in a skirt, see `gaps_in_skirt`; computed on every second sample."""
    coarse, solid = samples.downsampled(), inside[::2, ::2, ::2]
    gaps = gaps_in_skirt(solid, coarse)
    if not gaps.any():
        return np.zeros(inside.shape, dtype=np.float32)
    near = ndimage.binary_dilation(gaps, iterations=2)
    return upsample(near * ndimage.gaussian_filter((solid | gaps).astype(np.float64), 0.7), inside.shape)


def _fill_voids(inside: Bool[np.ndarray, "x y z"], samples: CanonicalGrid) -> Float[np.ndarray, "x y z"]:
    """Return an indicator in [0, 1] of voids into which a ball of `VOID_OPENING_RADIUS_M` cannot roll from outside.

    No ray ends inside voluminous hair, and a camera at the height of the chest does not see its top: the density is a
    shell with holes there. Computed on every second sample above the crotch.
    """
    coarse, solid = samples.downsampled(), inside[::2, ::2, ::2]
    upper = np.s_[:, max(0, round((coarse.crotch_m - coarse.origin_m[1]) / coarse.spacing_m)) :]
    radius = VOID_OPENING_RADIUS_M / coarse.spacing_m
    padded = np.pad(solid[upper], 1 + int(np.ceil(radius)))
    rooms, count = ndimage.label(ndimage.distance_transform_edt(~padded) > radius)
    if count < 2:
        return np.zeros(inside.shape, dtype=np.float32)
    is_outside = rooms == rooms[0, 0, 0]
    is_void = (rooms > 0) & ~is_outside
    unreachable = ndimage.distance_transform_edt(~is_outside) > radius
    filled = np.zeros_like(solid)
    middle = (slice(1 + int(np.ceil(radius)), -1 - int(np.ceil(radius))),) * 3
    filled[upper] = (unreachable & (ndimage.distance_transform_edt(~is_void) <= 2.0 * radius))[middle]
    near = ndimage.binary_dilation(filled, iterations=2)
    return upsample(near * ndimage.gaussian_filter((solid | filled).astype(np.float64), 0.7), inside.shape)


def fill_trousers(inside: Bool[np.ndarray, "x y z"], grid: LegGrid) -> Float[np.ndarray, "x y z"]:
    """Return an indicator in [0, 1] of the voids of horizontal slices of legs below the crotch, and the hem of a skirt.

    The density in wide trousers, around the leg, is arbitrary: it has voids that open below the hem in ragged holes.
    """
    lower = np.s_[:, : grid.row(grid.legs_top_m())]
    in_slice = np.zeros((3, 3, 3), dtype=bool)
    in_slice[:, 1, 1] = in_slice[1, 1, :] = True
    has_leg = (grid.body_distance_m[lower] < 0.0).any(axis=(0, 2), keepdims=True)
    solid = inside[lower] | (ndimage.binary_fill_holes(inside[lower], in_slice) & has_leg)
    near = ndimage.binary_dilation(solid & ~inside[lower], iterations=2)
    filled = np.zeros(inside.shape, dtype=np.float32)
    filled[lower] = near * ndimage.gaussian_filter(solid.astype(np.float32), 0.7)
    return filled


def upsample(grid: Float[np.ndarray, "a b c"], shape: tuple[int, ...]) -> Float[np.ndarray, "x y z"]:
    """Interpolate a downsampled grid trilinearly at all samples (float32)."""
    source = torch.from_numpy(grid).float()[None, None]
    return torch.nn.functional.interpolate(source, size=shape, mode="trilinear", align_corners=True)[0, 0].numpy()
