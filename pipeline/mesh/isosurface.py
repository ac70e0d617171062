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
    closest_points_on_mesh,
    isosurface,
    laplacian,
    largest_solid,
    remesh_isotropic,
    repair,
    signed_distance_m,
    smooth_taubin,
)

DENSITY_CHUNK = 1 << 18
DISTANCE_GRID_STRIDE = 4
HAND_NARROW_BAND_VOXELS = 4.0
GRID_SIZE_MULTIPLE = 8
"""Sample counts less one are multiples of this: every second sample of every second sample ends at the border."""
DECIMATION_FACE_RATIO = 3.0
HALF = 0.5


class ExtractConfig(Config):
    """Options of the first mesh."""

    voxel_size_m: float = Field(0.005, gt=0.001, le=0.03, description="spacing of the density samples, m")
    max_body_distance_m: float = Field(
        0.12, gt=0.0, le=0.5, description="farthest a surface may lie outside the fitted body, m"
    )
    solid_core_depth_m: float = Field(
        0.025, ge=0.0, le=0.2, description="deeper inside the fitted body than this all is solid, m"
    )
    blur_sigma_voxels: float = Field(
        1.0, ge=0.0, le=4.0, description="Gaussian blur of the solid before its surface is taken, voxels"
    )
    closing_radius_m: float = Field(
        0.03, ge=0.0, le=0.2, description="pits that a ball of this radius cannot enter are filled, inside the body, m"
    )
    hands_from_body: bool = Field(True, description="take hands and fingers from the fitted body, not from the field")


@dataclass(frozen=True)
class CanonicalGrid:
    """Density (1/m) and signed distance to the body (m) on a regular canonical grid, and how much each sample belongs
    to a hand."""

    origin_m: Float[np.ndarray, "3"]
    spacing_m: float
    density: Float[np.ndarray, "x y z"]
    body_distance_m: Float[np.ndarray, "x y z"]
    hand_weight: Float[np.ndarray, "x y z"]

    def downsampled(self) -> "CanonicalGrid":
        """Every second sample."""
        grids = (grid[::2, ::2, ::2] for grid in (self.density, self.body_distance_m, self.hand_weight))
        return CanonicalGrid(self.origin_m, 2.0 * self.spacing_m, *grids)


def sample_canonical_grid(density_fn: Callable[[Tensor], Tensor], body: Body, config: ExtractConfig) -> CanonicalGrid:
    """Samples the density within reach of the body. density_of: canonical points (n, 3) m -> (n,) 1/m, 0 in empty
    space."""
    origin_m = body.vertices.min(axis=0) - config.max_body_distance_m
    counts = np.ceil((body.vertices.max(axis=0) + config.max_body_distance_m - origin_m) / config.voxel_size_m).astype(
        int
    )
    counts = GRID_SIZE_MULTIPLE * np.ceil(counts / GRID_SIZE_MULTIPLE).astype(int) + 1
    mesh = body.mesh()
    distance_m = _signed_distance_grid(mesh, origin_m, counts, config.voxel_size_m)
    within = np.argwhere(distance_m < config.max_body_distance_m)
    points = (within * config.voxel_size_m + origin_m).astype(np.float32)
    density = np.zeros(distance_m.shape, dtype=np.float32)
    chunks = [density_fn(chunk).detach() for chunk in torch.from_numpy(points).split(DENSITY_CHUNK)]
    density[tuple(within.T)] = torch.cat(chunks).numpy()
    hand_weight = np.zeros_like(density)
    if config.hands_from_body:
        vertex_hand_weight = hand_skin_weights(body)
        near_hand = _indices_in_side_boxes(points, body.vertices[vertex_hand_weight > 0.0], config.max_body_distance_m)
        _, nearest = cKDTree(body.vertices).query(points[near_hand])
        hand_weight[tuple(within[near_hand].T)] = vertex_hand_weight[nearest]
        edge = np.argwhere((hand_weight > 0.0) & (np.abs(distance_m) < HAND_NARROW_BAND_VOXELS * config.voxel_size_m))
        distance_m[tuple(edge.T)] = signed_distance_m(edge * config.voxel_size_m + origin_m, mesh)
    return CanonicalGrid(origin_m.astype(np.float64), config.voxel_size_m, density, distance_m, hand_weight)


