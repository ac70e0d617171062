"""Spring bones of VRM: chains of joints for a skirt or long hair, with their weights, settings and colliders.

A spring joint swings like a pendulum as long as its chain: VRM's forces are steps of the position, of which one frame
of 1/60 s adds `stiffness / 60`, so gravity itself is the stiffness 9.81 / 60 whatever the length; drag is the share of
the velocity that a frame takes away, which follows from the length and the ratio of critical damping.

References: VRMC_springBone-1.0 and VRM 0.x (secondaryAnimation) in https://github.com/vrm-c/vrm-specification.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float

from pipeline.avatar.gltf import normalise_weights
from pipeline.geometry.skinning import top_k_weights
from pipeline.io.glb import GlbFile
from pipeline.io.glb_writer import GlbWriter
from pipeline.template.chains import Chain, LoosePart, PartKind
from pipeline.template.loose_parts import Collider

FRAME_S, GRAVITY_M_S2 = 1.0 / 60.0, 9.81

_STIFFNESS: dict[PartKind, float] = {"skirt": 4.0, "hair": 1.0}
"""Of the chains, in units of gravity: cloth around a body keeps its shape, hair hangs."""

_GRAVITY: dict[PartKind, float] = {"skirt": 0.0, "hair": 1.0}
"""Additional pull downwards: hair hangs along it at rest; a skirt at rest has its captured shape, which would sag."""

_DAMPING_RATIO = 0.5

_HIT_RADIUS_M, _CLEARANCE_M = 0.05, 0.002
"""Radius of a joint that colliders push away, and its least distance from colliders at rest."""

_SPHERES_PER_RADIUS = 1.0
"""VRM 0.x has only spheres: so many for each radius of a capsule's length."""


@dataclass(frozen=True)
class LooseParts:
    """What hangs freely on an avatar; chains and weights of the vertices are those of the .glb, in its bind pose."""

    parts: tuple[LoosePart, ...] = ()
    colliders: tuple[Collider, ...] = ()

    def chains(self) -> list[tuple[PartKind, Chain]]:
        """Return all chains with the kind of their part, in the order of their joints."""
        return [(part.kind, chain) for part in self.parts for chain in part.chains]


@dataclass(frozen=True)
class SpringJoints:
    """A file with the joints of all chains, and where they are.

    Attributes:
        file: the avatar with more joints.
        nodes: of each chain, from the top to the tip.
        kinds: of each chain.
        colliders: of the body.
    """

    file: GlbFile
    nodes: tuple[tuple[int, ...], ...] = ()
    kinds: tuple[PartKind, ...] = ()
    colliders: tuple[Collider, ...] = ()


def add_spring_joints(file: GlbFile, joint_names: Sequence[str], loose: LooseParts) -> SpringJoints:
    """Return the avatar with a node and a joint of its skin for each joint of the chains, and with their weights.

    Args:
        file: one skinned mesh; its nodes end with those of cameras, which are left out.
        joint_names: Mixamo's names of the skin's joints, in its order.
        loose: parts; the file stays as it is without any.

    Raises:
        UserError: the file's arrays cannot be read.
    """
    if not loose.parts:
        return SpringJoints(file)
    document = GlbWriter.from_file(file)
    remove_cameras(document)
    skin = document.json["skins"][0]
    first = len(skin["joints"])
    bind = np.linalg.inv(file.accessor(skin["inverseBindMatrices"]).reshape(-1, 4, 4).transpose(0, 2, 1).astype(float))
    inverse_bind, moving = [np.linalg.inv(bind)], []
    nodes: list[tuple[int, ...]] = []
    for number, (kind, chain) in enumerate(loose.chains()):
        parent = list(joint_names).index(chain.parent)
        parent_node, parent_to_file = skin["joints"][parent], bind[parent]
        added = []
        for level, position_m in enumerate(chain.joints_m):
            local_m = np.linalg.solve(parent_to_file, np.append(position_m, 1.0))[:3]
            node = document.add("nodes", {"name": f"{kind}_{number}_{level}", "translation": local_m.tolist()})
            document.json["nodes"][parent_node].setdefault("children", []).append(node)
            parent_node, parent_to_file = node, parent_to_file.copy()
            parent_to_file[:3, 3] = position_m
            inverse_bind.append(np.linalg.inv(parent_to_file)[None])
            if level + 1 < len(chain.joints_m):
                moving.append(first + sum(len(chain_nodes) for chain_nodes in nodes) + level)
            added.append(node)
        nodes.append(tuple(added))
    skin["joints"] = [*skin["joints"], *(node for chain_nodes in nodes for node in chain_nodes)]
    columns = np.concatenate(inverse_bind).transpose(0, 2, 1).reshape(-1, 16).astype(np.float32)
    columns[:, 3::4] = [0.0, 0.0, 0.0, 1.0]
    document.replace_array(skin["inverseBindMatrices"], columns)
    _replace_weights(file, document, np.concatenate([part.weights for part in loose.parts], axis=1), moving)
    document.remove_unused()
    return SpringJoints(
        GlbFile(Path(file.path), document.to_bytes()),
        tuple(nodes),
        tuple(k for k, _ in loose.chains()),
        loose.colliders,
    )


