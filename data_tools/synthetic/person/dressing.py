"""Model clothes as offset surfaces of the body.

The surface of the body is subdivided, smoothed where cloth does not follow it (navel, shoulder blades), displaced along
its normals by thickness and folds of each layer, and keeps the skin weights of the body. This is done twice: in the
second pass, cuts are measured on the smooth surface of the first pass, so that hems and prints are straight. A skirt is
a second closed surface around the legs, and so is each kind of `data_tools.synthetic.person.attachment`.
"""

from dataclasses import dataclass, replace

import numpy as np
import scipy.sparse as sparse
from jaxtyping import Float, Int, Shaped
from scipy.spatial import ConvexHull

from data_tools.synthetic.person.anatomy import ATTACHMENT, SKIN, SKIRT, Anatomy, compute_arm_head_weights, label_faces
from data_tools.synthetic.person.attachment import ATLAS_HEIGHT_FRACTION as ATTACHMENT_FRACTION
from data_tools.synthetic.person.attachment import HAIRSTYLES, build_attachment
from data_tools.synthetic.person.noise import ValueNoise
from data_tools.synthetic.person.outfit import (
    LAYERS,
    Outfit,
    compute_layer_depths_m,
    jacket_offset_m,
    sleeve_flare_offset_m,
    trouser_flare_offset_m,
)
from data_tools.synthetic.person.skirt import ATLAS_HEIGHT_FRACTION as SKIRT_FRACTION
from data_tools.synthetic.person.skirt import build_skirt
from data_tools.synthetic.person.surface import (
    WornSurface,
    append_midpoint_values,
    hull_exit_distance_m,
    neighbour_averaging_matrix,
    smooth_laplacian,
    subdivide_at_midpoints,
)
from data_tools.synthetic.rig.labels import body_part_names
from pipeline.body.body import AnnyBody, Body
from pipeline.geometry.mesh import Mesh

HEM_TRANSITION_M = 0.006
"""Width of the transition of a layer from 0 to its thickness."""

TOE_BOX_HEIGHT_M = 0.075
"""Below this height a shoe is the convex hull of the foot, which hides the toes."""

SHOE_THICKNESS_M = 0.008
"""Thickness of the shoes' upper."""

TOES_TO_AXIS_M = 0.03
"""From the joint of the toes back to the end of the axis of a foot."""

HEEL_CORNERS_M = np.array([[x, 0.0, z] for x in (-0.02, 0.02) for z in (0.01, 0.04)])
"""Of a raised heel on the floor, from its back."""

_HULL_ITERATIONS = 10
_SMOOTHING_ITERATIONS = {"shoes": 2, "trousers": 24, "shirt": 40, "hair": 6}


@dataclass(frozen=True)
class ClothedSurface:
    """The clothed surface with the per-vertex and per-face data that texturing needs.

    Attributes:
        drape_m: vertex positions on which the cuts of `compute_layer_depths_m` were measured.
        arm_head_weights: skin weights on the arms and on the head.
        labels: SKIN, EYE, TONGUE, SKIRT or ATTACHMENT of each face.
    """

    body: Body
    uv: Float[np.ndarray, "t 2"]
    faces_uv: Int[np.ndarray, "f 3"]
    drape_m: Float[np.ndarray, "v 3"]
    arm_head_weights: Float[np.ndarray, "v 2"]
    labels: Int[np.ndarray, "f"]


def add_clothing(model: AnnyBody, body: Body, anatomy: Anatomy, outfit: Outfit, noise: ValueNoise) -> ClothedSurface:
    """Subdivide a body once and add the outfit."""
    pairs, faces = subdivide_at_midpoints(body.faces, len(body.vertices))
    uv_pairs, faces_uv = subdivide_at_midpoints(model.faces_uv, len(model.uv))
    bare = append_midpoint_values(body.vertices, pairs)
    arm_head_weights = append_midpoint_values(compute_arm_head_weights(body), pairs)
    labels = np.repeat(label_faces(body), 4)
    skin_vertices = np.zeros(len(bare), dtype=bool)
    skin_vertices[faces[labels == SKIN]] = True
    mean = neighbour_averaging_matrix(faces, len(bare))
    base_surface = _add_toe_boxes(bare, mean, skin_vertices, anatomy, outfit.heel_m)
    vertices = drape = base_surface
    for _ in range(2):
        drape = vertices
        depths = np.where(
            skin_vertices[:, None], compute_layer_depths_m(drape, arm_head_weights, anatomy, outfit), -1.0
        )
        additional_m = {
            "shirt": sleeve_flare_offset_m(drape, arm_head_weights, anatomy, outfit)
            + jacket_offset_m(drape, depths[:, LAYERS.index("shirt")], outfit),
            "trousers": trouser_flare_offset_m(drape, anatomy, outfit),
        }
        vertices = _add_layers(base_surface, faces, mean, depths, additional_m, anatomy, noise)
    clothed_body = replace(
        body, vertices=vertices, faces=faces, skin_weights=append_midpoint_values(body.skin_weights, pairs)
    )
    clothed = ClothedSurface(
        clothed_body, append_midpoint_values(model.uv, uv_pairs), faces_uv, drape, arm_head_weights, labels
    )
    added: list[tuple[WornSurface, int, float]] = []
    if outfit.legwear == "skirt":
        skirt = build_skirt(clothed_body, arm_head_weights[:, 0], anatomy, noise, outfit)
        added.append((skirt, SKIRT, SKIRT_FRACTION))
    if outfit.attachment is not None:
        attachment = build_attachment(outfit.attachment, clothed_body, anatomy, noise)
        added.append((attachment, ATTACHMENT, ATTACHMENT_FRACTION))
    for mesh, label, atlas_fraction in added:
        clothed = _add_surface(clothed, mesh, label, atlas_fraction)
    return clothed


