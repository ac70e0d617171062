"""Colours from the other side of the body: a template point has a mirrored one, and so has a point of the person."""

from functools import lru_cache

import numpy as np
from jaxtyping import Bool, Float, Int
from scipy.spatial import cKDTree

from pipeline.geometry.mesh import Mesh
from pipeline.geometry.surface import adjacency, closest_points_on_mesh
from pipeline.template.correspondence import Correspondence
from pipeline.template.regions import load_template
from pipeline.texture.inpainting import OBSERVED, SMOOTHNESS_WEIGHT

MAX_MIRROR_DISTANCE_M = 0.03
"""A vertex that lies farther from the mirrored place is not its partner."""

AGREEMENT = 0.08
"""Difference of colours (RMS of sRGB) of both sides at which the other side has a quarter of its weight."""

MIRROR_WEIGHT = SMOOTHNESS_WEIGHT
"""Of the other side's colour against an observed one: as much as that of a neighbour in `inpaint_vertex_colours`, so
that small holes are filled from their border."""

_SPREAD_STEPS = 60
_LEAST_EVIDENCE = 1e-6
"""Where nothing near is seen on both sides, such as a whole arm, the mean difference of the person counts."""


@lru_cache(maxsize=1)
def _mirrored_points() -> tuple[Int[np.ndarray, "v"], Float[np.ndarray, "v 3"]]:
    """Return for each vertex of the template the face and barycentric coordinates of its mirrored point."""
    template = load_template()
    vertices = template.vertices.astype(np.float64)
    skin = np.flatnonzero(template.skin_faces)
    _, row, barycentric = closest_points_on_mesh(vertices * [-1.0, 1.0, 1.0], Mesh(vertices, template.faces[skin]))
    return skin[row], barycentric


def mirror_vertices(
    points: Correspondence, template_m: Float[np.ndarray, "t 3"], mesh: Mesh
) -> tuple[Int[np.ndarray, "v"], Bool[np.ndarray, "v"]]:
    """Return the vertex on the other side of the body for each vertex, and whether there is one.

    Args:
        points: where the vertices of the mesh lie on the template.
        template_m: the registered template's vertices.
        mesh: the person's surface.
    """
    face, barycentric = _mirrored_points()
    mirrored_m = np.einsum("vk,vkc->vc", barycentric, template_m[load_template().faces[face]])
    distance_m, partner = cKDTree(mesh.vertices).query(points.interpolate(mirrored_m))
    return partner, np.asarray((distance_m < MAX_MIRROR_DISTANCE_M) & (partner != np.arange(len(partner))))


def add_mirrored_colours(
    mesh: Mesh,
    partner: tuple[Int[np.ndarray, "v"], Bool[np.ndarray, "v"]],
    colour: Float[np.ndarray, "v c"],
    weight: Float[np.ndarray, "v"],
) -> tuple[Float[np.ndarray, "v c"], Float[np.ndarray, "v"]]:
    """Return colours and weights in which unseen vertices have those of the other side, where both sides agree.

    The difference of both sides, where both are observed, is spread over the surface: around an unseen vertex it says
    whether the clothes are the same on both sides.

    partner: result of `mirror_vertices`. weight: of the observations, in [0, 1].
    """
    other, exists = partner
    both = exists & (weight > OBSERVED) & (weight[other] > OBSERVED)
    squared = np.where(both, np.mean((colour - colour[other]) ** 2, axis=1), 0.0)
    total, count = squared, both.astype(np.float64)
    neighbours = adjacency(mesh, np.ones(len(mesh.edges())))
    degree = np.maximum(neighbours.sum(axis=1), 1.0)
    for _ in range(_SPREAD_STEPS):
        total, count = (0.5 * (values + neighbours @ values / degree) for values in (total, count))
    everywhere = squared.sum() / max(both.sum(), 1)
    difference = np.sqrt((total + _LEAST_EVIDENCE * everywhere) / (count + _LEAST_EVIDENCE))
    trust = both.any() / (1.0 + (difference / AGREEMENT) ** 2) ** 2
    mirrored = MIRROR_WEIGHT * trust * weight[other]
    taken = exists & (weight[other] > OBSERVED) & (mirrored > weight)
    return (
        np.where(taken[:, None], colour[other], colour).astype(colour.dtype),
        np.where(taken, mirrored, weight).astype(weight.dtype),
    )