def remove_cameras(document: GlbWriter) -> None:
    """Remove the cameras and their nodes, which come last among the nodes (`pipeline.avatar.gltf`)."""
    document.json.pop("cameras", None)
    nodes = document.json["nodes"]
    while "camera" in nodes[-1]:
        nodes.pop()
    for scene in document.json["scenes"]:
        scene["nodes"] = [node for node in scene["nodes"] if node < len(nodes)]


@dataclass(frozen=True)
class RestColliders:
    """Colliders and joints at rest, in the frame of the file.

    Attributes:
        capsules: node, ends relative to it (m; twice the same for a sphere), and radius (m) of each collider.
        hit_radius_m: of each joint of each chain but the tip; the colliders are clear of all of them at rest.
    """

    capsules: list[tuple[int, Float[np.ndarray, "2 3"], float]]
    hit_radius_m: list[list[float]]


def place_colliders(
    springs: SpringJoints, place: dict[str, tuple[int, Float[np.ndarray, "3"]]], nodes_m: dict[int, np.ndarray]
) -> RestColliders:
    """Return the colliders at rest; those that would touch a joint at rest are made smaller.

    Args:
        springs: chains and colliders.
        place: node and position at rest of each joint of the body, by Mixamo's name.
        nodes_m: position at rest of the nodes of the chains.
    """
    capsules, world = [], []
    tails_m = np.array([nodes_m[node] for chain in springs.nodes for node in chain[1:]])
    for collider in springs.colliders:
        node, start_m = place[collider.start]
        ends_m = np.stack([start_m, place[collider.end][1]])
        nearest_m = _distance_to_segment_m(tails_m, *ends_m).min()
        radius_m = float(min(collider.radius_m, nearest_m - _CLEARANCE_M))
        if radius_m > _CLEARANCE_M:
            capsules.append((node, ends_m - start_m, radius_m))
            world.append((ends_m, radius_m))
    hit_m = []
    for chain in springs.nodes:
        free_m = [
            min((float(_distance_to_segment_m(nodes_m[n][None], *e)[0]) - r for e, r in world), default=_HIT_RADIUS_M)
            for n in chain[1:]
        ]
        hit_m.append([float(np.clip(free - 0.5 * _CLEARANCE_M, 0.0, _HIT_RADIUS_M)) for free in free_m])
    return RestColliders(capsules, hit_m)


def springs_vrm1(springs: SpringJoints, rest: RestColliders, nodes_m: dict[int, np.ndarray]) -> dict[str, Any]:
    """Return the extension VRMC_springBone."""
    colliders = []
    for node, ends_m, radius_m in rest.capsules:
        ball = {"offset": ends_m[0].tolist(), "radius": radius_m}
        is_sphere = np.allclose(ends_m[0], ends_m[1])
        shape = {"sphere": ball} if is_sphere else {"capsule": ball | {"tail": ends_m[1].tolist()}}
        colliders.append({"node": node, "shape": shape})
    chains = []
    for number, (chain, kind) in enumerate(zip(springs.nodes, springs.kinds, strict=True)):
        settings = _settings(kind, _length_m(chain, nodes_m))
        force: dict[str, Any] = {
            "stiffness": settings["stiffness"],
            "gravityPower": settings["gravity"],
            "gravityDir": [0.0, -1.0, 0.0],
            "dragForce": settings["drag"],
        }
        bones = zip(chain[:-1], rest.hit_radius_m[number], strict=True)
        joints: list[dict[str, Any]] = [{"node": node, "hitRadius": hit_m} | force for node, hit_m in bones]
        used: dict[str, Any] = {"colliderGroups": [0]} if colliders else {}
        chains.append({"name": f"{kind}_{number}", "joints": [*joints, {"node": chain[-1]}]} | used)
    groups = {"colliderGroups": [{"name": "body", "colliders": list(range(len(colliders)))}]} if colliders else {}
    return {"specVersion": "1.0"} | ({"colliders": colliders} if colliders else {}) | groups | {"springs": chains}


