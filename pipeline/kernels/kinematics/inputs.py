"""Inputs of forward kinematics. Notation: k frames, j joints."""

from typing import NamedTuple

from jaxtyping import Float, Int
from torch import Tensor


class Skeleton(NamedTuple):
    """Joints of the canonical pose, parents before their children.

    joints_m: canonical positions. parents: -1 for the root. correction_row: row of the joint's correction, -1 for none.
    """

    joints_m: Float[Tensor, "j 3"]
    parents: Int[Tensor, "j"]
    correction_row: Int[Tensor, "j"]


class FittedPoses(NamedTuple):
    """Fitted local rotations and root positions (world), and the rigid transform into each frame's posed space."""

    rotations: Float[Tensor, "k j 3 3"]
    root_m: Float[Tensor, "k 3"]
    world_to_posed: Float[Tensor, "k 4 4"]