def hand_skin_weights(body: Body) -> Float[np.ndarray, "v"]:
    """Share of each body vertex's skin weight that hands and fingers have, in [0, 1]; fades out over the wrist."""
    hands = [i for i, name in enumerate(body.joint_names) if "Hand" in name]
    return body.skin_weights[:, hands].sum(axis=1)


def _indices_in_side_boxes(
    points: Float[np.ndarray, "n 3"], targets: Float[np.ndarray, "m 3"], margin_m: float
) -> np.ndarray:
    """Numbers of the points that lie within the margin of the left or of the right targets' bounding box."""
    found = np.zeros(len(points), dtype=bool)
    for side in (targets[targets[:, 0] < 0], targets[targets[:, 0] >= 0]):
        if len(side):
            found |= ((points > side.min(axis=0) - margin_m) & (points < side.max(axis=0) + margin_m)).all(axis=1)
    return np.flatnonzero(found)


def _signed_distance_grid(
    mesh: Mesh, origin_m: Float[np.ndarray, "3"], counts: np.ndarray, spacing_m: float
) -> Float[np.ndarray, "x y z"]:
    """Signed distance to a mesh, exact at every fourth sample and interpolated between: only hands need it finer."""
    coarse_axes = [
        origin + spacing_m * np.arange(0, count, DISTANCE_GRID_STRIDE)
        for origin, count in zip(origin_m, counts, strict=True)
    ]
    coarse_points = np.stack(np.meshgrid(*coarse_axes, indexing="ij"), axis=-1)
    coarse = signed_distance_m(coarse_points.reshape(-1, 3), mesh).reshape(coarse_points.shape[:3])
    return _upsample(coarse, tuple(counts.tolist()))


def indicator_grid(samples: CanonicalGrid, isovalue_per_m: float, config: ExtractConfig) -> Float[np.ndarray, "x y z"]:
    """Solidity in [0, 1] whose 0.5 surface is the person. level_per_m: density (1/m) that counts as half solid."""
    density_indicator = samples.density / (samples.density + isovalue_per_m)
    if config.blur_sigma_voxels > 0.0:
        density_indicator = ndimage.gaussian_filter(density_indicator, config.blur_sigma_voxels, truncate=3.0)
    ramp_m = 3.0 * samples.spacing_m
    core = np.clip(HALF + (_depth_inside_m(samples) - config.solid_core_depth_m) / ramp_m, 0.0, 1.0)
    hand = np.clip(HALF - samples.body_distance_m / ramp_m, 0.0, 1.0)
    value = np.maximum(density_indicator, core)
    value = np.maximum(value, _close_concavities(value >= HALF, samples, config.closing_radius_m))
    value += samples.hand_weight * (hand - value)
    inside = largest_solid(value >= HALF)
    # what the fill adds becomes solid, what belongs to another component becomes empty
    value = np.where(inside, np.maximum(value, np.where(value < HALF, 1.0, value)), np.minimum(value, HALF - 1e-3))
    return value.astype(np.float32)


def _depth_inside_m(samples: CanonicalGrid) -> Float[np.ndarray, "x y z"]:
    """Depth (m) below the body's outer skin, on every second sample: mouth, nostrils and eye sockets count as flesh."""
    inside = samples.body_distance_m[::2, ::2, ::2] < 0.0
    closed = largest_solid(ndimage.binary_closing(inside, ndimage.generate_binary_structure(3, 1), iterations=2))
    depth_m = 2.0 * samples.spacing_m * ndimage.gaussian_filter(ndimage.distance_transform_edt(closed), 1.0)
    return _upsample(depth_m, samples.density.shape)


def _close_concavities(
    inside: Bool[np.ndarray, "x y z"], samples: CanonicalGrid, radius_m: float
) -> Float[np.ndarray, "x y z"]:
    """Solidity in [0, 1] of what a ball of the radius cannot enter from outside and the fitted body fills.

    Where a surface moved little against the camera its density has holes; the body says that there is no real one.
    Counted on every second sample.
    """
    spacing_m = 2.0 * samples.spacing_m
    outside_m = spacing_m * ndimage.distance_transform_edt(~inside[::2, ::2, ::2])
    closed = spacing_m * ndimage.distance_transform_edt(outside_m <= radius_m) > radius_m
    filled = closed & (samples.body_distance_m[::2, ::2, ::2] < 0.0)
    return _upsample(ndimage.gaussian_filter(filled.astype(np.float64), 0.7), samples.density.shape)


