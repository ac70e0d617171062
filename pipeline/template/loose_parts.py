"""Skirts and long hair: parts of a captured surface that hang freely, with the chains of joints that move them.

A skirt is told by its shape: below the crotch of the fitted body, one surface bridges both legs in front or behind.
Long hair is surface that stands off the neck and hangs down behind or beside it, in the colour of the back of the head.
A vertex belongs to such a part as far as it is from the fitted body: what lies on the body moves with it.

Notation: v vertices, c chains, n joints of a chain, k all joints of all chains.
"""

from dataclasses import dataclass
from typing import Literal

import cv2
import numpy as np
from jaxtyping import Bool, Float, Int
from scipy import sparse

from pipeline.body.body import Body
from pipeline.geometry.mesh import Mesh
from pipeline.geometry.surface import closest_points_on_mesh
from pipeline.mesh.files import MeshArtifact
from pipeline.template.sections import Section, cut_at_height

PartKind = Literal["skirt", "hair"]

SLICE_M = 0.01
"""Distance of the horizontal sections that are searched."""

MIN_SKIRT_M, MIN_HAIR_M = 0.12, 0.15
"""Least length of a skirt below the crotch of the body, which low trousers and long shirts do not reach, and of hair
below the base of the skull."""

BRIDGE_SHARE = 0.85
"""A section bridges the legs in front if its surface midway between them is this far forward, as a share of that before
the legs' axes. Trousers that touch are at 0 there, a straight skirt at 1. Generated skirts: 1.05 to 1.3."""

MIN_HEM_OFFSET_M = 0.02
"""Least distance of a hem from the body, the median over its directions. Generated skirts, flared and straight: 0.05 to
0.12; a man in wide trousers with a low crotch: 0.009."""

MAX_GAP_M = 0.03
"""Sections that are not bridged are passed over this far: folds and strands."""

SKIRT_CHAINS = 8

TIGHT_M, LOOSE_M = 0.008, 0.03
"""Surface nearer to the body than the first distance moves with it, farther than the second with the chains."""

HAIR_OFFSET_M, MIN_HAIR_VERTICES = 0.04, 12
"""Least distance of hair from the back of the neck, and vertices that a strand of it has."""

MAX_HAIR_COLOUR = 25.0
"""Greatest difference (CIELAB) of hair that hangs from the back of the head: a hood or a collar has another colour."""

_HAIR_SECTORS_DEG = (-60.0, 0.0, 60.0)
"""Directions around the neck of the strands, from behind towards the person's left."""

_COLLIDER_BONES = (
    ("LeftUpLeg", "LeftLeg"),
    ("RightUpLeg", "RightLeg"),
    ("LeftLeg", "LeftFoot"),
    ("RightLeg", "RightFoot"),
    ("Hips", "Hips"),
    ("Spine2", "Neck"),
    ("Head", "Head"),
)

_SMOOTHING_STEPS = 6

_SHORT_CHAIN_M = 0.45
"""Chains up to this length have two moving joints, longer ones three."""


@dataclass(frozen=True)
class Chain:
    """A chain of joints in the A-pose.

    Attributes:
        parent: name of the body's joint to which it is attached.
        joints_m: from the top down; the last one is the tip, which moves nothing.
    """

    parent: str
    joints_m: Float[np.ndarray, "n 3"]

    def length_m(self) -> float:
        """Return the length of the bones together."""
        return float(np.linalg.norm(np.diff(self.joints_m, axis=0), axis=1).sum())


@dataclass(frozen=True)
class LoosePart:
    """A skirt or a strand of hair.

    Attributes:
        kind: skirt or hair.
        chains: around the part.
        weights: of each vertex for each moving joint, chain by chain, without the tips; the rest of 1 is the body's.
    """

    kind: PartKind
    chains: tuple[Chain, ...]
    weights: Float[np.ndarray, "v k"]


