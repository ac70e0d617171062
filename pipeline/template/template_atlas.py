"""The atlas of a person on the template's layout: a place on the body has the same texture coordinates on every person.

The person's triangles are split where the nearest chart of the registered template changes. A corner has the texture
coordinates of the nearest point of its chart. Where this map folds over (in folds of cloth, at ears and between
fingers), its vertices move to the mean of their neighbours. What still folds, overlaps, or is squeezed, such as skirts
and long hair, gets charts of its own in the square that the layout reserves for them. So does the inside of a skirt,
which no frame shows, with fewer texels.
"""

from dataclasses import dataclass

import igl
import numpy as np
import torch
from jaxtyping import Bool, Float, Int
from scipy import sparse
from scipy.sparse.linalg import spsolve

from pipeline.geometry.atlas import Atlas, unwrap
from pipeline.geometry.mesh import Mesh
from pipeline.geometry.surface import closest_points_on_mesh
from pipeline.geometry.surface_cut import SurfaceCut, cut_at_borders
from pipeline.kernels.raster import rasterize
from pipeline.template.layout import load_layout
from pipeline.template.regions import load_template
from pipeline.template.registration import Registration

MIN_STRETCH = 0.3
"""A triangle that is shrunk below this in any direction, against the median of its chart, gets a chart of its own."""

MIN_LOOSE_M2 = 1e-4
"""Smaller pieces stay where they are: a folded or squeezed sliver shows the texels of its border, and a chart of its
own would be smaller than a texel: it was seen as a black line."""

MIN_REGION_FACES = 12
"""A smaller piece among loose faces is loose as well: a chart of three faces is mostly gutter."""

MAX_HALVES_GAP = 0.005
"""Places of a vertex in both halves of a chart that are nearer (in sides of the texture; 1 cm) are one: there is no
cut."""

INSIDE_SCALE = 0.3
"""Size of the charts of the inside of a skirt, over that of other charts of their own."""

_LOOSE_RINGS = 1
_UNFOLDING_STEPS = 6
_RESERVED_MARGIN = 0.01


@dataclass(frozen=True)
class TemplateAtlas:
    """A person's atlas on the template's layout.

    Attributes:
        cut: of the person's mesh.
        atlas: of the mesh that was cut.
        loose_faces: faces of that mesh in charts of their own. The others are not folded and do not overlap, but for
            slivers.
        loose_share: their share of the area.
        folded_faces: faces that were turned over before vertices moved.
    """

    cut: SurfaceCut
    atlas: Atlas
    loose_faces: Bool[np.ndarray, "f"]
    loose_share: float
    folded_faces: int


def build_template_atlas(
    mesh: Mesh,
    registration: Registration,
    size_px: int,
    padding_px: int,
    is_inside: Bool[np.ndarray, "v"] | None = None,
) -> TemplateAtlas:
    """Lay a person's mesh out on the template's charts.

    Args:
        mesh: the person's surface in the A-pose.
        registration: of the template on it.
        size_px: side of the texture.
        padding_px: smallest distance between charts of loose parts, texels.
        is_inside: vertices inside of a skirt or coat; None without one.
    """
    layout, template = load_layout(), load_template()
    skin, region = registration.skin(), (2 * layout.chart + layout.half)[template.skin_faces]

    def region_at(points_m: Float[np.ndarray, "n 3"]) -> Int[np.ndarray, "n"]:
        return np.asarray(region[closest_points_on_mesh(points_m, skin)[1]])

    cut, region_of_face = cut_at_borders(mesh, region_at)
    surface, chart_of_face = cut.apply(mesh), region_of_face // 2
    uv, faces_uv, vertex_of_uv = _place(surface, region_of_face, registration)
    folded = int((_signed_areas(uv, faces_uv) <= 0.0).sum())
    uv = _unfold(uv, faces_uv)
    inside = np.zeros(len(surface.faces), dtype=bool)
    if is_inside is not None:
        inside = cut.extend_flags(is_inside)[surface.faces].all(axis=1)
    loose = inside | _loose_faces(surface, uv, faces_uv, chart_of_face, size_px, inside)
    areas_m2 = surface.face_areas_m2()
    share = float(areas_m2[loose].sum() / areas_m2.sum())
    atlas = _with_loose_charts(
        surface, Atlas(uv.astype(np.float32), faces_uv, vertex_of_uv), loose, inside, size_px, padding_px
    )
    return TemplateAtlas(cut, atlas, loose, share, folded)


