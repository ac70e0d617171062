"""Where one part of the person touches another, as hanging arms touch trunk and thighs: nothing is seen between them.

The poses err by about a centimetre, so that the depth test cannot tell which of two surfaces that touch each other a
pixel shows: the trunk would be painted with the skin of an arm, and the palm with the trousers.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
import torch
from jaxtyping import Bool, Float, Int
from scipy.spatial import cKDTree

from pipeline.geometry.mesh import area_weighted_vertex_normals
from pipeline.texture.body_parts import body_part_of_joint, group_weights
from pipeline.texture.views import BakeView

CONTACT_M = 0.04
"""Surfaces of two limbs that face each other this closely hide each other: between them little is seen, at grazing
angles, and poses err by a quarter of it."""
BALL_RADIUS_M, TOUCHING = 0.035, 0.9
"""Radius of a ball that must fit on a surface beside another limb, and the share of it within which a limb is in the
ball: a surface that goes on smoothly is just outside."""
MIN_HAND_WEIGHT = 0.9
"""Skin weight of hand and fingers from which on a vertex belongs to a hand: sleeves end before."""


@dataclass(frozen=True)
class Limbs:
    """The parts of the person that touch each other.

    limb: a number for what moves each vertex: an arm with its hand, or all the rest. Legs wear the same clothes: one
    cannot be mistaken for the other. is_hand: vertices that a hand moves alone, for the most part.
    """

    limb: Int[np.ndarray, "v"]
    is_hand: Bool[np.ndarray, "v"]

    @staticmethod
    def of_vertices(
        joint_indices: Int[np.ndarray, "v k"], joint_weights: Float[np.ndarray, "v k"], joint_names: Sequence[str]
    ) -> "Limbs":
        """Return the limbs of vertices with these skin weights, whose rows sum to 1."""
        parts = [body_part_of_joint(name) for name in joint_names]
        limbs = [part.replace("hand", "arm") if part.endswith(("arm", "hand")) else "rest" for part in parts]
        names = sorted(set(limbs))
        of_joint = np.array([names.index(limb) for limb in limbs])
        weight = group_weights(joint_indices, joint_weights, of_joint, len(names))
        of_hand = np.array([part.endswith("hand") for part in parts])[joint_indices]
        return Limbs(weight.argmax(axis=1), (joint_weights * of_hand).sum(axis=1) > MIN_HAND_WEIGHT)


def touches_other_limb(
    vertices_m: Float[np.ndarray, "v 3"], normals: Float[np.ndarray, "v 3"], limb: Int[np.ndarray, "v"]
) -> Bool[np.ndarray, "v"]:
    """Return the vertices that another limb hides, or may hide where poses err.

    Their nearest vertex of another limb is within `CONTACT_M` and faces them, whichever of both is in front; or another
    limb is in the ball of `BALL_RADIUS_M` that touches them from outside.
    """
    found = np.zeros(len(vertices_m), dtype=bool)
    centres_m = vertices_m + BALL_RADIUS_M * normals
    for other in np.unique(limb):
        rows = np.flatnonzero(limb == other)
        tree, reach_m = cKDTree(vertices_m[rows]), max(CONTACT_M, 2.0 * BALL_RADIUS_M)
        low_m, high_m = tree.mins - reach_m, tree.maxes + reach_m
        near = np.flatnonzero((limb != other) & ((vertices_m > low_m) & (vertices_m < high_m)).all(axis=1))
        bound_m = TOUCHING * BALL_RADIUS_M
        found[near] |= np.isfinite(tree.query(centres_m[near], distance_upper_bound=bound_m)[0])
        distance_m, nearest = tree.query(vertices_m[near], distance_upper_bound=CONTACT_M)
        near, nearest = near[np.isfinite(distance_m)], rows[nearest[np.isfinite(distance_m)]]
        found[near] |= (normals[near] * normals[nearest]).sum(axis=1) < 0.0
    return found


def hide_contacts(view: BakeView, faces: Int[np.ndarray, "f 3"], limb: Int[np.ndarray, "v"]) -> BakeView:
    """Return the view as if vertices that touch another limb in its pose faced away from the camera."""
    normals = area_weighted_vertex_normals(view.vertices_world, torch.from_numpy(faces))
    touching = touches_other_limb(view.vertices_world.numpy(), normals.numpy(), limb)
    return replace(view, view_cosine=torch.where(torch.from_numpy(touching), 0.0, view.view_cosine))