@dataclass(frozen=True)
class Collider:
    """A capsule around a bone of the body; a sphere where both ends are the same joint.

    start, end: names of joints. radius_m: median distance of the bone's skin.
    """

    start: str
    end: str
    radius_m: float


def find_loose_parts(body: Body, skinned: MeshArtifact) -> list[LoosePart]:
    """Return what hangs freely on a person; nothing for close-fitting clothes and short hair.

    Args:
        body: the fitted body in the A-pose, with Mixamo's names of the joints.
        skinned: the captured mesh in the same pose and frame.
    """
    surface = Mesh(body.vertices, body.faces)
    distance_m, face, barycentric = closest_points_on_mesh(skinned.mesh.vertices.astype(np.float64), surface)
    nearest_m = np.einsum("vk,vkc->vc", barycentric, body.vertices[body.faces[face]].astype(np.float64))
    is_outside = np.sum((skinned.mesh.vertices - nearest_m) * surface.face_normals()[face], axis=1) > 0.0
    looseness = _smoothstep(np.where(is_outside, distance_m, 0.0), TIGHT_M, LOOSE_M)
    found = [_find_skirt(body, skinned, looseness), _find_hair(body, skinned, looseness)]
    return [part for part in found if part is not None]


def body_colliders(body: Body) -> list[Collider]:
    """Return capsules around legs, hips, chest and head, from which chains are kept away."""
    weights, vertices = body.skin_weights, body.vertices.astype(np.float64)
    found = []
    for start, end in _COLLIDER_BONES:
        if not {start, end} <= set(body.joint_names):
            continue
        first_m, last_m = (body.joints_m[body.joint(name)].astype(np.float64) for name in (start, end))
        points_m = vertices[weights[:, body.joint(start)] > 0.5]
        along = last_m - first_m
        fraction = np.clip((points_m - first_m) @ along / max(float(along @ along), 1e-12), 0.0, 1.0)
        distance_m = np.linalg.norm(points_m - first_m - fraction[:, None] * along, axis=1)
        if len(distance_m):
            found.append(Collider(start, end, float(np.median(distance_m))))
    return found


def skirt_hem_m(mesh: Mesh, body: Body) -> tuple[float, float]:
    """Return the lowest heights at which the surface and the body bridge both legs: the hem and the crotch."""
    hips = body.joints_m[[body.joint("LeftUpLeg"), body.joint("RightUpLeg")], 1].mean()
    crotch_m = _lowest_bridge_m(Mesh(body.vertices, body.faces), body, float(hips))
    return _lowest_bridge_m(mesh, body, float(hips)), crotch_m


def _find_skirt(body: Body, skinned: MeshArtifact, looseness: Float[np.ndarray, "v"]) -> LoosePart | None:
    """Return the skirt, or the lower part of a coat."""
    mesh = _without_arms(skinned, body)
    hem_m, crotch_m = skirt_hem_m(mesh, body)
    if crotch_m - hem_m < MIN_SKIRT_M:
        return None
    top_m = float(body.joints_m[[body.joint("LeftUpLeg"), body.joint("RightUpLeg")], 1].mean())
    heights_m = np.linspace(top_m, hem_m + 0.5 * SLICE_M, _joint_count(top_m - hem_m))
    sections = [cut_at_height(mesh, float(height_m)) for height_m in heights_m]
    angles_rad = 2.0 * np.pi * np.arange(SKIRT_CHAINS) / SKIRT_CHAINS
    chains, kept_rad = [], []
    for angle_rad in angles_rad:
        towards = np.array([np.sin(angle_rad), np.cos(angle_rad)])
        points = [
            section.exit_point_m(_leg_axis_m(body, float(height_m))[0], towards)
            for section, height_m in zip(sections, heights_m, strict=True)
        ]
        found = [
            (point[0], height_m, point[1])
            for point, height_m in zip(points, heights_m, strict=True)
            if point is not None
        ]
        if len(found) == len(heights_m):  # an open coat has no surface in front
            chains.append(Chain("Hips", np.array(found)))
            kept_rad.append(float(angle_rad))
    tips_m = np.array([chain.joints_m[-1] for chain in chains]).reshape(-1, 3)
    if (
        len(chains) < 3
        or np.median(closest_points_on_mesh(tips_m, Mesh(body.vertices, body.faces))[0]) < MIN_HEM_OFFSET_M
    ):
        return None
    vertices = skinned.mesh.vertices.astype(np.float64)
    along = (top_m - vertices[:, 1]) / (top_m - hem_m)
    amount = looseness * _smoothstep(along, 0.0, 0.5) * (vertices[:, 1] > hem_m - MAX_GAP_M) * ~_on_arms(skinned, body)
    middle_m = np.array([_leg_axis_m(body, float(height_m))[0] for height_m in vertices[:, 1].clip(hem_m, top_m)])
    around_rad = np.arctan2(*(vertices[:, [0, 2]] - middle_m).T)
    of_chain = _between_angles(around_rad, np.array(kept_rad))
    weights = _chain_weights(_smooth(amount, skinned.mesh), of_chain, along, len(heights_m) - 1)
    return LoosePart("skirt", tuple(chains), weights)