def _place(
    surface: Mesh, region_of_face: Int[np.ndarray, "f"], registration: Registration
) -> tuple[Float[np.ndarray, "t 2"], Int[np.ndarray, "f 3"], Int[np.ndarray, "t"]]:
    """Return texture coordinates, corners and their vertices: each corner at the nearest point of its region.

    A vertex between the halves of a chart has one place in both, except on the cut.
    """
    layout, template = load_layout(), load_template()
    count = len(surface.vertices)
    used, corners = np.unique(region_of_face[:, None] * count + surface.faces, return_inverse=True)
    vertex, region = used % count, used // count
    uv, of_region = np.zeros((len(used), 2)), 2 * layout.chart + layout.half
    for number in np.unique(region):
        rows, faces = np.flatnonzero(region == number), np.flatnonzero(of_region == number)
        part = Mesh(registration.vertices, template.faces[faces])
        _, face, barycentric = closest_points_on_mesh(surface.vertices[vertex[rows]], part)
        uv[rows] = np.einsum("nk,nkc->nc", barycentric, layout.uv[layout.faces_uv[faces[face]]])
    second = np.flatnonzero(region % 2 == 1)
    at = np.minimum(np.searchsorted(used, used[second] - count), len(used) - 1)
    is_pair = used[at] == used[second] - count
    is_pair &= np.linalg.norm(uv[second] - uv[at], axis=1) < MAX_HALVES_GAP
    kept = np.arange(len(used))
    kept[second[is_pair]] = at[is_pair]
    uv[at[is_pair]] = 0.5 * (uv[at] + uv[second])[is_pair]
    remaining, compact = np.unique(kept[corners.ravel()], return_inverse=True)
    return uv[remaining], compact.reshape(-1, 3).astype(np.int32), vertex[remaining].astype(np.int32)


def _signed_areas(uv: np.ndarray, faces_uv: np.ndarray) -> Float[np.ndarray, "f"]:
    a, b, c = (uv[faces_uv[:, k]] for k in range(3))
    return np.asarray(0.5 * np.cross(b - a, c - a))


def _unfold(uv: Float[np.ndarray, "t 2"], faces_uv: Int[np.ndarray, "f 3"]) -> Float[np.ndarray, "t 2"]:
    """Move corners around folded faces to the mean of their neighbours, in growing neighbourhoods; borders stay."""
    count = len(uv)
    half_edges = np.stack([faces_uv, np.roll(faces_uv, -1, axis=1)], axis=2).reshape(-1, 2)
    one_way = sparse.coo_matrix((np.ones(len(half_edges)), half_edges.T), shape=(count, count)).tocsr()
    both = one_way + one_way.T
    on_border = np.asarray((both == 1).sum(axis=1)).ravel() > 0
    graph = sparse.csr_matrix((both > 0).astype(np.float64))
    operator = (sparse.diags(np.asarray(graph.sum(axis=1)).ravel()) - graph).tocsr()
    uv = uv.copy()
    for step in range(_UNFOLDING_STEPS):
        folded = _signed_areas(uv, faces_uv) <= 1e-10
        if not folded.any():
            break
        free = np.zeros(count, dtype=bool)
        free[faces_uv[folded]] = True
        for _ in range(step):
            free = np.asarray(graph @ free > 0)
        rows = np.flatnonzero(free & ~on_border)
        fixed = np.flatnonzero(~(free & ~on_border))
        if len(rows):
            uv[rows] = spsolve(operator[rows][:, rows].tocsc(), -(operator[rows][:, fixed] @ uv[fixed])).reshape(-1, 2)
    return uv


def _loose_faces(
    surface: Mesh,
    uv: Float[np.ndarray, "t 2"],
    faces_uv: Int[np.ndarray, "f 3"],
    chart_of_face: Int[np.ndarray, "f"],
    size_px: int,
    inside: Bool[np.ndarray, "f"],
) -> Bool[np.ndarray, "f"]:
    """Return the faces that are folded, squeezed, or lie on others, and small pieces between them.

    inside: faces that count as loose.
    """
    loose = inside | (_signed_areas(uv, faces_uv) <= 1e-10)
    smallest = _smallest_stretch(surface, uv, faces_uv)
    for number in np.unique(chart_of_face):
        rows = chart_of_face == number
        loose[rows] |= smallest[rows] < MIN_STRETCH * np.median(smallest[rows])
    loose |= _overlapping(uv, faces_uv, loose, size_px)
    loose &= _in_large_pieces(surface, loose)
    for _ in range(_LOOSE_RINGS):
        near = np.zeros(len(surface.vertices), dtype=bool)
        near[surface.faces[loose & ~inside]] = True
        loose |= near[surface.faces].any(axis=1)
    for number in np.unique(chart_of_face):
        rows = np.flatnonzero((chart_of_face == number) & ~loose)
        if len(rows):
            piece = _pieces(surface.faces[rows])
            loose[rows[np.bincount(piece)[piece] < MIN_REGION_FACES]] = True
    return loose


