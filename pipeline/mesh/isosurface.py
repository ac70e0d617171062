"""From the canonical density to a first closed mesh: what the field saw, the body's core where it saw nothing, the
body's hands.

Inside a person no ray ever ends, so a trained density may be hollow, and it is anything at all where no frame looked.
The solid whose surface is taken is therefore: density above a level, or deeper inside the fitted body than a safe
inset; never farther from the body than clothes and hair reach; cavities filled.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import fast_simplification
import numpy as np
import torch
from jaxtyping import Bool, Float
from pydantic import Field
from scipy import ndimage
from scipy.sparse import csr_array
from scipy.sparse.linalg import splu
from scipy.spatial import cKDTree
from torch import Tensor

from pipeline.body.body import Body
from pipeline.core.config import Config
from pipeline.core.progress import warn
from pipeline.geometry.mesh import Mesh
from pipeline.geometry.surface import (
    OpenSurfaceError,
    closest_on_mesh,
    isosurface,
    laplacian,
    remesh,
    repair,
    signed_distance_m,
    smooth,
    solid_body,
)

DENSITY_CHUNK = 1 << 18
COARSE_STEP = 4
HAND_BAND_VOXELS = 4.0
COUNT_STEP = 8
"""Sample counts less one are multiples of this: every second sample of every second sample ends at the border."""
DECIMATION_SURPLUS = 3.0
HALF = 0.5


class ExtractConfig(Config):
    """Options of the first mesh."""

    voxel_m: float = Field(0.005, gt=0.001, le=0.03, description="spacing of the density samples, m")
    reach_m: float = Field(0.12, gt=0.0, le=0.5, description="farthest a surface may lie outside the fitted body, m")
    inset_m: float = Field(0.025, ge=0.0, le=0.2, description="deeper inside the fitted body than this all is solid, m")
    blur_voxels: float = Field(
        1.0, ge=0.0, le=4.0, description="Gaussian blur of the solid before its surface is taken, voxels"
    )
    pit_m: float = Field(
        0.03, ge=0.0, le=0.2, description="pits that a ball of this radius cannot enter are filled, inside the body, m"
    )
    body_hands: bool = Field(True, description="take hands and fingers from the fitted body, not from the field")


@dataclass(frozen=True)
class CanonicalSamples:
    """Density (1/m) and signed distance to the body (m) on a regular canonical grid, and how much each sample belongs
    to a hand."""

    origin_m: Float[np.ndarray, "3"]
    spacing_m: float
    density: Float[np.ndarray, "x y z"]
    body_distance_m: Float[np.ndarray, "x y z"]
    hand_share: Float[np.ndarray, "x y z"]

    def coarser(self) -> "CanonicalSamples":
        """Every second sample."""
        grids = (grid[::2, ::2, ::2] for grid in (self.density, self.body_distance_m, self.hand_share))
        return CanonicalSamples(self.origin_m, 2.0 * self.spacing_m, *grids)


def sample_canonical(density_of: Callable[[Tensor], Tensor], body: Body, config: ExtractConfig) -> CanonicalSamples:
    """Samples the density within reach of the body. density_of: canonical points (n, 3) m -> (n,) 1/m, 0 in empty
    space."""
    origin_m = body.vertices.min(axis=0) - config.reach_m
    counts = np.ceil((body.vertices.max(axis=0) + config.reach_m - origin_m) / config.voxel_m).astype(int)
    counts = COUNT_STEP * np.ceil(counts / COUNT_STEP).astype(int) + 1
    mesh = body.mesh()
    distance_m = _distance_grid(mesh, origin_m, counts, config.voxel_m)
    within = np.argwhere(distance_m < config.reach_m)
    points = (within * config.voxel_m + origin_m).astype(np.float32)
    density = np.zeros(distance_m.shape, dtype=np.float32)
    chunks = [density_of(chunk).detach() for chunk in torch.from_numpy(points).split(DENSITY_CHUNK)]
    density[tuple(within.T)] = torch.cat(chunks).numpy()
    hand_share = np.zeros_like(density)
    if config.body_hands:
        share_of_vertex = hand_weights(body)
        near_hand = _within_box(points, body.vertices[share_of_vertex > 0.0], config.reach_m)
        _, nearest = cKDTree(body.vertices).query(points[near_hand])
        hand_share[tuple(within[near_hand].T)] = share_of_vertex[nearest]
        edge = np.argwhere((hand_share > 0.0) & (np.abs(distance_m) < HAND_BAND_VOXELS * config.voxel_m))
        distance_m[tuple(edge.T)] = signed_distance_m(edge * config.voxel_m + origin_m, mesh)
    return CanonicalSamples(origin_m.astype(np.float64), config.voxel_m, density, distance_m, hand_share)


def hand_weights(body: Body) -> Float[np.ndarray, "v"]:
    """Share of each body vertex's skin weight that hands and fingers have, in [0, 1]; fades out over the wrist."""
    hands = [i for i, name in enumerate(body.joint_names) if "Hand" in name]
    return body.skin_weights[:, hands].sum(axis=1)