def _find_hair(body: Body, skinned: MeshArtifact, looseness: Float[np.ndarray, "v"]) -> LoosePart | None:
    """Return the hair that hangs below the base of the skull behind or beside the neck."""
    mesh, vertices = skinned.mesh, skinned.mesh.vertices.astype(np.float64)
    neck_m, skull_m = (body.joints_m[body.joint(name)].astype(np.float64) for name in ("Neck", "Head"))
    if _offset_behind_m(mesh, body, neck_m, skull_m) < HAIR_OFFSET_M:
        return None
    lab = cv2.cvtColor(skinned.vertex_colours[None].astype(np.float32), cv2.COLOR_RGB2LAB)[0].astype(np.float64)
    on_head = _weight_of(skinned, body, ("Head",)) > 0.9
    behind = on_head & (vertices[:, 1] > skull_m[1] + 0.06) & (vertices[:, 2] < skull_m[2])
    if not behind.any():
        return None
    is_hair_colour = np.linalg.norm(lab - np.median(lab[behind], axis=0), axis=1) < MAX_HAIR_COLOUR
    near = _weight_of(skinned, body, ("Head", "Neck", "Spine2", "Spine1", "LeftShoulder", "RightShoulder")) > 0.5
    hangs = near & (looseness > 0.3) & (vertices[:, 1] < skull_m[1]) & is_hair_colour & (vertices[:, 2] < neck_m[2])
    away_rad = np.arctan2(vertices[:, 0] - neck_m[0], neck_m[2] - vertices[:, 2])
    chains, kept_rad, lows_m = [], [], []
    for sector_rad in np.deg2rad(_HAIR_SECTORS_DEG):
        rows = hangs & (np.abs(away_rad - sector_rad) < np.deg2rad(30.0))
        if np.count_nonzero(rows) < MIN_HAIR_VERTICES:
            continue
        low_m = float(np.quantile(vertices[rows, 1], 0.03))
        if skull_m[1] - low_m < MIN_HAIR_M:
            continue
        chains.append(Chain("Head", _strand(vertices[rows], float(skull_m[1]), low_m)))
        kept_rad.append(float(sector_rad))
        lows_m.append(low_m)
    if not chains:
        return None
    joints = max(len(chain.joints_m) for chain in chains)
    chains = [Chain(chain.parent, _resampled(chain.joints_m, joints)) for chain in chains]
    along = (skull_m[1] - vertices[:, 1]) / (skull_m[1] - min(lows_m))
    amount = looseness * _smoothstep(along, 0.0, 0.3) * (near & is_hair_colour & (vertices[:, 2] < neck_m[2]))
    of_chain = _between_angles(away_rad, np.array(kept_rad))
    return LoosePart("hair", tuple(chains), _chain_weights(_smooth(amount, mesh), of_chain, along, joints - 1))