def _upsample(grid: Float[np.ndarray, "a b c"], shape: tuple[int, ...]) -> Float[np.ndarray, "x y z"]:
    """A grid of every n-th sample, interpolated at all samples (float32)."""
    source = torch.from_numpy(grid).float()[None, None]
    return torch.nn.functional.interpolate(source, size=shape, mode="trilinear", align_corners=True)[0, 0].numpy()


def extract_mesh(samples: CanonicalGrid, isovalue_per_m: float, config: ExtractConfig) -> Mesh:
    """Watertight marching-cubes surface of the solid, one component, not yet simplified.

    Raises ValueError when the level leaves nothing.
    """
    return repair(
        isosurface(indicator_grid(samples, isovalue_per_m, config), HALF, samples.origin_m, samples.spacing_m)
    )


def select_isovalue(
    samples: CanonicalGrid, config: ExtractConfig, isovalues_per_m: Sequence[float], score: Callable[[Mesh], float]
) -> tuple[float, float]:
    """The density level (1/m) whose surface scores best, and its score; tried on every second sample."""
    coarse = samples.downsampled()
    scores = []
    for level in isovalues_per_m:
        mesh = isosurface(indicator_grid(coarse, level, config), HALF, coarse.origin_m, coarse.spacing_m)
        scores.append(score(mesh))
    best = int(np.argmax(scores))
    return float(isovalues_per_m[best]), scores[best]


def simplify(mesh: Mesh, target_edge_m: float, smoothing: int = 10) -> Mesh:
    """The surface with well-shaped triangles of about one edge length (m), shorter where it is strongly curved.

    smoothing: steps of Taubin smoothing at the end, which take the density's noise and leave the volume.
    """
    dense_face_count = int(mesh.face_areas_m2().sum() / (0.43 * target_edge_m**2) * DECIMATION_FACE_RATIO)
    if len(mesh.faces) > dense_face_count:
        mesh = keep_if_repair_fails(
            lambda: decimate(mesh, dense_face_count), mesh, "its triangles were not reduced before remeshing"
        )
    remeshed = keep_if_repair_fails(
        lambda: remesh_isotropic(mesh, target_edge_m, iterations=6, tolerance_m=0.15 * target_edge_m),
        mesh,
        "its triangles stay uneven",
    )
    return smooth_taubin(remeshed, smoothing)


def decimate(mesh: Mesh, face_count: int) -> Mesh:
    """The surface with about that many triangles, closed; raises OpenSurfaceError."""
    vertices, faces = fast_simplification.simplify(mesh.vertices, mesh.faces, target_count=face_count)
    return repair(Mesh(vertices.astype(np.float32), faces.astype(np.int32)))


def keep_if_repair_fails(change: Callable[[], Mesh], before: Mesh, consequence: str) -> Mesh:
    """The changed surface; the one before, with a warning, where the change tears holes that cannot be closed."""
    try:
        return change()
    except OpenSurfaceError as error:
        warn(f"{error}; {consequence}")
        return before


def transfer_skin_weights(
    mesh: Mesh, body: Body, max_body_distance_m: float = 0.08, smoothing: int = 4
) -> Float[np.ndarray, "v j"]:
    """Skin weights (v, j), rows summing to 1, for a mesh around the body in the canonical pose.

    A vertex takes the weights of the nearest place on the body if that is within reach and faces the same way (within
    60 degrees); all others (an arm's inner side that is nearer to the trunk, loose cloth) are filled in harmonically
    from those over the mesh (after Abdrashitov et al., "Robust Skin Weights Transfer via Weight Inpainting", 2023). A
    few smoothing steps end it.
    """
    body_mesh = body.mesh()
    distance_m, face, barycentric = closest_points_on_mesh(mesh.vertices, body_mesh)
    weights = np.einsum("nk,nkj->nj", barycentric, body.skin_weights[body.faces[face]])
    normals = np.einsum("nk,nkj->nj", barycentric, body_mesh.vertex_normals()[body.faces[face]])
    matched = (distance_m <= max_body_distance_m) & (np.sum(normals * mesh.vertex_normals(), axis=1) >= HALF)
    operator = laplacian(mesh)
    if matched.any() and not matched.all():
        weights[~matched] = _harmonic_fill(operator, weights, matched)
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