def _within_box(points: Float[np.ndarray, "n 3"], targets: Float[np.ndarray, "m 3"], margin_m: float) -> np.ndarray:
    """Numbers of the points that lie within the margin of the left or of the right targets' bounding box."""
    found = np.zeros(len(points), dtype=bool)
    for side in (targets[targets[:, 0] < 0], targets[targets[:, 0] >= 0]):
        if len(side):
            found |= ((points > side.min(axis=0) - margin_m) & (points < side.max(axis=0) + margin_m)).all(axis=1)
    return np.flatnonzero(found)


def _distance_grid(
    mesh: Mesh, origin_m: Float[np.ndarray, "3"], counts: np.ndarray, spacing_m: float
) -> Float[np.ndarray, "x y z"]:
    """Signed distance to a mesh, exact at every fourth sample and interpolated between: only hands need it finer."""
    coarse_axes = [
        origin + spacing_m * np.arange(0, count, COARSE_STEP) for origin, count in zip(origin_m, counts, strict=True)
    ]
    coarse_points = np.stack(np.meshgrid(*coarse_axes, indexing="ij"), axis=-1)
    coarse = signed_distance_m(coarse_points.reshape(-1, 3), mesh).reshape(coarse_points.shape[:3])
    return _upsampled(coarse, tuple(counts.tolist()))


def solid(samples: CanonicalSamples, level_per_m: float, config: ExtractConfig) -> Float[np.ndarray, "x y z"]:
    """Solidity in [0, 1] whose 0.5 surface is the person. level_per_m: density (1/m) that counts as half solid."""
    seen = samples.density / (samples.density + level_per_m)
    if config.blur_voxels > 0.0:
        seen = ndimage.gaussian_filter(seen, config.blur_voxels, truncate=3.0)
    ramp_m = 3.0 * samples.spacing_m
    core = np.clip(HALF + (_depth_inside_m(samples) - config.inset_m) / ramp_m, 0.0, 1.0)
    hand = np.clip(HALF - samples.body_distance_m / ramp_m, 0.0, 1.0)
    value = np.maximum(seen, core)
    value = np.maximum(value, _pits(value >= HALF, samples, config.pit_m))
    value += samples.hand_share * (hand - value)
    inside = solid_body(value >= HALF)
    # what the fill adds becomes solid, what belongs to another component becomes empty
    value = np.where(inside, np.maximum(value, np.where(value < HALF, 1.0, value)), np.minimum(value, HALF - 1e-3))
    return value.astype(np.float32)


def _depth_inside_m(samples: CanonicalSamples) -> Float[np.ndarray, "x y z"]:
    """Depth (m) below the body's outer skin, on every second sample: mouth, nostrils and eye sockets count as flesh."""
    inside = samples.body_distance_m[::2, ::2, ::2] < 0.0
    closed = solid_body(ndimage.binary_closing(inside, ndimage.generate_binary_structure(3, 1), iterations=2))
    depth_m = 2.0 * samples.spacing_m * ndimage.gaussian_filter(ndimage.distance_transform_edt(closed), 1.0)
    return _upsampled(depth_m, samples.density.shape)


def _pits(inside: Bool[np.ndarray, "x y z"], samples: CanonicalSamples, radius_m: float) -> Float[np.ndarray, "x y z"]:
    """Solidity in [0, 1] of what a ball of the radius cannot enter from outside and the fitted body fills.

    Where a surface moved little against the camera its density has holes; the body says that there is no real one.
    Counted on every second sample.
    """
    spacing_m = 2.0 * samples.spacing_m
    outside_m = spacing_m * ndimage.distance_transform_edt(~inside[::2, ::2, ::2])
    closed = spacing_m * ndimage.distance_transform_edt(outside_m <= radius_m) > radius_m
    filled = closed & (samples.body_distance_m[::2, ::2, ::2] < 0.0)
    return _upsampled(ndimage.gaussian_filter(filled.astype(np.float64), 0.7), samples.density.shape)