def _offset_behind_m(mesh: Mesh, body: Body, neck_m: Float[np.ndarray, "3"], skull_m: Float[np.ndarray, "3"]) -> float:
    """Return how far the surface lies behind the body's neck: the median over its height."""
    middle_x, offsets = float(neck_m[0]), []
    for height_m in np.arange(neck_m[1], skull_m[1], SLICE_M):
        back_m, body_m = (
            cut_at_height(surface, float(height_m)).depth_range_m(middle_x)[0]
            for surface in (mesh, Mesh(body.vertices, body.faces))
        )
        offsets.append(body_m - back_m)
    return float(np.nanmedian(offsets)) if np.isfinite(offsets).any() else 0.0


def _strand(points_m: Float[np.ndarray, "p 3"], top_m: float, low_m: float) -> Float[np.ndarray, "n 3"]:
    """Return joints down the middle of a strand."""
    heights_m = np.linspace(top_m, low_m, _joint_count(top_m - low_m))
    near = np.exp(-0.5 * ((points_m[:, 1] - heights_m[:, None]) / (0.3 * (top_m - low_m) / len(heights_m))) ** 2)
    middle_m = (near / np.maximum(near.sum(axis=1, keepdims=True), 1e-12)) @ points_m
    middle_m[:, 1] = heights_m
    return middle_m


def _resampled(joints_m: Float[np.ndarray, "n 3"], count: int) -> Float[np.ndarray, "m 3"]:
    """Return as many points on a chain, evenly spaced over its joints."""
    at = np.linspace(0.0, len(joints_m) - 1.0, count)
    return np.stack([np.interp(at, np.arange(len(joints_m)), column) for column in joints_m.T], axis=1)


def _lowest_bridge_m(mesh: Mesh, body: Body, top_m: float) -> float:
    """Return the lowest height, from `top_m` down without a gap, at which a surface bridges both legs."""
    ankle_m = float(body.joints_m[[body.joint("LeftFoot"), body.joint("RightFoot")], 1].mean())
    lowest_m = top_m
    for height_m in np.arange(top_m, ankle_m, -SLICE_M):
        if _is_bridged(cut_at_height(mesh, float(height_m)), *_leg_axis_m(body, float(height_m))):
            lowest_m = float(height_m)
        elif lowest_m - height_m > MAX_GAP_M:
            break
    return lowest_m


def _is_bridged(section: Section, middle_m: Float[np.ndarray, "2"], half_m: Float[np.ndarray, "2"]) -> bool:
    """Return whether the surface between the legs is as far forward, or back, as before the legs' axes."""
    back_m, front_m = section.depth_range_m(float(middle_m[0]))
    sides = [
        (middle_m + sign * half_m, section.depth_range_m(float(middle_m[0] + sign * half_m[0]))) for sign in (-1, 1)
    ]
    leg_front_m = np.mean([found[1] - axis_m[1] for axis_m, found in sides])
    leg_back_m = np.mean([axis_m[1] - found[0] for axis_m, found in sides])
    in_front, behind = front_m - middle_m[1], middle_m[1] - back_m
    return bool(in_front > BRIDGE_SHARE * leg_front_m or behind > BRIDGE_SHARE * leg_back_m)  # nan is False


def _leg_axis_m(body: Body, height_m: float) -> tuple[Float[np.ndarray, "2"], Float[np.ndarray, "2"]]:
    """Return x and z midway between the axes of the legs at a height, and half the way from right to left."""
    points = []
    for side in ("Right", "Left"):
        leg_m = body.joints_m[[body.joint(f"{side}{name}") for name in ("Foot", "Leg", "UpLeg")]].astype(np.float64)
        points.append(np.array([np.interp(height_m, leg_m[:, 1], leg_m[:, axis]) for axis in (0, 2)]))
    return 0.5 * (points[0] + points[1]), 0.5 * (points[1] - points[0])


