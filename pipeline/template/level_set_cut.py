"""Cut a triangle mesh along the zero level set of a function, and join two such cuts along their common outline."""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float, Int

from pipeline.geometry.surface_cut import UnsplitNormals

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

    def keep_unsplit(self, before: UnsplitNormals, faces: Int[np.ndarray, "f 3"]) -> UnsplitNormals:
        """Return the normals of a joined mesh that begins with this part, where its triangles are as they were.

        Triangles that were split before and are whole in this part keep their normal. Other faces count as they are.

        Args:
            before: of the whole mesh.
            faces: of the joined mesh; its first vertices are those of this part.
        """
        count = int(max(self.edge.max(), before.rows.max(initial=-1), before.faces.max())) + 1
        kept = np.flatnonzero(self.edge[:, 0] == self.edge[:, 1])
        new_of = np.full(count, -1)
        new_of[self.edge[kept, 0]] = kept
        roots = np.tile(np.arange(count)[:, None], (1, 3))
        roots[before.rows] = before.corners
        is_lost = np.zeros(len(before.faces), dtype=bool)
        is_lost[new_of[before.faces].min(axis=1) < 0] = True
        lost = before.corners[new_of[before.rows] < 0]
        ends = np.sort(np.stack([before.faces, np.roll(before.faces, -1, axis=1)], axis=2), axis=2) @ [count, 1]
        is_lost |= np.isin(ends, np.sort(lost[:, :2], axis=1) @ [count, 1]).any(axis=1)
        whole = before.faces[~is_lost]
        old_of = np.full(int(faces.max()) + 1, -1)
        old_of[kept] = self.edge[kept, 0]
        old = old_of[faces]
        inside = (old >= 0).all(axis=1)
        parent = _three_of_nine(roots[old[inside]].reshape(-1, 9))
        is_child = np.zeros(len(faces), dtype=bool)
        key = [count * count, count, 1]
        is_child[inside] = np.isin(parent @ key, np.sort(whole, axis=1).astype(np.int64) @ key)
        rows = new_of[before.rows]
        stays = (rows >= 0) & (new_of[before.corners] >= 0).all(axis=1)
        return UnsplitNormals(
            np.concatenate([new_of[whole], faces[~is_child]]),
            rows[stays],
            new_of[before.corners[stays]],
            before.weights[stays],
        )


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


def points_on_edges(
    loop: Int[np.ndarray, "a"],
    loop_rad: Float[np.ndarray, "a"],
    points: Int[np.ndarray, "b"],
    points_rad: Float[np.ndarray, "b"],
    ties_after: bool,
) -> dict[tuple[int, int], list[tuple[int, float]]]:
    """Return which points lie on which edge of a loop around the same centre, in the order of the loop.

    Args:
        loop: vertices, counter-clockwise.
        loop_rad: angle of each vertex around the centre, in (-pi, pi].
        points: vertices of another loop.
        points_rad: their angles.
        ties_after: whether a point at the angle of a vertex comes after it; one of two loops comes first.

    Returns:
        For an edge (from, to) of the loop: points and their fractions of the angle of the edge.
    """
    first = int(np.argmin(loop_rad))
    loop, turn = np.roll(loop, -first), 2.0 * np.pi
    start = np.maximum.accumulate(np.roll(loop_rad, -first))
    end = np.append(start[1:], start[0] + turn)
    is_before = points_rad < start[0] if ties_after else points_rad <= start[0]
    at = np.where(is_before, points_rad + turn, points_rad)
    edge = np.clip(np.searchsorted(start, at, side="right" if ties_after else "left") - 1, 0, len(loop) - 1)
    fraction = (at - start[edge]) / np.maximum(end[edge] - start[edge], 1e-12)
    found: dict[tuple[int, int], list[tuple[int, float]]] = {}
    for row in np.argsort(at, kind="stable"):
        ends = int(loop[edge[row]]), int(loop[(edge[row] + 1) % len(loop)])
        found.setdefault(ends, []).append((int(points[row]), float(fraction[row])))
    return found


def split_boundary_faces(
    faces: Int[np.ndarray, "f 3"],
    faces_uv: Int[np.ndarray, "f 3"],
    uv: Float[np.ndarray, "t 2"],
    points: dict[tuple[int, int], list[tuple[int, float]]],
) -> tuple[Int[np.ndarray, "g 3"], Int[np.ndarray, "g 3"], Float[np.ndarray, "w 2"]]:
    """Split faces at points on their boundary edges into fans; return faces, their corners in `uv`, and more of `uv`.

    points: for each half edge (from, to) of the faces, vertices on it and their fractions, from first to last.
    """
    fans: list[tuple[int, int, int]] = []
    fans_uv: list[tuple[int, int, int]] = []
    more_uv: list[np.ndarray] = []
    kept = np.ones(len(faces), dtype=bool)
    on_boundary = np.isin(faces, [vertex for edge in points for vertex in edge]).sum(axis=1) >= 2
    for row in np.flatnonzero(on_boundary):
        for corner in range(3):
            a, b, c = ((corner + k) % 3 for k in range(3))
            inserted = points.get((int(faces[row, a]), int(faces[row, b])))
            if not inserted or not kept[row]:
                continue
            kept[row] = False
            first_uv, last_uv = uv[faces_uv[row, a]], uv[faces_uv[row, b]]
            indices = len(uv) + len(more_uv) + np.arange(len(inserted))
            more_uv += [first_uv + fraction * (last_uv - first_uv) for _, fraction in inserted]
            chain = [int(faces[row, a]), *(vertex for vertex, _ in inserted), int(faces[row, b])]
            chain_uv = [int(faces_uv[row, a]), *indices.tolist(), int(faces_uv[row, b])]
            apex, apex_uv = int(faces[row, c]), int(faces_uv[row, c])
            fans += [(u, v, apex) for u, v in zip(chain[:-1], chain[1:], strict=True)]
            fans_uv += [(u, v, apex_uv) for u, v in zip(chain_uv[:-1], chain_uv[1:], strict=True)]
    return (
        np.concatenate([faces[kept], np.array(fans, dtype=faces.dtype).reshape(-1, 3)]),
        np.concatenate([faces_uv[kept], np.array(fans_uv, dtype=faces_uv.dtype).reshape(-1, 3)]),
        np.concatenate([uv, np.array(more_uv).reshape(-1, 2)]),
    )


def _three_of_nine(corners: Int[np.ndarray, "f 9"]) -> Int[np.ndarray, "f 3"]:
    """Return the three different numbers of each row, sorted."""
    ordered = np.sort(corners, axis=1).astype(np.int64)
    middle = np.argmax(ordered != ordered[:, :1], axis=1)
    return np.stack([ordered[:, 0], ordered[np.arange(len(ordered)), middle], ordered[:, 8]], axis=1)


def _rotate(faces: np.ndarray, inside: np.ndarray, value: bool) -> np.ndarray:
    """Return faces with the corner first whose state is `value`."""
    first = np.argmax(inside == value, axis=1)
    return np.take_along_axis(faces, (first[:, None] + np.arange(3)) % 3, axis=1)
