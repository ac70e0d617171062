"""Skin weights and a rest surface that do not tear: edges are stretched little in poses that nobody filmed.

Weights that jump between neighbours, at armpits and between the legs, are not seen in the filmed poses, and tear the
surface in others. Near edges that are stretched in `range_of_motion.POSES`, weights and vertices are found anew. With
p poses of that range, c filmed ones, e edges and v vertices, the energy is

    sum_pe huber(max(0, s_pe - LIMIT)) + sum_pe max(0, COLLAPSED - s_pe)^2
    + sum_cv CAPTURE_WEIGHT * visible_cv * max(0, d_cv - FREE_MM)^2 + smoothness of the changes,

where s is the length of an edge in a pose over that in the A-pose, and d the distance by which a vertex leaves its
place in a filmed frame that shows it (mm): the pictures stay as they are. Linear blend skinning is linear in the
weights (Jacobson et al., "Bounded biharmonic weights", 2011, minimise another quadratic energy of them); the weights of
a vertex are the softmax of free parameters, so that they stay positive with sum 1, and the four largest are kept.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from pipeline.body.body import Body
from pipeline.capture.frame_selection import evenly_spaced
from pipeline.core.progress import track
from pipeline.geometry.camera import project
from pipeline.geometry.mesh import Mesh
from pipeline.geometry.skinning import linear_blend_skinning
from pipeline.geometry.surface import (
    closest_points_on_mesh,
    count_self_intersecting_faces,
    laplacian,
    resolve_self_intersections,
)
from pipeline.kernels.adam import adam_step_
from pipeline.kernels.raster import rasterize
from pipeline.mesh.range_of_motion import sample_poses
from pipeline.mesh.skin_transfer import SkinnedTopology, build_skinned_topology
from pipeline.mesh.views import PosedView

MAX_STRETCH = 2.0
"""Edges that are stretched by more than this in one of the poses are mended, with their surroundings."""
LIMIT, HUBER, COLLAPSED = 1.5, 0.4, 0.3
"""Ratio above which an edge counts; excess from where its energy is linear; ratio below which it counts again."""
CAPTURE_WEIGHT, FREE_MM, EVERYWHERE_WEIGHT = 0.15, 1.5, 0.0005
"""Weight of a squared millimetre in frames that show a vertex; displacement that is free; weight in all frames."""
WEIGHTS_SMOOTHNESS, OFFSET_SMOOTHNESS = 3.0, 0.2
"""Weights of the squared Laplacians of the changes of weights and of the vertices (mm)."""
RINGS, SPREAD_STEPS, CANDIDATES, INFLUENCES = 10, 40, 6, 4
"""Rings of edges around a stretched edge that may change; smoothing steps that tell which joints may get weight; number
of these joints; number of joints in the end."""
STEPS, SPARSE_FROM, WEIGHT_RATE, OFFSET_RATE_MM = 80, 0.6, 0.075, 0.18
"""Steps of Adam; share of them after which only `INFLUENCES` joints are left; learning rates."""
MIN_EDGE_M = 0.002
"""Shorter edges are not measured: their length is mostly noise of the extraction."""
ADAM_BETAS, ADAM_EPSILON = (0.9, 0.999), 1e-8
"""Decay of both moments, and what keeps a step finite (Kingma & Ba 2015)."""
SHOWN_FRAMES = 8
"""Filmed frames whose pictures must not change."""


@dataclass(frozen=True)
class RelaxedSkin:
    """A mesh with its new skin.

    Attributes:
        mesh: the same faces.
        skin: at most four influences a vertex.
        stretch_before, stretch_after: 99.9th percentile of the stretch of edges in the poses of the range of motion.
        shown_change_mm: 99th percentile of the displacement of what the filmed frames show.
    """

    mesh: Mesh
    skin: SkinnedTopology
    stretch_before: float
    stretch_after: float
    shown_change_mm: float


def relax_skin(mesh: Mesh, skin: SkinnedTopology, body: Body, views: Sequence[PosedView]) -> RelaxedSkin:
    """Return mesh and skin whose edges are stretched less in unseen poses, and which look the same in filmed ones.

    Args:
        mesh: in the A-pose, m.
        skin: its skin.
        body: joints with Mixamo's names; of others nothing moves, and nothing changes.
        views: filmed frames.
    """
    poses = sample_poses(body)
    edges = long_edges(mesh)
    before = edge_stretch(mesh, skin.weights, edges, poses)
    stretched = before.amax(dim=0) > MAX_STRETCH
    zone = rings_around(mesh, np.unique(edges[stretched.numpy()]), RINGS)
    level = float(np.quantile(before.numpy(), 0.999))
    if not zone.any():
        return RelaxedSkin(mesh, skin, level, level, 0.0)
    shown = [views[k] for k in evenly_spaced(len(views), SHOWN_FRAMES)]
    seen = [visible_vertices(mesh, skin.weights, view) for view in shown]
    tearing = poses[(before > MAX_STRETCH).any(dim=1)]
    vertices, weights = _minimise(_build_zone(mesh, skin.weights, zone), (mesh, skin.weights), tearing, shown, seen)
    found = Mesh(vertices, mesh.faces)
    if count_self_intersecting_faces(found) > count_self_intersecting_faces(mesh):
        found = resolve_self_intersections(found)
    relaxed = build_skinned_topology(found, weights)
    after = edge_stretch(found, weights, edges, poses)
    change_mm = []
    for view, is_seen in zip(shown, seen, strict=True):
        now_m = view.pose_vertices(torch.from_numpy(found.vertices), weights)
        moved_m = now_m - view.pose_vertices(torch.from_numpy(mesh.vertices), skin.weights)
        change_mm.append(1e3 * moved_m.norm(dim=1)[is_seen])
    last, shown_mm = float(np.quantile(after.numpy(), 0.999)), float(np.quantile(torch.cat(change_mm).numpy(), 0.99))
    return RelaxedSkin(found, relaxed, level, last, shown_mm)


def move_along(surface: Mesh, before: Mesh, after: Mesh) -> Mesh:
    """Return a surface whose vertices move as the nearest points of a mesh did that changed its vertices."""
    _, face, barycentric = closest_points_on_mesh(surface.vertices, before)
    moved_m = np.einsum("nk,nkc->nc", barycentric, (after.vertices - before.vertices)[before.faces[face]])
    return Mesh((surface.vertices + moved_m).astype(np.float32), surface.faces)


def long_edges(mesh: Mesh) -> Int[np.ndarray, "e 2"]:
    """Return the edges that are longer than `MIN_EDGE_M`."""
    edges = mesh.edges()
    length_m = np.linalg.norm(mesh.vertices[edges[:, 0]] - mesh.vertices[edges[:, 1]], axis=1)
    return np.asarray(edges[length_m > MIN_EDGE_M])


def edge_stretch(
    mesh: Mesh, weights: Float[Tensor, "v j"], edges: Int[np.ndarray, "e 2"], poses: Float[Tensor, "n j 4 4"]
) -> Float[Tensor, "n e"]:
    """Return the length of edges in each pose over that in the A-pose."""
    vertices, ends = torch.from_numpy(mesh.vertices), torch.from_numpy(edges.astype(np.int64))
    rest_m = (vertices[ends[:, 0]] - vertices[ends[:, 1]]).norm(dim=1)
    rows = []
    for pose in poses:
        posed = linear_blend_skinning(vertices, weights, pose[None])[0]
        rows.append((posed[ends[:, 0]] - posed[ends[:, 1]]).norm(dim=1) / rest_m)
    return torch.stack(rows)


def visible_vertices(mesh: Mesh, weights: Float[Tensor, "v j"], view: PosedView) -> Bool[Tensor, "v"]:
    """Return which vertices have a face that a filmed frame shows."""
    faces, camera = torch.from_numpy(mesh.faces), view.camera
    posed = view.pose_vertices(torch.from_numpy(mesh.vertices), weights)
    face = rasterize(*project(posed, camera), faces, camera.height, camera.width)[0]
    seen = torch.zeros(len(mesh.vertices), dtype=torch.bool)
    seen[faces[face[face >= 0].unique().long()].long().reshape(-1)] = True
    return seen


def rings_around(mesh: Mesh, vertices: Int[np.ndarray, "k"], rings: int) -> Bool[np.ndarray, "v"]:
    """Return the vertices that are at most `rings` edges away from some vertices."""
    edges = mesh.edges()
    near = np.zeros(len(mesh.vertices), dtype=bool)
    near[vertices] = True
    for _ in range(rings):
        touched = near[edges].any(axis=1)
        near[edges[touched]] = True
    return near


@dataclass(frozen=True)
class _Zone:
    """The vertices that may change, and the others at edges to them; indices are those of `rows`.

    rows: in the mesh. free: 1 where a vertex may change. joints, start: candidates and their first weights. edges.
    """

    rows: Int[Tensor, "u"]
    free: Float[Tensor, "u 1"]
    joints: Int[Tensor, "u k"]
    start: Float[Tensor, "u k"]
    spread: Float[Tensor, "u k"]
    edges: Int[Tensor, "e 2"]
    joint_count: int

    def dense(self, weights: Float[Tensor, "u k"]) -> Float[Tensor, "u j"]:
        """Return one column of weights for every joint."""
        return torch.zeros(len(weights), self.joint_count).scatter_add(1, self.joints, weights)

    def laplacian(self, values: Float[Tensor, "u c"]) -> Float[Tensor, "u c"]:
        """Return values minus the mean of their neighbours, where vertices may change."""
        first, second = self.edges.T
        degree = torch.bincount(self.edges.reshape(-1), minlength=len(values)).clamp_min(1)[:, None]
        total = torch.zeros_like(values).index_add(0, first, values[second]).index_add(0, second, values[first])
        return self.free * (values - total / degree)


def _build_zone(mesh: Mesh, weights: Float[Tensor, "v j"], zone: Bool[np.ndarray, "v"]) -> _Zone:
    operator, spread = laplacian(mesh), weights.numpy().astype(np.float64)
    first = spread.copy()
    for _ in range(SPREAD_STEPS):
        spread = np.where(zone[:, None], spread - 0.5 * (operator @ spread), first)
    joints = np.argsort(-(spread + first), axis=1, kind="stable")[:, :CANDIDATES]
    edges = long_edges(mesh)
    edges = edges[zone[edges].any(axis=1)]
    rows = np.unique(np.concatenate([edges.ravel(), np.flatnonzero(zone)]))
    local = np.zeros(len(zone), dtype=np.int64)
    local[rows] = np.arange(len(rows))
    start, wide = (np.take_along_axis(values, joints, axis=1)[rows] for values in (first, spread))
    start, wide = (values / values.sum(axis=1, keepdims=True) for values in (start, wide))
    return _Zone(
        torch.from_numpy(rows),
        torch.from_numpy(zone[rows]).float()[:, None],
        torch.from_numpy(joints[rows]),
        torch.from_numpy(start).float(),
        torch.from_numpy(wide).float(),
        torch.from_numpy(local[edges]),
        weights.shape[1],
    )


def _minimise(
    part: _Zone,
    skinned: tuple[Mesh, Float[Tensor, "v j"]],
    poses: Float[Tensor, "n j 4 4"],
    views: Sequence[PosedView],
    is_seen: Sequence[Bool[Tensor, "v"]],
) -> tuple[Float[np.ndarray, "v 3"], Float[Tensor, "v j"]]:
    """Return the vertices and weights of the least energy that Adam finds.

    skinned: the mesh and its weights. is_seen: which vertices each view shows.
    """
    mesh, weights = skinned
    filmed = torch.stack([view.canonical_to_world for view in views]).float()
    seen = torch.stack([shown[part.rows] for shown in is_seen]).float()
    at_m = torch.from_numpy(mesh.vertices)[part.rows]
    shown_m = linear_blend_skinning(at_m, part.dense(part.start), filmed)
    logits = (0.5 * part.start + 0.5 * part.spread + 1e-4).log().requires_grad_(True)
    offset_mm = torch.zeros_like(at_m, requires_grad=True)
    allowed = torch.ones_like(part.start, dtype=torch.bool)
    free = ((logits, WEIGHT_RATE), (offset_mm, OFFSET_RATE_MM))
    moments = [(torch.zeros_like(values), torch.zeros_like(values)) for values, _ in free]

    def current() -> tuple[Float[Tensor, "u k"], Float[Tensor, "u 3"]]:
        chosen = torch.softmax(logits.masked_fill(~allowed, -torch.inf), dim=1)
        return part.free * chosen + (1.0 - part.free) * part.start, part.free * offset_mm

    for step in track(range(STEPS), "relaxing the skin"):
        if step == int(SPARSE_FROM * STEPS):
            chosen = current()[0].detach()
            least = chosen.topk(min(INFLUENCES, chosen.shape[1]), dim=1).values[:, -1:]
            allowed = chosen >= least
        now, moved_mm = current()
        vertices_m, dense = at_m + 1e-3 * moved_mm, part.dense(now)
        displaced_mm = 1e3 * (linear_blend_skinning(vertices_m, dense, filmed) - shown_m)
        energy = (
            _stretch_energy(vertices_m, dense, part.edges, poses)
            + _capture_energy(displaced_mm, seen)
            + WEIGHTS_SMOOTHNESS * part.laplacian(part.dense(now - part.start)).square().sum()
            + OFFSET_SMOOTHNESS * part.laplacian(moved_mm).square().sum()
        )
        gradients = torch.autograd.grad(energy, [values for values, _ in free])
        for (values, rate), gradient, moment in zip(free, gradients, moments, strict=True):
            adam_step_(values, gradient, *moment, step + 1, rate, ADAM_BETAS, ADAM_EPSILON)
    now, moved_mm = (values.detach() for values in current())
    new_weights, new_vertices = weights.clone(), mesh.vertices.copy()
    is_free = part.free[:, 0] > 0.0
    new_weights[part.rows[is_free]] = part.dense(now)[is_free]
    new_vertices[part.rows.numpy()] += 1e-3 * moved_mm.numpy()
    return new_vertices, new_weights


def _stretch_energy(
    vertices_m: Float[Tensor, "u 3"],
    weights: Float[Tensor, "u j"],
    edges: Int[Tensor, "e 2"],
    poses: Float[Tensor, "n j 4 4"],
) -> Float[Tensor, ""]:
    posed = linear_blend_skinning(vertices_m, weights, poses)
    first, second = edges.T
    stretch = (posed[:, first] - posed[:, second]).norm(dim=2) / (vertices_m[first] - vertices_m[second]).norm(dim=1)
    excess, lack = (stretch - LIMIT).clamp_min(0.0), (COLLAPSED - stretch).clamp_min(0.0)
    huber = torch.where(excess < HUBER, excess.square(), HUBER * (2.0 * excess - HUBER))
    return huber.sum() + lack.square().sum()


def _capture_energy(displaced_mm: Float[Tensor, "c u 3"], seen: Float[Tensor, "c u"]) -> Float[Tensor, ""]:
    squared = displaced_mm.square().sum(dim=2)
    beyond = ((squared + 1e-8).sqrt() - FREE_MM).clamp_min(0.0).square()
    total = CAPTURE_WEIGHT * seen * beyond + EVERYWHERE_WEIGHT * squared
    return total.sum() / len(displaced_mm)
