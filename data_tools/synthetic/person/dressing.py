"""Clothes as offset surfaces: one closed surface that steps outwards at every hem.

The body's surface is refined, smoothed where cloth does not follow it (navel, shoulder blades), pushed out along its
normals by the thickness and the folds of each layer, and keeps the body's skin weights. It is draped twice: the second
time the cuts are measured on the first drape, where cloth is smooth, so that hems and prints run straight. A skirt is a
second closed surface around the legs.
"""

from dataclasses import dataclass, replace

import numpy as np
import scipy.sparse as sparse
from jaxtyping import Float, Int
from scipy.spatial import ConvexHull

from data_tools.synthetic.person.anatomy import SKIN, SKIRT, Anatomy, limb_weights, surface_kinds
from data_tools.synthetic.person.noise import Noise
from data_tools.synthetic.person.outfit import LAYERS, Outfit, layer_depths
from data_tools.synthetic.person.skirt import ATLAS_SHARE, hang_skirt
from data_tools.synthetic.person.surface import neighbour_mean, smoothed, split_at_midpoints, way_out_m, with_midpoints
from pipeline.body.body import AnnyBody, Body
from pipeline.geometry.mesh import Mesh

HEM_WIDTH_M = 0.006
"""Over this distance a layer rises from nothing to its thickness."""

TOE_BOX_HEIGHT_M = 0.075
"""Below this height a shoe is the convex hull of the foot, so that no toes show."""

SHOE_M = 0.008
"""Thickness of the shoes' upper."""

_HULL_ROUNDS = 10
_SMOOTHING_ROUNDS = {"shoes": 2, "trousers": 24, "shirt": 40, "hair": 6}


@dataclass(frozen=True)
class Dressed:
    """The clothed surface and what the painter needs to know about it; rows are vertices.

    `drape_m` is the surface that the cuts of `layer_depths` were measured on.
    """

    body: Body
    uv: Float[np.ndarray, "t 2"]
    faces_uv: Int[np.ndarray, "f 3"]
    drape_m: Float[np.ndarray, "v 3"]
    limbs: Float[np.ndarray, "v 2"]
    kinds: Int[np.ndarray, "f"]


def dress(model: AnnyBody, body: Body, anatomy: Anatomy, outfit: Outfit, noise: Noise) -> Dressed:
    """Refine a person's body once and put the outfit on it."""
    pairs, faces = split_at_midpoints(body.faces, len(body.vertices))
    uv_pairs, faces_uv = split_at_midpoints(model.faces_uv, len(model.uv))
    bare = with_midpoints(body.vertices, pairs)
    limbs = with_midpoints(limb_weights(body), pairs)
    kinds = np.repeat(surface_kinds(body), 4)
    skin_vertices = np.zeros(len(bare), dtype=bool)
    skin_vertices[faces[kinds == SKIN]] = True
    mean = neighbour_mean(faces, len(bare))
    shod = _with_toe_boxes(bare, mean, skin_vertices, anatomy)
    vertices = drape = shod
    for _ in range(2):
        drape = vertices
        depths = np.where(skin_vertices[:, None], layer_depths(drape, limbs, anatomy, outfit), -1.0)
        vertices = _with_layers(shod, faces, mean, depths, anatomy, noise)
    dressed = replace(body, vertices=vertices, faces=faces, skin_weights=with_midpoints(body.skin_weights, pairs))
    whole = Dressed(dressed, with_midpoints(model.uv, uv_pairs), faces_uv, drape, limbs, kinds)
    return _with_skirt(whole, anatomy, noise) if outfit.legwear == "skirt" else whole


def _with_skirt(person: Dressed, anatomy: Anatomy, noise: Noise) -> Dressed:
    """Add the sheet around the legs; the body's charts make room for its own at the top of the atlas."""
    sheet = hang_skirt(person.body, person.limbs[:, 0], anatomy, noise)
    worn, start, start_uv = person.body, len(person.body.vertices), len(person.uv)
    body = replace(
        worn,
        vertices=np.concatenate([worn.vertices, sheet.vertices]),
        faces=np.concatenate([worn.faces, sheet.faces + start]),
        skin_weights=np.concatenate([worn.skin_weights, sheet.skin_weights]),
    )
    return Dressed(
        body=body,
        uv=np.concatenate([person.uv * np.array([1.0, 1.0 - ATLAS_SHARE], np.float32), sheet.uv]),
        faces_uv=np.concatenate([person.faces_uv, sheet.faces_uv + start_uv]),
        drape_m=np.concatenate([person.drape_m, sheet.vertices]),
        limbs=np.concatenate([person.limbs, np.zeros((len(sheet.vertices), 2), np.float32)]),
        kinds=np.concatenate([person.kinds, np.full(len(sheet.faces), SKIRT, person.kinds.dtype)]),
    )


def _with_layers(
    skin_m: Float[np.ndarray, "v 3"],
    faces: Int[np.ndarray, "f 3"],
    mean: sparse.csr_matrix,
    depths_m: Float[np.ndarray, "v 4"],
    anatomy: Anatomy,
    noise: Noise,
) -> Float[np.ndarray, "v 3"]:
    """Put one layer after the other over the surface."""
    vertices = skin_m
    for column, layer in enumerate(LAYERS):
        smooth = smoothed(vertices, mean, _SMOOTHING_ROUNDS[layer])
        normals = Mesh(smooth, faces).vertex_normals()
        thickness = _THICKNESS[layer](skin_m, depths_m[:, column], anatomy, noise)
        inside = np.clip(depths_m[:, column] / HEM_WIDTH_M + 0.5, 0.0, 1.0)[:, None]
        vertices = vertices + inside * (smooth + thickness[:, None] * normals - vertices)
        if layer == "shoes":
            vertices = _with_flat_sole(vertices, inside[:, 0])
    return vertices.astype(np.float32)


