"""Colours of sides that no frame shows: what a slice of the same body part has where frames show it.

Hems go around a body, and hair around a head. Harmonic interpolation fills small holes, but it would make the back of a
person who was filmed from in front a mixture of shirt, trousers, skin and hair.
"""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float, Int
from scipy.spatial import cKDTree

from pipeline.body.body import Body
from pipeline.geometry.atlas import Texels
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

SLICE_WEIGHT = 10.0 * SMOOTHNESS_WEIGHT
"""Of a slice's colour against an observed one: it outweighs the neighbours in `inpaint_vertex_colours`, for a hem
between vertices is no mixture of both sides."""

SMOOTHED_SLICES, SMOOTHED_DIFFERENCE, SMOOTHINGS = 3.0, 0.18, 5
"""Standard deviations, in slices and in summed differences of two colours, of a bilateral filter, and how often it is
applied. Light and folds differ by up to 0.35 from slice to slice, shirts from trousers by 0.5 and more."""

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
    """Where vertices are along the axes of body parts.

    part: index into `BODY_PARTS`; larger by their number below a hem. along_m: distance along its axis from its lowest
    vertex; nan: none, as for hands.
    """

    part: Int[np.ndarray, "v"]
    along_m: Float[np.ndarray, "v"]

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
        along_m = np.full(len(part), np.nan)
        slope = np.deg2rad(HAIRLINE_DEG)
        axes = {"head": np.array([0.0, np.cos(slope), -np.sin(slope)])}
        for name, joints in _AXES.items():
            first, last = (body.joints_m[body.joint(joint)].astype(np.float64) for joint in joints)
            axes[name] = (last - first) / np.linalg.norm(last - first)
        for name, axis in axes.items():
            rows = np.flatnonzero(part == BODY_PARTS.index(name))
            if len(rows):
                along_m[rows] = vertices_m[rows] @ axis
                along_m[rows] -= along_m[rows].min()
        return cls(part, along_m)

    def of_hollow_skirt(
        self, heights_m: Float[np.ndarray, "v"], is_inside: Bool[np.ndarray, "v"], hem_m: float
    ) -> "BodySlices":
        """Return the slices of a person in a hollow skirt: its outside does not tell its inside, nor legs its cloth.

        hem_m: height below which the outside is that of the legs.
        """
        part = self.part + len(BODY_PARTS) * (heights_m < hem_m)
        return BodySlices(part, np.where(is_inside, np.nan, self.along_m))


@dataclass(frozen=True)
class SliceColours:
    """Colours of vertices that no frame shows, and of the surface between them.

    Attributes:
        vertices: those that have the colour of their slice.
        colour: of each of them.
        slices: of all vertices.
        of_part: colours of the slices of each part that has some, from the lowest one on.
    """

    vertices: Int[np.ndarray, "k"]
    colour: Float[np.ndarray, "k 3"]
    slices: BodySlices
    of_part: dict[int, Float[np.ndarray, "s 3"]]

    def between_vertices(
        self, faces: Int[np.ndarray, "f 3"], texels: Texels, taken: Bool[np.ndarray, "v"]
    ) -> Float[np.ndarray, "t 3"]:
        """Return the difference of the texels' slices from what the vertices of their faces interpolate.

        It is 0 in faces whose vertices are not all taken, and of one part.

        taken: vertices that have the colour of their slice.
        """
        part = self.slices.part[faces]
        is_slice = taken[faces].all(axis=1) & (part == part[:, :1]).all(axis=1)
        rows = np.flatnonzero(is_slice[texels.face])
        chosen = texels.select(is_slice[texels.face])
        along_m = chosen.interpolate(faces, np.nan_to_num(self.slices.along_m)[:, None])[:, 0]
        corner = np.zeros((len(taken), 3))
        corner[self.vertices] = self.colour
        difference = np.zeros((len(texels.face), 3), dtype=np.float32)
        difference[rows] = _at(self.of_part, part[chosen.face, 0], along_m) - chosen.interpolate(faces, corner)
        return difference