def surface_names(person: ClothedSurface, anatomy: Anatomy, outfit: Outfit) -> Shaped[np.ndarray, "f"]:
    """Return for each face the garment that covers it (`LAYERS`, skirt), or the body part whose skin it is."""
    names = body_part_names(person.body)
    depths_m = compute_layer_depths_m(person.drape_m, person.arm_head_weights, anatomy, outfit)[person.body.faces]
    for column, layer in enumerate(LAYERS):
        names[(depths_m[:, :, column].mean(axis=1) > 0.0) & (person.labels == SKIN)] = layer
    names[person.labels == SKIRT] = "skirt"
    names[person.labels == ATTACHMENT] = "hair" if outfit.attachment in HAIRSTYLES else outfit.attachment
    return names


def _add_surface(person: ClothedSurface, mesh: WornSurface, label: int, atlas_fraction: float) -> ClothedSurface:
    """Add a separate surface; the UV charts of others are scaled down to free the top of the atlas."""
    worn, start, start_uv = person.body, len(person.body.vertices), len(person.uv)
    body = replace(
        worn,
        vertices=np.concatenate([worn.vertices, mesh.vertices]),
        faces=np.concatenate([worn.faces, mesh.faces + start]),
        skin_weights=np.concatenate([worn.skin_weights, mesh.skin_weights]),
    )
    return ClothedSurface(
        body=body,
        uv=np.concatenate([person.uv * np.array([1.0, 1.0 - atlas_fraction], np.float32), mesh.uv]),
        faces_uv=np.concatenate([person.faces_uv, mesh.faces_uv + start_uv]),
        drape_m=np.concatenate([person.drape_m, mesh.vertices]),
        arm_head_weights=np.concatenate([person.arm_head_weights, np.zeros((len(mesh.vertices), 2), np.float32)]),
        labels=np.concatenate([person.labels, np.full(len(mesh.faces), label, person.labels.dtype)]),
    )


def _add_layers(
    skin_m: Float[np.ndarray, "v 3"],
    faces: Int[np.ndarray, "f 3"],
    mean: sparse.csr_matrix,
    depths_m: Float[np.ndarray, "v 4"],
    additional_m: dict[str, Float[np.ndarray, "v"]],
    anatomy: Anatomy,
    noise: ValueNoise,
) -> Float[np.ndarray, "v 3"]:
    """Displace the surface by all layers in order. additional_m: additional thickness of layers."""
    vertices = skin_m
    for column, layer in enumerate(LAYERS):
        smooth = smooth_laplacian(vertices, mean, _SMOOTHING_ITERATIONS[layer])
        normals = Mesh(smooth, faces).vertex_normals()
        thickness = _THICKNESS[layer](skin_m, depths_m[:, column], anatomy, noise)
        if layer in additional_m:
            thickness = thickness + additional_m[layer]
        layer_weight = np.clip(depths_m[:, column] / HEM_TRANSITION_M + 0.5, 0.0, 1.0)[:, None]
        vertices = vertices + layer_weight * (smooth + thickness[:, None] * normals - vertices)
        if layer == "shoes":
            vertices = _flatten_soles(vertices, layer_weight[:, 0])
    return vertices.astype(np.float32)


def _add_toe_boxes(
    bare_m: Float[np.ndarray, "v 3"],
    mean: sparse.csr_matrix,
    skin_vertices: np.ndarray,
    anatomy: Anatomy,
    heel_m: float,
) -> Float[np.ndarray, "v 3"]:
    """Project the lower part of each foot onto its convex hull, which closes the gaps between the toes.

    Alternating smoothing and projection distributes the sides of the toes over the hull instead of folding them. The
    hull of a foot with a raised heel goes down to the floor below the heel.
    """
    vertices = bare_m
    for side in ("Left", "Right"):
        ankle, toes = anatomy.joints_m[f"{side}Foot"], anatomy.joints_m[f"{side}ToeBase"]
        near = skin_vertices & (np.abs(bare_m[:, 0] - ankle[0]) < 0.15)
        heel_z = bare_m[near & (bare_m[:, 1] < ankle[1]), 2].min()
        rise_m = heel_m * np.clip((toes[2] - bare_m[:, 2]) / (toes[2] - heel_z), 0.0, 1.0)
        on_foot = near & (bare_m[:, 1] < TOE_BOX_HEIGHT_M + rise_m)
        hull_points = bare_m[on_foot]
        if heel_m:
            hull_points = np.concatenate([hull_points, [ankle[0], 0.0, heel_z] + HEEL_CORNERS_M])
        hull, axis = ConvexHull(hull_points).equations, _foot_axis(ankle, toes, heel_m)
        for _ in range(_HULL_ITERATIONS):
            vertices = np.where(on_foot[:, None], smooth_laplacian(vertices, mean, 4), vertices)
            vertices[on_foot] = _project_onto_hull(vertices[on_foot], hull, axis)
    return vertices