def _with_toe_boxes(
    bare_m: Float[np.ndarray, "v 3"], mean: sparse.csr_matrix, skin_vertices: np.ndarray, anatomy: Anatomy
) -> Float[np.ndarray, "v 3"]:
    """Wrap the lower part of each foot around its convex hull, which closes the gaps between the toes.

    Smoothing and projecting in turns spreads the toes' sides, which would lie folded on the hull, over its surface.
    """
    vertices = bare_m
    for side in ("Left", "Right"):
        ankle, toes = anatomy.joints_m[f"{side}Foot"], anatomy.joints_m[f"{side}ToeBase"]
        on_foot = skin_vertices & (np.abs(bare_m[:, 0] - ankle[0]) < 0.15) & (bare_m[:, 1] < TOE_BOX_HEIGHT_M)
        hull = ConvexHull(bare_m[on_foot]).equations
        for _ in range(_HULL_ROUNDS):
            vertices = np.where(on_foot[:, None], smoothed(vertices, mean, 4), vertices)
            vertices[on_foot] = _onto_hull(vertices[on_foot], hull, toes)
    return vertices


def _onto_hull(
    points: Float[np.ndarray, "n 3"], hull: Float[np.ndarray, "h 4"], toes: Float[np.ndarray, "3"]
) -> Float[np.ndarray, "n 3"]:
    """Where rays from the foot's axis through the points leave the hull widened by `SHOE_M`."""
    ahead = np.minimum(points[:, 2], toes[2] - 0.03)
    axis = np.stack([np.full(len(points), toes[0]), np.full(len(points), 0.012), ahead], axis=1)
    outwards = points - axis
    outwards /= np.maximum(np.linalg.norm(outwards, axis=1, keepdims=True), 1e-9)
    return (axis + way_out_m(axis, outwards, hull, SHOE_M)[:, None] * outwards).astype(points.dtype)


def _with_flat_sole(vertices: Float[np.ndarray, "v 3"], inside: Float[np.ndarray, "v"]) -> Float[np.ndarray, "v 3"]:
    """Press the lowest 12 mm of the shoes into one plane, so that the person stands."""
    sole_y = vertices[inside > 0.5, 1].min() + 0.012
    flat = vertices.copy()
    flat[:, 1] = np.where((inside > 0.5) & (flat[:, 1] < sole_y), sole_y - 0.012, flat[:, 1])
    return flat


def _shoe_thickness(points: np.ndarray, depth: np.ndarray, anatomy: Anatomy, noise: Noise) -> np.ndarray:
    """Nothing where the hull already made room for the shoe, its thickness above."""
    return np.where(points[:, 1] < TOE_BOX_HEIGHT_M, 0.0, SHOE_M)


def _trouser_thickness(points: np.ndarray, depth: np.ndarray, anatomy: Anatomy, noise: Noise) -> np.ndarray:
    """Close at the hip, wide at the hem; folds gather at the knee and above the shoe."""
    knee_y, foot_y = anatomy.joints_m["LeftLeg"][1], anatomy.joints_m["LeftFoot"][1]
    fall = np.clip((anatomy.joints_m["Hips"][1] - points[:, 1]) / (anatomy.joints_m["Hips"][1] - foot_y), 0, 1)
    gather = np.exp(-(((points[:, 1] - knee_y) / 0.07) ** 2)) + np.exp(-(((points[:, 1] - foot_y) / 0.10) ** 2))
    folds = noise(points, (0.10, 0.034, 0.10), order=3) * (0.0015 + 0.004 * gather)
    return 0.010 + 0.014 * fall**1.5 + folds


def _shirt_thickness(points: np.ndarray, depth: np.ndarray, anatomy: Anatomy, noise: Noise) -> np.ndarray:
    """Rests on the shoulders, hangs loose at waist and sleeves; long folds run downwards."""
    shoulder_y, hips_y = anatomy.joints_m["LeftArm"][1], anatomy.joints_m["Hips"][1]
    hang = np.clip((shoulder_y - points[:, 1]) / (shoulder_y - hips_y), 0.0, 1.0)
    folds = noise(points, (0.05, 0.16, 0.05), order=3) * (0.001 + 0.006 * hang)
    creases = noise(points + 3.0, (0.12, 0.045, 0.12), order=3) * 0.003 * hang
    hem = 0.004 * np.exp(-np.maximum(depth, 0.0) / 0.02)
    return 0.010 + 0.016 * hang + folds + creases + hem


def _hair_thickness(points: np.ndarray, depth: np.ndarray, anatomy: Anatomy, noise: Noise) -> np.ndarray:
    """Thin at the hairline, full on the crown, in locks."""
    fullness = np.clip(depth / 0.05, 0.0, 1.0) ** 0.7
    locks = noise(points, (0.016, 0.03, 0.03), order=3) * 0.004
    return 0.004 + fullness * (0.017 + locks)


_THICKNESS = {
    "shoes": _shoe_thickness,
    "trousers": _trouser_thickness,
    "shirt": _shirt_thickness,
    "hair": _hair_thickness,
}