def springs_vrm0(springs: SpringJoints, rest: RestColliders, nodes_m: dict[int, np.ndarray]) -> dict[str, Any]:
    """Return `secondaryAnimation` of VRM 0.x; capsules are rows of spheres, z is Unity's, that of glTF negated."""
    by_node: dict[int, list[dict[str, Any]]] = {}
    for node, ends_m, radius_m in rest.capsules:
        length_m = float(np.linalg.norm(ends_m[1] - ends_m[0]))
        count = 1 + int(np.ceil(_SPHERES_PER_RADIUS * length_m / radius_m))
        for x, y, z in np.linspace(ends_m[0], ends_m[1], count).tolist():
            by_node.setdefault(node, []).append({"offset": {"x": x, "y": y, "z": -z}, "radius": radius_m})
    groups = [{"node": node, "colliders": colliders} for node, colliders in by_node.items()]
    bones = []
    for number, (chain, kind) in enumerate(zip(springs.nodes, springs.kinds, strict=True)):
        settings = _settings(kind, _length_m(chain, nodes_m))
        bones.append(
            {
                "comment": f"{kind}_{number}",
                "stiffiness": settings["stiffness"],  # the specification's spelling
                "gravityPower": settings["gravity"],
                "gravityDir": {"x": 0.0, "y": -1.0, "z": 0.0},
                "dragForce": settings["drag"],
                "center": -1,
                "hitRadius": min(rest.hit_radius_m[number]),
                "bones": [chain[0]],
                "colliderGroups": list(range(len(groups))),
            }
        )
    return {"boneGroups": bones, "colliderGroups": groups}


def _settings(kind: PartKind, length_m: float) -> dict[str, float]:
    """Return stiffness, gravity and drag of a chain; see the top of this module."""
    force = GRAVITY_M_S2 * FRAME_S
    frequency_rad_s = np.sqrt((_STIFFNESS[kind] + _GRAVITY[kind]) * GRAVITY_M_S2 / length_m)
    return {
        "stiffness": float(_STIFFNESS[kind] * force),
        "gravity": float(_GRAVITY[kind] * force),
        "drag": float(1.0 - np.exp(-2.0 * _DAMPING_RATIO * frequency_rad_s * FRAME_S)),
    }


def _length_m(chain: Sequence[int], nodes_m: dict[int, np.ndarray]) -> float:
    return float(np.linalg.norm(np.diff([nodes_m[node] for node in chain], axis=0), axis=1).sum())


def _replace_weights(
    file: GlbFile, document: GlbWriter, added: Float[np.ndarray, "v k"], moving: Sequence[int]
) -> None:
    """Give the moving joints their weights, and the body's joints the rest."""
    (primitive,) = document.json["meshes"][0]["primitives"]
    attributes, count = primitive["attributes"], len(document.json["skins"][0]["joints"])
    joints, weights = (file.accessor(attributes[name]) for name in ("JOINTS_0", "WEIGHTS_0"))
    dense = np.zeros((len(joints), count))
    np.add.at(dense, (np.arange(len(joints))[:, None], joints), weights)
    dense *= 1.0 - added.sum(axis=1, keepdims=True)
    dense[:, moving] = added
    indices, values = top_k_weights(dense.astype(np.float32), joints.shape[1])
    indices = np.where(values > 0.0, indices, 0)
    document.replace_array(attributes["JOINTS_0"], indices.astype(np.uint8 if count <= 256 else np.uint16))
    document.replace_array(attributes["WEIGHTS_0"], normalise_weights(values))


def _distance_to_segment_m(
    points_m: Float[np.ndarray, "p 3"], start_m: Float[np.ndarray, "3"], end_m: Float[np.ndarray, "3"]
) -> Float[np.ndarray, "p"]:
    along = end_m - start_m
    fraction = np.clip((points_m - start_m) @ along / max(float(along @ along), 1e-12), 0.0, 1.0)
    return np.asarray(np.linalg.norm(points_m - start_m - fraction[:, None] * along, axis=1))
