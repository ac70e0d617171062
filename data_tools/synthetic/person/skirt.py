"""Build a skirt: one closed surface around both legs, skinned to hips and thighs.

The surface is a grid: columns around the body times a profile down the outer side and up the inner side. Each row
encloses the convex hull of the body at its height and is at least as wide as the row above, so the cloth spans the gap
between the legs and falls straight from the widest height.
"""

from collections.abc import Callable

import numpy as np
from jaxtyping import Float, Int
from scipy.spatial import ConvexHull

from data_tools.synthetic.person.anatomy import Anatomy
from data_tools.synthetic.person.noise import ValueNoise
from data_tools.synthetic.person.outfit import Outfit
from data_tools.synthetic.person.surface import WornSurface, hull_exit_distance_m
from pipeline.body.body import Body

ROWS, COLUMNS = 40, 192
N_PLEATS = 14
THICKNESS_M = 0.004
EASE_M = 0.006
"""Distance between the skirt and the surface below it, at the waist."""

PLEAT_DEPTH_M = 0.028
"""Depth of the pleats at the hem."""

ATLAS_HEIGHT_FRACTION = 0.25
"""Fraction of the texture height, at the top, that the skirt occupies."""

_ATLAS_MARGIN = 0.004
_MAX_ARM_WEIGHT = 0.02
_SLICE_HALF_HEIGHT_M = 0.03
_WEIGHT_SIGMA_M = (0.02, 0.06)
"""Standard deviation of the Gaussian that averages the skin weights of the body, at waist and hem."""


def build_skirt(
    body: Body, arm_weights: Float[np.ndarray, "v"], anatomy: Anatomy, noise: ValueNoise, outfit: Outfit
) -> WornSurface:
    """Fit a skirt around a clothed person in the A-pose.

    arm_weights: skin weight of each vertex on the arms, in [0, 1]; vertices on arms are ignored.
    """
    waist_to_hem = np.linspace(0.0, 1.0, ROWS)
    trunk = arm_weights < _MAX_ARM_WEIGHT
    outer_surface = _outer_surface_m(body.vertices[trunk], waist_to_hem, anatomy, noise, outfit)
    axis = _axis_m(outer_surface[:, 0, 1], anatomy)[:, None]
    inwards = axis - outer_surface
    inside = outer_surface + THICKNESS_M * inwards / np.linalg.norm(inwards, axis=2, keepdims=True)
    vertices = np.concatenate([outer_surface, inside[::-1]]).reshape(-1, 3).astype(np.float32)
    shared = _average_skin_weights(body, trunk, outer_surface, waist_to_hem)
    weights = np.concatenate([shared, shared[::-1]]).reshape(-1, shared.shape[2])
    profile, column = np.divmod(np.arange((2 * ROWS + 1) * (COLUMNS + 1)), COLUMNS + 1)
    across = _ATLAS_MARGIN + (1.0 - 2.0 * _ATLAS_MARGIN) * column / COLUMNS
    height = 1.0 - _ATLAS_MARGIN - (ATLAS_HEIGHT_FRACTION - 2.0 * _ATLAS_MARGIN) * profile / (2 * ROWS)
    faces_uv = _quads(2 * ROWS, COLUMNS, lambda row, col: row * (COLUMNS + 1) + col)
    faces = _quads(2 * ROWS, COLUMNS, lambda row, col: row % (2 * ROWS) * COLUMNS + col % COLUMNS)
    return WornSurface(vertices, faces, np.stack([across, height], axis=1).astype(np.float32), faces_uv, weights)


def waist_and_hem_m(anatomy: Anatomy, outfit: Outfit) -> tuple[float, float]:
    """Return the heights of waist and hem: above the hips, and that of the outfit or above the knees."""
    hem_m = float(anatomy.joints_m["LeftLeg"][1]) + 0.05 if outfit.hem_m is None else outfit.hem_m
    return float(anatomy.joints_m["Hips"][1]) + 0.07, hem_m