def _at(
    of_part: dict[int, Float[np.ndarray, "s 3"]], part: Int[np.ndarray, "n"], along_m: Float[np.ndarray, "n"]
) -> Float[np.ndarray, "n 3"]:
    """Return the colours at places along the axes of parts, linear between the middles of slices."""
    found = np.zeros((len(part), 3))
    for number, colours in of_part.items():
        rows = np.flatnonzero(part == number)
        middles_m = SLICE_M * (np.arange(len(colours)) + 0.5)
        found[rows] = np.stack([np.interp(along_m[rows], middles_m, channel) for channel in colours.T], axis=1)
    return found


def find_slice_colours(
    vertices_m: Float[np.ndarray, "v 3"],
    slices: BodySlices,
    colour: Float[np.ndarray, "v 3"],
    weight: Float[np.ndarray, "v"],
) -> SliceColours:
    """Find the colours that the slices of unseen vertices have where they are seen.

    Vertices in holes of less than twice `HOLE_M` have none, nor have those whose slice is not seen nearby.

    weight: of the observations, in [0, 1].
    """
    found: list[Int[np.ndarray, "k"]] = [np.zeros(0, dtype=np.int64)]
    of_part, seen = {}, weight > OBSERVED
    has_slice = np.isfinite(slices.along_m)
    is_far = cKDTree(vertices_m[seen]).query(vertices_m)[0] > HOLE_M if seen.any() else ~has_slice
    for part in np.unique(slices.part[has_slice]).tolist():
        rows = (slices.part == part) & has_slice
        unseen, known = np.flatnonzero(rows & is_far & (weight < UNSEEN)), np.flatnonzero(rows & seen)
        if not len(unseen) or not len(known):
            continue
        number = np.floor(np.where(rows, slices.along_m, 0.0) / SLICE_M).astype(int)
        distance_m = cKDTree(vertices_m[unseen]).query(vertices_m[known])[0]
        of_slice, has_colour = _slice_colours(
            number[known], colour[known], 1.0 / (1.0 + (distance_m / NEAR_M) ** 2) ** 2, int(number.max()) + 1
        )
        if has_colour.any():
            of_part[part] = _smooth_slices(of_slice)
            found.append(unseen[has_colour[number[unseen]]])
    vertices = np.concatenate(found)
    return SliceColours(vertices, _at(of_part, slices.part[vertices], slices.along_m[vertices]), slices, of_part)


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


def _smooth_slices(colours: Float[np.ndarray, "s 3"]) -> Float[np.ndarray, "s 3"]:
    """Return the colours without those of single slices, smooth but for borders.

    The filter: Tomasi and Manduchi, "Bilateral filtering for gray and color images", 1998.
    """
    number, even = np.arange(len(colours)), np.ones(3)
    padded = np.pad(colours, ((1, 1), (0, 0)), mode="edge")
    colours = np.stack([_weighted_medoid(padded[row : row + 3], even) for row in number])
    near = np.exp(-0.5 * ((number[:, None] - number) / SMOOTHED_SLICES) ** 2)
    for _ in range(SMOOTHINGS):
        difference = np.abs(colours[:, None] - colours).sum(axis=2)
        weight = near * np.exp(-0.5 * (difference / SMOOTHED_DIFFERENCE) ** 2)
        colours = weight @ colours / weight.sum(axis=1, keepdims=True)
    return np.asarray(colours)


def _weighted_medoid(values: Float[np.ndarray, "n c"], weight: Float[np.ndarray, "n"]) -> Float[np.ndarray, "c"]:
    """Return the value whose weighted mean distance to the others is least: two colours have no mixture.

    Of many values the `MAX_COMPARED` heaviest are compared.
    """
    heaviest = np.argsort(-weight, kind="stable")[:MAX_COMPARED]
    values, weight = values[heaviest], weight[heaviest]
    distance = np.abs(values[:, None] - values).sum(axis=2)
    return values[(distance @ weight).argmin()]