def _upsampled(grid: Float[np.ndarray, "a b c"], shape: tuple[int, ...]) -> Float[np.ndarray, "x y z"]:
    """A grid of every n-th sample, interpolated at all samples (float32)."""
    source = torch.from_numpy(grid).float()[None, None]
    return torch.nn.functional.interpolate(source, size=shape, mode="trilinear", align_corners=True)[0, 0].numpy()


def extract_mesh(samples: CanonicalSamples, level_per_m: float, config: ExtractConfig) -> Mesh:
    """Watertight marching-cubes surface of the solid, one component, not yet simplified.

    Raises ValueError when the level leaves nothing.
    """
    return repair(isosurface(solid(samples, level_per_m, config), HALF, samples.origin_m, samples.spacing_m))


def choose_level(
    samples: CanonicalSamples, config: ExtractConfig, levels_per_m: Sequence[float], score: Callable[[Mesh], float]
) -> tuple[float, float]:
    """The density level (1/m) whose surface scores best, and its score; tried on every second sample."""
    coarse = samples.coarser()
    scores = []
    for level in levels_per_m:
        mesh = isosurface(solid(coarse, level, config), HALF, coarse.origin_m, coarse.spacing_m)
        scores.append(score(mesh))
    best = int(np.argmax(scores))
    return float(levels_per_m[best]), scores[best]


def simplify(mesh: Mesh, edge_m: float, smoothing: int = 10) -> Mesh:
    """The surface with well-shaped triangles of about one edge length (m), shorter where it is strongly curved.

    smoothing: steps of Taubin smoothing at the end, which take the density's noise and leave the volume.
    """
    dense = int(mesh.face_areas_m2().sum() / (0.43 * edge_m**2) * DECIMATION_SURPLUS)
    if len(mesh.faces) > dense:
        mesh = unless_open(lambda: decimate(mesh, dense), mesh, "its triangles were not reduced before remeshing")
    even = unless_open(
        lambda: remesh(mesh, edge_m, iterations=6, tolerance_m=0.15 * edge_m), mesh, "its triangles stay uneven"
    )
    return smooth(even, smoothing)


def decimate(mesh: Mesh, face_count: int) -> Mesh:
    """The surface with about that many triangles, closed; raises OpenSurfaceError."""
    vertices, faces = fast_simplification.simplify(mesh.vertices, mesh.faces, target_count=face_count)
    return repair(Mesh(vertices.astype(np.float32), faces.astype(np.int32)))


def unless_open(change: Callable[[], Mesh], before: Mesh, consequence: str) -> Mesh:
    """The changed surface; the one before, with a warning, where the change tears holes that cannot be closed."""
    try:
        return change()
    except OpenSurfaceError as error:
        warn(f"{error}; {consequence}")
        return before


def transfer_skin_weights(
    mesh: Mesh, body: Body, reach_m: float = 0.08, smoothing: int = 4
) -> Float[np.ndarray, "v j"]:
    """Skin weights (v, j), rows summing to 1, for a mesh around the body in the canonical pose.

    A vertex takes the weights of the nearest place on the body if that is within reach and faces the same way (within
    60 degrees); all others (an arm's inner side that is nearer to the trunk, loose cloth) are filled in harmonically
    from those over the mesh (after Abdrashitov et al., "Robust Skin Weights Transfer via Weight Inpainting", 2023). A
    few smoothing steps end it.
    """
    body_mesh = body.mesh()
    distance_m, face, barycentric = closest_on_mesh(mesh.vertices, body_mesh)
    weights = np.einsum("nk,nkj->nj", barycentric, body.skin_weights[body.faces[face]])
    normals = np.einsum("nk,nkj->nj", barycentric, body_mesh.vertex_normals()[body.faces[face]])
    trusted = (distance_m <= reach_m) & (np.sum(normals * mesh.vertex_normals(), axis=1) >= HALF)
    operator = laplacian(mesh)
    if trusted.any() and not trusted.all():
        weights[~trusted] = _harmonic_fill(operator, weights, trusted)
    for _ in range(smoothing):
        weights = weights - HALF * (operator @ weights)
    weights = np.clip(weights, 0.0, None)
    return (weights / weights.sum(axis=1, keepdims=True)).astype(np.float32)


def _harmonic_fill(
    operator: csr_array, values: Float[np.ndarray, "v c"], known: np.ndarray
) -> Float[np.ndarray, "u c"]:
    """Values at the unknown vertices that equal the mean of their neighbours, given the known ones."""
    rows = operator[~known]
    # a piece without any known vertex would be singular; the tiny pull towards its own values keeps it solvable
    inner = rows[:, ~known].tocsc()
    inner.setdiag(inner.diagonal() + 1e-6)
    return splu(inner).solve(1e-6 * values[~known] - rows[:, known] @ values[known])