def _outer_surface_m(
    trunk_m: Float[np.ndarray, "n 3"],
    waist_to_hem: Float[np.ndarray, "r"],
    anatomy: Anatomy,
    noise: ValueNoise,
    outfit: Outfit,
) -> Float[np.ndarray, "r c 3"]:
    """Return positions of the outer side; rows from waist (0) to hem (1), columns from +X towards +Z."""
    top, hem = waist_and_hem_m(anatomy, outfit)
    height = top + (hem - top) * waist_to_hem
    axis = _axis_m(height, anatomy)
    angle = 2.0 * np.pi * np.arange(COLUMNS) / COLUMNS
    outwards = np.stack([np.cos(angle), np.zeros(COLUMNS), np.sin(angle)], axis=1)
    body = np.stack([_hull_radius_m(trunk_m, middle, outwards) for middle in axis])
    radius = np.maximum.accumulate(body) + EASE_M + outfit.hem_flare_m * waist_to_hem[:, None]
    ring = np.broadcast_to(outwards, (ROWS, COLUMNS, 3)) * 0.3 + np.array([0.0, 0.2, 0.0]) * waist_to_hem[:, None, None]
    pleat_phase_noise = noise(ring.reshape(-1, 3).astype(np.float32), 0.11, order=3).reshape(ROWS, COLUMNS)
    pleats = 0.5 + 0.5 * np.cos(N_PLEATS * angle + 1.2 * pleat_phase_noise)
    radius += waist_to_hem[:, None] ** 1.3 * (PLEAT_DEPTH_M * pleats + 0.010 * (1.0 + pleat_phase_noise))
    return axis[:, None] + radius[:, :, None] * outwards


def _axis_m(height_m: Float[np.ndarray, "r"], anatomy: Anatomy) -> Float[np.ndarray, "r 3"]:
    """Return the points midway between the legs, which are inside the convex hull at each height."""
    leg = np.stack([anatomy.joints_m[name] for name in ("LeftLeg", "LeftUpLeg", "Spine")]).astype(np.float64)
    middle_z = np.interp(height_m, leg[:, 1], leg[:, 2])
    middle_x = np.full(len(height_m), anatomy.joints_m["Hips"][0])
    return np.stack([middle_x, height_m, middle_z], axis=1)


def _hull_radius_m(
    points_m: Float[np.ndarray, "n 3"], middle_m: Float[np.ndarray, "3"], outwards: Float[np.ndarray, "c 3"]
) -> Float[np.ndarray, "c"]:
    """Return the distances at which horizontal rays from the middle leave the convex hull near that height."""
    near = np.abs(points_m[:, 1] - middle_m[1]) < _SLICE_HALF_HEIGHT_M
    hull = ConvexHull(points_m[near][:, [0, 2]] - middle_m[[0, 2]]).equations
    return hull_exit_distance_m(np.zeros((1, 2)), outwards[:, [0, 2]], hull)


def _average_skin_weights(
    body: Body, trunk: np.ndarray, outside_m: Float[np.ndarray, "r c 3"], waist_to_hem: Float[np.ndarray, "r"]
) -> Float[np.ndarray, "r c j"]:
    """Average the skin weights of the body around each position, with a larger radius at lower heights.

    Weights on a lower leg are added to the thigh, because cloth above the knee does not follow the calf.
    """
    joints = [body.joint(name) for name in ("Hips", "Spine", "LeftUpLeg", "RightUpLeg")]
    body_weights = body.skin_weights[:, joints].astype(np.float64)
    body_weights[:, 0] = 1.0 - body_weights[:, 1:].sum(axis=1)
    for column, side in ((2, "Left"), (3, "Right")):
        lower = body.skin_weights[:, body.joint(f"{side}Leg")]
        body_weights[:, [0, column]] += lower[:, None] * [-1.0, 1.0]
    height = outside_m[:, 0, 1]
    near = trunk & (body.vertices[:, 1] > height[-1] - 0.1) & (body.vertices[:, 1] < height[0] + 0.1)
    positions_m, body_weights = body.vertices[near].astype(np.float64), body_weights[near]
    weights = np.zeros((*outside_m.shape[:2], len(body.joint_names)), dtype=np.float32)
    for row, sigma_m in enumerate(_WEIGHT_SIGMA_M[0] + (_WEIGHT_SIGMA_M[1] - _WEIGHT_SIGMA_M[0]) * waist_to_hem):
        squared_distance_m2 = ((outside_m[row][:, None] - positions_m) ** 2).sum(axis=2)
        kernel = np.exp(-0.5 * (squared_distance_m2 - squared_distance_m2.min(axis=1, keepdims=True)) / sigma_m**2)
        kernel /= kernel.sum(axis=1, keepdims=True)
        for joint, values in zip(joints, body_weights.T, strict=True):
            weights[row, :, joint] = (kernel * values).sum(axis=1)
    return weights


def _quads(rows: int, columns: int, index: Callable[[np.ndarray, np.ndarray], np.ndarray]) -> Int[np.ndarray, "f 3"]:
    """Return two triangles per grid cell, counter-clockwise seen from outside."""
    row, column = np.divmod(np.arange(rows * columns), columns)
    a, b, c, d = index(row, column), index(row, column + 1), index(row + 1, column + 1), index(row + 1, column)
    return np.stack([a, b, c, a, c, d], axis=1).reshape(-1, 3).astype(np.int32)
