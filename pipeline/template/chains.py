"""Chains of joints for parts that hang freely, and the weights with which they move a surface.

Notation: v vertices, c chains, n joints of a chain, k all joints of all chains.
"""

from dataclasses import dataclass
from typing import Literal

import numpy as np
from jaxtyping import Float
from scipy import sparse
from scipy.sparse.linalg import spsolve

from pipeline.body.body import Body
from pipeline.geometry.mesh import Mesh
from pipeline.geometry.surface import adjacency
from pipeline.mesh.files import MeshArtifact

PartKind = Literal["skirt", "hair"]

_SMOOTHING_M, _MIN_EDGE_M = 0.03, 1e-4
"""Distance over which weights diffuse, and the least length of an edge on the way."""

_LEAST_SHARE = 0.02
"""Diffused shares up to this are 0: diffusion reaches the whole surface. Larger ones follow without a jump."""

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


def weight_of(skinned: MeshArtifact, body: Body, names: tuple[str, ...]) -> Float[np.ndarray, "v"]:
    """Return the skin weight of each vertex on some joints of the body together."""
    joints = [body.joint(name) for name in names]
    return np.asarray(np.where(np.isin(skinned.joint_indices, joints), skinned.joint_weights, 0.0).sum(axis=1))


def joint_count(length_m: float) -> int:
    """Return how many joints a chain has, with its tip."""
    return 3 if length_m <= _SHORT_CHAIN_M else 4


def chain_weights(
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


def between_angles(angle_rad: Float[np.ndarray, "v"], chains_rad: Float[np.ndarray, "c"]) -> Float[np.ndarray, "v c"]:
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


def smooth(values: Float[np.ndarray, "v"], mesh: Mesh) -> Float[np.ndarray, "v"]:
    """Return the values after an implicit step of diffusion: weights do not jump where cloth leaves the body.

    An edge of length l counts 1 / l^2, so that the result does not depend on the size of the faces; no value leaves the
    range of the given ones, in [0, 1].
    """
    edges = mesh.edges()
    length_m = np.linalg.norm(mesh.vertices[edges[:, 0]] - mesh.vertices[edges[:, 1]], axis=1).astype(np.float64)
    coupling = adjacency(mesh, (_SMOOTHING_M / np.maximum(length_m, _MIN_EDGE_M)) ** 2)
    degree = np.maximum(adjacency(mesh, np.ones(len(edges))).sum(axis=1), 1.0)
    coupling = sparse.diags_array(4.0 / degree) @ coupling  # a grid of squares has four edges at a vertex
    system = sparse.diags_array(1.0 + coupling.sum(axis=1)) - coupling
    diffused = spsolve(system.tocsc(), values)
    return np.asarray(np.maximum(diffused - _LEAST_SHARE, 0.0) / (1.0 - _LEAST_SHARE))