def _foot_axis(ankle: Float[np.ndarray, "3"], toes: Float[np.ndarray, "3"], heel_m: float) -> Float[np.ndarray, "2 3"]:
    """Return the ends of a segment inside the foot, above the arch: below the ankle, and before the toes."""
    below_ankle = [ankle[0], heel_m + 0.5 * (ankle[1] - heel_m), ankle[2]]
    return np.array([below_ankle, toes - [0.0, 0.0, TOES_TO_AXIS_M]])


def _project_onto_hull(
    points: Float[np.ndarray, "n 3"], hull: Float[np.ndarray, "h 4"], axis: Float[np.ndarray, "2 3"]
) -> Float[np.ndarray, "n 3"]:
    """Intersect rays from the axis of the foot through the points with the hull, offset by `SHOE_THICKNESS_M`."""
    start, step = axis[0], axis[1] - axis[0]
    along = np.clip((points[:, 2] - start[2]) / step[2], 0.0, 1.0)
    origin = start + along[:, None] * step
    outwards = points - origin
    outwards /= np.maximum(np.linalg.norm(outwards, axis=1, keepdims=True), 1e-9)
    return (origin + hull_exit_distance_m(origin, outwards, hull, SHOE_THICKNESS_M)[:, None] * outwards).astype(
        points.dtype
    )


def _flatten_soles(
    vertices: Float[np.ndarray, "v 3"], layer_weight: Float[np.ndarray, "v"]
) -> Float[np.ndarray, "v 3"]:
    """Flatten the lowest 12 mm of the shoes into one plane."""
    sole_y = vertices[layer_weight > 0.5, 1].min() + 0.012
    flat = vertices.copy()
    flat[:, 1] = np.where((layer_weight > 0.5) & (flat[:, 1] < sole_y), sole_y - 0.012, flat[:, 1])
    return flat


def _shoe_thickness(points: np.ndarray, depth: np.ndarray, anatomy: Anatomy, noise: ValueNoise) -> np.ndarray:
    """Return 0 below the toe box, which already has the thickness, and `SHOE_THICKNESS_M` above."""
    return np.where(points[:, 1] < TOE_BOX_HEIGHT_M, 0.0, SHOE_THICKNESS_M)


def _trouser_thickness(points: np.ndarray, depth: np.ndarray, anatomy: Anatomy, noise: ValueNoise) -> np.ndarray:
    """Return a thickness that grows from hip to hem, with folds at the knee and above the shoe."""
    knee_y, foot_y = anatomy.joints_m["LeftLeg"][1], anatomy.joints_m["LeftFoot"][1]
    hip_to_ankle = np.clip((anatomy.joints_m["Hips"][1] - points[:, 1]) / (anatomy.joints_m["Hips"][1] - foot_y), 0, 1)
    gather = np.exp(-(((points[:, 1] - knee_y) / 0.07) ** 2)) + np.exp(-(((points[:, 1] - foot_y) / 0.10) ** 2))
    folds = noise(points, (0.10, 0.034, 0.10), order=3) * (0.0015 + 0.004 * gather)
    return 0.010 + 0.014 * hip_to_ankle**1.5 + folds


def _shirt_thickness(points: np.ndarray, depth: np.ndarray, anatomy: Anatomy, noise: ValueNoise) -> np.ndarray:
    """Return a thickness that grows from the shoulders to the waist, with long vertical folds."""
    shoulder_y, hips_y = anatomy.joints_m["LeftArm"][1], anatomy.joints_m["Hips"][1]
    looseness = np.clip((shoulder_y - points[:, 1]) / (shoulder_y - hips_y), 0.0, 1.0)
    folds = noise(points, (0.05, 0.16, 0.05), order=3) * (0.001 + 0.006 * looseness)
    creases = noise(points + 3.0, (0.12, 0.045, 0.12), order=3) * 0.003 * looseness
    hem = 0.004 * np.exp(-np.maximum(depth, 0.0) / 0.02)
    return 0.010 + 0.016 * looseness + folds + creases + hem


def _hair_thickness(points: np.ndarray, depth: np.ndarray, anatomy: Anatomy, noise: ValueNoise) -> np.ndarray:
    """Return a thickness that grows from the hairline to the crown, modulated by locks of hair."""
    fullness = np.clip(depth / 0.05, 0.0, 1.0) ** 0.7
    locks = noise(points, (0.016, 0.03, 0.03), order=3) * 0.004
    return 0.004 + fullness * (0.017 + locks)


_THICKNESS = {
    "shoes": _shoe_thickness,
    "trousers": _trouser_thickness,
    "shirt": _shirt_thickness,
    "hair": _hair_thickness,
}
