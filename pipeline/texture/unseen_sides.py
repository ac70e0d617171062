"""Colours of sides that no frame shows: what a slice of the same body part has where frames show it.

Hems go around a body, and hair around a head. Harmonic interpolation fills small holes, but it would make the back of a
person who was filmed from in front a mixture of shirt, trousers, skin and hair.
"""

from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Bool, Float, Int
from scipy.spatial import cKDTree

from pipeline.body.body import Body
from pipeline.texture.body_parts import BODY_PARTS, body_part_weights
from pipeline.texture.inpainting import OBSERVED, SMOOTHNESS_WEIGHT

SLICE_M = 0.015
"""Thickness of a slice; its colour is that of itself and of one slice on either side."""

MIN_SEEN = 5
"""Vertices that a slice must have that are seen."""

MAX_COMPARED = 300
"""Seen vertices of a slice among which its colour is chosen."""

MAX_GAP_SLICES = 3
"""A slice without colour has that of the nearest one, up to so many slices away."""

NEAR_M = 0.05
"""Distance from the unseen side at which a seen vertex has a quarter of its weight: flanks count more than a print on
the chest, temples more than the face."""

UNSEEN = 0.1
"""Weight up to which a vertex takes the colour of its slice."""

HOLE_M = 0.04
"""Vertices that are nearer to one that is seen belong to a hole, which is filled from its border."""

SLICE_WEIGHT = SMOOTHNESS_WEIGHT
"""Of a slice's colour against an observed one: as much as that of a neighbour in `inpaint_vertex_colours`."""

HAIRLINE_DEG = 40.0
"""Slope of the hairline from the forehead down to the nape; slices of the head are parallel to it."""

_AXES = {
    "torso": ("Hips", "Neck"),
    "left arm": ("LeftArm", "LeftHand"),
    "right arm": ("RightArm", "RightHand"),
    "left leg": ("LeftUpLeg", "LeftFoot"),
    "right leg": ("RightUpLeg", "RightFoot"),
}
"""Joints between which the axis of a part runs; that of the head is perpendicular to the hairline. Hands have none."""


@dataclass(frozen=True)
class BodySlices:
    """Part of the body (an index into `BODY_PARTS`) and slice along its axis of each vertex; -1: none, as for hands."""

    part: Int[np.ndarray, "v"]
    number: Int[np.ndarray, "v"]

    @classmethod
    def of_vertices(
        cls,
        vertices_m: Float[np.ndarray, "v 3"],
        joint_indices: Int[np.ndarray, "v k"],
        joint_weights: Float[np.ndarray, "v k"],
        body: Body,
    ) -> "BodySlices":
        """Return the slices of vertices in the A-pose, which are bound to joints of the body."""
        part = body_part_weights(joint_indices, joint_weights, body.joint_names).argmax(axis=1)
        number = np.full(len(part), -1)
        slope = np.deg2rad(HAIRLINE_DEG)
        axes = {"head": np.array([0.0, np.cos(slope), -np.sin(slope)])}
        for name, joints in _AXES.items():
            first, last = (body.joints_m[body.joint(joint)].astype(np.float64) for joint in joints)
            axes[name] = (last - first) / np.linalg.norm(last - first)
        for name, axis in axes.items():
            rows = np.flatnonzero(part == BODY_PARTS.index(name))
            if len(rows):
                along_m = vertices_m[rows] @ axis
                number[rows] = np.floor((along_m - along_m.min()) / SLICE_M)
        return cls(part, number)

    def without(self, vertices: Bool[np.ndarray, "v"]) -> "BodySlices":
        """Return the slices without some vertices, such as those inside of a skirt: its outside does not tell them."""
        return replace(self, number=np.where(vertices, -1, self.number))


def add_unseen_colours(
    vertices: Int[np.ndarray, "k"],
    of_vertices: Float[np.ndarray, "k 3"],
    colour: Float[np.ndarray, "v 3"],
    weight: Float[np.ndarray, "v"],
) -> tuple[Float[np.ndarray, "v 3"], Float[np.ndarray, "v"]]:
    """Return colours and weights in which some vertices have given colours, unless they are seen.

    weight: of the observations, in [0, 1].
    """
    colour, weight, unseen = colour.copy(), weight.copy(), weight[vertices] < UNSEEN
    colour[vertices[unseen]], weight[vertices[unseen]] = of_vertices[unseen], SLICE_WEIGHT
    return colour, weight


def add_slice_colours(
    vertices_m: Float[np.ndarray, "v 3"],
    slices: BodySlices,
    colour: Float[np.ndarray, "v 3"],
    weight: Float[np.ndarray, "v"],
) -> tuple[Float[np.ndarray, "v 3"], Float[np.ndarray, "v"]]:
    """Return colours and weights in which unseen vertices have the colour that their slice has where it is seen.

    Vertices in holes of less than twice `HOLE_M` are left as they are, and so are those whose slice is not seen nearby.

    weight: of the observations, in [0, 1].
    """
    colour, weight, seen = colour.copy(), weight.copy(), weight > OBSERVED
    if not seen.any():
        return colour, weight
    is_far = cKDTree(vertices_m[seen]).query(vertices_m)[0] > HOLE_M
    for part in range(len(BODY_PARTS)):
        rows = (slices.part == part) & (slices.number >= 0)
        unseen, known = np.flatnonzero(rows & is_far & (weight < UNSEEN)), np.flatnonzero(rows & seen)
        if not len(unseen) or not len(known):
            continue
        distance_m = cKDTree(vertices_m[unseen]).query(vertices_m[known])[0]
        of_slice, has_colour = _slice_colours(
            slices.number[known],
            colour[known],
            1.0 / (1.0 + (distance_m / NEAR_M) ** 2) ** 2,
            int(slices.number[rows].max()) + 1,
        )
        taken = unseen[has_colour[slices.number[unseen]]]
        colour[taken], weight[taken] = of_slice[slices.number[taken]], SLICE_WEIGHT
    return colour, weight


def _slice_colours(
    number: Int[np.ndarray, "n"], colour: Float[np.ndarray, "n 3"], weight: Float[np.ndarray, "n"], count: int
) -> tuple[Float[np.ndarray, "s 3"], Bool[np.ndarray, "s"]]:
    """Return the weighted medoid of the colours of each slice and its neighbours, and which slices have one."""
    found = np.zeros((count, 3))
    has_colour = np.zeros(count, dtype=bool)
    order = np.argsort(number, kind="stable")
    starts = np.searchsorted(number[order], np.arange(count + 3) - 1)
    for row in range(count):
        members = order[starts[row] : starts[row + 3]]
        if len(members) >= MIN_SEEN:
            found[row], has_colour[row] = _weighted_medoid(colour[members], weight[members]), True
    if has_colour.any():
        known = np.flatnonzero(has_colour)
        nearest = known[np.abs(np.arange(count)[:, None] - known).argmin(axis=1)]
        found, has_colour = found[nearest], np.abs(nearest - np.arange(count)) <= MAX_GAP_SLICES
    return found, has_colour


def _weighted_medoid(values: Float[np.ndarray, "n c"], weight: Float[np.ndarray, "n"]) -> Float[np.ndarray, "c"]:
    """Return the value whose weighted mean distance to the others is least: two colours have no mixture.

    Of many values the `MAX_COMPARED` heaviest are compared.
    """
    heaviest = np.argsort(-weight, kind="stable")[:MAX_COMPARED]
    values, weight = values[heaviest], weight[heaviest]
    distance = np.abs(values[:, None] - values).sum(axis=2)
    return values[(distance @ weight).argmin()]
