"""Cut a triangle mesh along the zero level set of a function, and close the gap between two such cuts."""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float, Int

_MIN_CUT_FRACTION = 0.02
"""A cut runs at least this fraction of an edge away from its ends, so that no faces without area arise."""


@dataclass(frozen=True)
class CutMesh:
    """The part of a mesh where a function is negative. New vertices lie on edges.

    Attributes:
        faces: indices into the vertices of this part.
        edge: ends (indices of the whole mesh) of the edge on which each vertex lies; twice the same for old vertices.
        fraction: position on that edge, 0 at its first end.
        boundary: half edges of faces on the cut, as (from, to).
    """

    faces: Int[np.ndarray, "g 3"]
    edge: Int[np.ndarray, "w 2"]
    fraction: Float[np.ndarray, "w"]
    boundary: Int[np.ndarray, "b 2"]

    def interpolate(self, values: Float[np.ndarray, "v c"]) -> Float[np.ndarray, "w c"]:
        """Return the values at the vertices of the part, interpolated on cut edges."""
        first, second = values[self.edge[:, 0]], values[self.edge[:, 1]]
        return np.asarray(first + self.fraction[:, None] * (second - first))


def cut_mesh(faces: Int[np.ndarray, "f 3"], level: Float[np.ndarray, "v"]) -> CutMesh:
    """Return the part of a mesh with `level` < 0; triangles that the zero level crosses are split.

    A mesh with corners in two index spaces (positions and texture coordinates) is cut the same way in both, if the
    level of corners at the same position is the same.
    """
    negative = level < 0.0
    inside = negative[faces]
    count = inside.sum(axis=1)
    whole = faces[count == 3]
    one, two = (
        _rotate(faces[count == 1], inside[count == 1], True),
        _rotate(faces[count == 2], inside[count == 2], False),
    )
    # One corner a inside: a, ab, ca. Two corners b, c inside: ab, b, c and ab, c, ca.
    crossing = np.concatenate([one[:, [0, 1]], one[:, [0, 2]], two[:, [1, 0]], two[:, [2, 0]]])
    pairs, edge_of = np.unique(np.sort(crossing, axis=1), axis=0, return_inverse=True)
    first = len(level)
    ab1, ca1, ab2, ca2 = np.split(edge_of.ravel() + first, np.cumsum([len(one), len(one), len(two)]))
    parts = [
        whole,
        np.stack([one[:, 0], ab1, ca1], axis=1),
        np.stack([ab2, two[:, 1], two[:, 2]], axis=1),
        np.stack([ab2, two[:, 2], ca2], axis=1),
    ]
    cut = np.concatenate(parts)
    low, high = level[pairs[:, 0]], level[pairs[:, 1]]
    fraction = np.clip(low / np.where(low == high, 1.0, low - high), _MIN_CUT_FRACTION, 1.0 - _MIN_CUT_FRACTION)
    own = np.arange(first)
    edge, position = np.concatenate([np.stack([own, own], axis=1), pairs]), np.concatenate([np.zeros(first), fraction])
    used, compact = np.unique(cut, return_inverse=True)
    renumbered = np.searchsorted(used, np.concatenate([np.stack([ab1, ca1], 1), np.stack([ca2, ab2], 1)]))
    return CutMesh(compact.reshape(-1, 3), edge[used], position[used], renumbered)


def boundary_loops(half_edges: Int[np.ndarray, "b 2"]) -> list[Int[np.ndarray, "_"]]:
    """Return the closed loops of half edges, each as its vertices in order, the longest first.

    Raises:
        ValueError: half edges do not form simple closed loops.
    """
    following = {int(start): int(end) for start, end in half_edges}
    if len(following) != len(half_edges) or set(following) != set(following.values()):
        raise ValueError("the boundary of the cut is not a set of simple loops")
    loops = []
    while following:
        start, vertex = next(iter(following.items()))
        loop = [start]
        del following[start]
        while vertex != start:
            loop.append(vertex)
            vertex = following.pop(vertex)
        loops.append(np.array(loop))
    return sorted(loops, key=len, reverse=True)


def zip_loops(
    outer: Int[np.ndarray, "a"],
    outer_angle_rad: Float[np.ndarray, "a"],
    inner: Int[np.ndarray, "b"],
    inner_angle_rad: Float[np.ndarray, "b"],
) -> Int[np.ndarray, "n 3"]:
    """Return triangles between two loops around the same centre, counter-clockwise where the loops are.

    Args:
        outer, inner: vertices in counter-clockwise order.
        outer_angle_rad, inner_angle_rad: angle of each vertex around the centre.
    """
    outer, outer_angle = _start_at_smallest(outer, outer_angle_rad)
    inner, inner_angle = _start_at_smallest(inner, inner_angle_rad)
    turn = 2.0 * np.pi
    outer_angle = np.append(np.maximum.accumulate(outer_angle), outer_angle[0] + turn)
    inner_angle = np.append(np.maximum.accumulate(inner_angle), inner_angle[0] + turn)
    triangles, i, k = [], 0, 0
    while i < len(outer) or k < len(inner):
        a, b = outer[i % len(outer)], inner[k % len(inner)]
        if k == len(inner) or (i < len(outer) and outer_angle[i + 1] <= inner_angle[k + 1]):
            triangles.append((a, outer[(i + 1) % len(outer)], b))
            i += 1
        else:
            triangles.append((a, inner[(k + 1) % len(inner)], b))
            k += 1
    return np.array(triangles)


def _start_at_smallest(loop: np.ndarray, angle_rad: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    first = int(np.argmin(angle_rad))
    return np.roll(loop, -first), np.roll(angle_rad, -first)


def _rotate(faces: np.ndarray, inside: np.ndarray, value: bool) -> np.ndarray:
    """Return faces with the corner first whose state is `value`."""
    first = np.argmax(inside == value, axis=1)
    return np.take_along_axis(faces, (first[:, None] + np.arange(3)) % 3, axis=1)