def _in_large_pieces(surface: Mesh, chosen: Bool[np.ndarray, "f"]) -> Bool[np.ndarray, "f"]:
    """Return which of the chosen faces are connected to `MIN_LOOSE_M2` of them."""
    rows, found = np.flatnonzero(chosen), np.zeros(len(chosen), dtype=bool)
    if len(rows):
        piece = _pieces(surface.faces[rows])
        found[rows] = np.bincount(piece, surface.face_areas_m2()[rows])[piece] >= MIN_LOOSE_M2
    return found


def _pieces(faces: Int[np.ndarray, "f 3"]) -> Int[np.ndarray, "f"]:
    """Return the connected component of each face."""
    return np.asarray(igl.vertex_components(faces.astype(np.int64))[faces[:, 0]]).astype(np.int32)


def _smallest_stretch(surface: Mesh, uv: np.ndarray, faces_uv: np.ndarray) -> Float[np.ndarray, "f"]:
    """Return the smaller singular value of the map from each face to the texture, 1/m."""
    a, b, c = (surface.vertices[surface.faces[:, k]].astype(np.float64) for k in range(3))
    along = (b - a) / np.maximum(np.linalg.norm(b - a, axis=1, keepdims=True), 1e-12)
    across = (c - a) - np.sum((c - a) * along, axis=1, keepdims=True) * along
    width, shift = np.linalg.norm(b - a, axis=1), np.sum((c - a) * along, axis=1)
    height = np.maximum(np.linalg.norm(across, axis=1), 1e-9)
    p, q, r = (uv[faces_uv[:, k]] for k in range(3))
    du = (q - p) / np.maximum(width, 1e-9)[:, None]
    dv = ((r - p) - shift[:, None] * du) / height[:, None]
    e, f, g = np.sum(du * du, axis=1), np.sum(du * dv, axis=1), np.sum(dv * dv, axis=1)
    return np.asarray(np.sqrt(np.maximum(0.5 * (e + g - np.hypot(e - g, 2.0 * f)), 0.0)))


def _overlapping(
    uv: np.ndarray, faces_uv: np.ndarray, ignored: Bool[np.ndarray, "f"], size_px: int
) -> Bool[np.ndarray, "f"]:
    """Return the faces that lie on a distant face of the layout: drawn from both sides, they show different faces."""
    rows = np.flatnonzero(~ignored)
    at_px = (uv[faces_uv[rows]].reshape(-1, 2) * size_px).astype(np.float32)
    corners = torch.arange(3 * len(rows), dtype=torch.int32).reshape(-1, 3)
    depth = torch.linspace(1.0, 2.0, len(rows)).repeat_interleave(3)
    seen = [
        rasterize(torch.from_numpy(at_px), order, corners, size_px, size_px)[0].numpy()
        for order in (depth, 3.0 - depth)
    ]
    differs = (seen[0] != seen[1]) & (seen[0] >= 0) & (seen[1] >= 0)
    pairs = np.unique(np.stack([seen[0][differs], seen[1][differs]], axis=1), axis=0)
    first, second = rows[pairs[:, 0]], rows[pairs[:, 1]]
    touches = (faces_uv[first][:, :, None] == faces_uv[second][:, None, :]).any(axis=(1, 2))
    found = np.zeros(len(faces_uv), dtype=bool)
    found[first[~touches]] = True
    found[second[~touches]] = True
    return found


def _with_loose_charts(
    surface: Mesh,
    atlas: Atlas,
    loose: Bool[np.ndarray, "f"],
    inside: Bool[np.ndarray, "f"],
    size_px: int,
    padding_px: int,
) -> Atlas:
    """Return the atlas with charts of the loose faces in the reserved square.

    inside: those of them whose charts are smaller (`INSIDE_SCALE`).
    """
    if not loose.any():
        return atlas
    left, bottom, right, top = load_layout().reserved
    rows = np.flatnonzero(loose)
    side = right - left - _RESERVED_MARGIN
    count = len(surface.vertices)
    part = Mesh(
        np.concatenate([surface.vertices, INSIDE_SCALE * surface.vertices]).astype(np.float32),
        surface.faces[rows] + np.int32(count) * inside[rows, None],
    )
    own = unwrap(part, _pieces(part.faces), int(side * size_px), padding_px)
    kept, corners = np.unique(atlas.faces_uv[~loose], return_inverse=True)
    faces_uv = np.zeros_like(atlas.faces_uv)
    faces_uv[~loose] = corners.reshape(-1, 3)
    faces_uv[rows] = own.faces_uv + len(kept)
    placed = own.uv * np.array([side, top - bottom - _RESERVED_MARGIN], np.float32)
    offset = np.array([left + _RESERVED_MARGIN, bottom], np.float32)
    return Atlas(
        np.concatenate([atlas.uv[kept], placed + offset]).astype(np.float32),
        faces_uv,
        np.concatenate([atlas.vertex_of_uv[kept], own.vertex_of_uv % count]).astype(np.int32),
    )