def _weight_of(skinned: MeshArtifact, body: Body, names: tuple[str, ...]) -> Float[np.ndarray, "v"]:
    joints = [body.joint(name) for name in names]
    return np.asarray(np.where(np.isin(skinned.joint_indices, joints), skinned.joint_weights, 0.0).sum(axis=1))


def _on_arms(skinned: MeshArtifact, body: Body) -> Bool[np.ndarray, "v"]:
    names = tuple(name for name in body.joint_names if "Arm" in name or "Hand" in name)
    return np.asarray(_weight_of(skinned, body, names) > 0.5)


def _without_arms(skinned: MeshArtifact, body: Body) -> Mesh:
    """Return the mesh without the faces of arms, which hang beside a skirt."""
    on_arms = _on_arms(skinned, body)
    return Mesh(skinned.mesh.vertices, skinned.mesh.faces[~on_arms[skinned.mesh.faces].any(axis=1)])


def _joint_count(length_m: float) -> int:
    return 3 if length_m <= _SHORT_CHAIN_M else 4


def _chain_weights(
    amount: Float[np.ndarray, "v"], of_chain: Float[np.ndarray, "v c"], along: Float[np.ndarray, "v"], moving: int
) -> Float[np.ndarray, "v k"]:
    """Return the weights of the moving joints: a joint has its own bone, blended with the next over half a bone.

    amount: share of the chains together. of_chain: share of each. along: 0 at the top of the chains, 1 at the tips.
    """
    bone = np.clip(along, 0.0, 1.0) * moving
    edges = np.arange(1, moving)
    reached = np.clip(
        2.0 * (bone[:, None] - edges) + 0.5, 0.0, 1.0
    )  # how far each joint below the first has taken over
    of_joint = np.concatenate([np.ones((len(bone), 1)), reached], axis=1)
    of_joint[:, :-1] -= reached
    return (amount[:, None, None] * of_chain[:, :, None] * of_joint[:, None, :]).reshape(len(bone), -1)


def _between_angles(angle_rad: Float[np.ndarray, "v"], chains_rad: Float[np.ndarray, "c"]) -> Float[np.ndarray, "v c"]:
    """Return the shares of the two chains beside each angle, linear between them."""
    order, turn = np.argsort(chains_rad), 2.0 * np.pi
    if len(order) == 1:
        return np.ones((len(angle_rad), 1))
    sorted_rad = chains_rad[order]
    at = (angle_rad - sorted_rad[0]) % turn + sorted_rad[0]
    after = np.searchsorted(sorted_rad, at, side="right")
    before = after - 1
    gap = np.append(sorted_rad[1:], sorted_rad[0] + turn)[before] - sorted_rad[before]
    fraction = np.clip((at - sorted_rad[before]) / gap, 0.0, 1.0)
    rows, shares = np.arange(len(at)), np.zeros((len(at), len(order)))
    shares[rows, order[before]] += 1.0 - fraction
    shares[rows, order[after % len(order)]] += fraction
    return shares


def _smooth(values: Float[np.ndarray, "v"], mesh: Mesh) -> Float[np.ndarray, "v"]:
    """Return means over neighbours, some times over: weights do not jump where cloth leaves the body."""
    pairs: Int[np.ndarray, "e 2"] = np.concatenate(
        [mesh.faces[:, [0, 1]], mesh.faces[:, [1, 2]], mesh.faces[:, [2, 0]]]
    )
    count = len(values)
    graph = sparse.coo_matrix((np.ones(len(pairs)), pairs.T), shape=(count, count))
    graph = ((graph + graph.T) > 0).astype(np.float64) + sparse.eye(count)
    mean = sparse.diags(1.0 / np.asarray(graph.sum(axis=1)).ravel()) @ graph
    for _ in range(_SMOOTHING_STEPS):
        values = mean @ values
    return np.asarray(values)


def _smoothstep(values: Float[np.ndarray, "v"], low: float, high: float) -> Float[np.ndarray, "v"]:
    t = np.clip((values - low) / (high - low), 0.0, 1.0)
    return np.asarray(t * t * (3.0 - 2.0 * t))
