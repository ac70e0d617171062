"""Landmarks as places on the body: where the detector's "left hip" lies on the skeleton.

First BlazePose's 33 (Bazarevsky et al., "BlazePose: On-device real-time body pose tracking", 2020, figure 3), then some
points of each hand, seen by a model of their own (`hands.py`).
"""

from dataclasses import dataclass

import torch
from jaxtyping import Float
from torch import Tensor

from pipeline.body.fit.linear_body import ACTIVE_JOINTS, LinearBody, SkinnedPoints

POSE_LANDMARK_COUNT = 33


@dataclass(frozen=True)
class Landmark:
    """One left or central landmark.

    `carrier` is the joint it moves with; `anchor` the joint it is measured from (None: the nearest point of the
    surface; the carrier where a body has no such joint). `noise` scales the detector's usual error. Where it lies is
    told by each body (`ParametricBody.landmark_positions_m`).
    """

    name: str
    indices: tuple[int, ...]
    carrier: str
    anchor: str | None
    noise: float


# The right landmark mirrors the left one: x changes sign, "Left" becomes "Right".
LANDMARKS = (
    Landmark("nose", (0,), "Head", None, 0.8),
    Landmark("eye_inner", (1, 4), "Head", None, 0.8),
    Landmark("eye", (2, 5), "Head", None, 0.8),
    Landmark("eye_outer", (3, 6), "Head", None, 0.8),
    Landmark("ear", (7, 8), "Head", None, 1.0),
    Landmark("mouth", (9, 10), "Head", None, 0.8),
    Landmark("shoulder", (11, 12), "LeftShoulder", "LeftArm", 1.0),
    Landmark("elbow", (13, 14), "LeftArm", "LeftForeArm", 1.0),
    Landmark("wrist", (15, 16), "LeftForeArm", "LeftHand", 1.0),
    Landmark("pinky", (17, 18), "LeftHand", "LeftHandPinky1", 1.5),
    Landmark("index", (19, 20), "LeftHand", "LeftHandIndex1", 1.5),
    Landmark("thumb", (21, 22), "LeftHand", "LeftHandThumb2", 1.5),
    Landmark("hip", (23, 24), "Hips", "LeftUpLeg", 1.2),
    Landmark("knee", (25, 26), "LeftUpLeg", "LeftLeg", 1.0),
    Landmark("ankle", (27, 28), "LeftLeg", "LeftFoot", 1.0),
    Landmark("heel", (29, 30), "LeftFoot", "LeftFoot", 1.3),
    Landmark("foot_index", (31, 32), "LeftFoot", "LeftToeBase", 1.3),
    Landmark("hand_wrist", (33, 34), "LeftHand", "LeftHand", 1.0),
    Landmark("hand_thumb", (35, 36), "LeftHand", "LeftHandThumb2", 1.0),
    Landmark("hand_index", (37, 38), "LeftHand", "LeftHandIndex1", 1.0),
    Landmark("hand_pinky", (39, 40), "LeftHand", "LeftHandPinky1", 1.0),
)

LANDMARK_COUNT = 41

HAND_LANDMARKS = (0, 2, 5, 17)
"""The points of a hand that follow the pose's landmarks, left and right in turn: those that fingers do not move."""

LANDMARK_OFFSET_COUNT = 3 * len(LANDMARKS)
"""Numbers that shift the landmarks on the body for one video: x, y, z a `Landmark`, mirrored for the right one."""

LEFT_RIGHT_PAIRS = tuple(landmark.indices for landmark in LANDMARKS if len(landmark.indices) == 2)

SWAP_PAIR_GROUPS = {
    "arms": tuple(pair for pair in LEFT_RIGHT_PAIRS if 13 <= pair[0] <= 21 or pair[0] >= POSE_LANDMARK_COUNT),
    "legs": tuple(pair for pair in LEFT_RIGHT_PAIRS if 25 <= pair[0] < POSE_LANDMARK_COUNT),
    "whole body": LEFT_RIGHT_PAIRS,
}
"""Pairs that the detector confuses together."""


def mirror_permutation(pairs: tuple[tuple[int, ...], ...]) -> list[int]:
    """Order of the landmarks with left and right exchanged in the given pairs."""
    order = list(range(LANDMARK_COUNT))
    for left, right in pairs:
        order[left], order[right] = right, left
    return order


def landmark_std_ratio() -> Float[Tensor, "l"]:
    """Each landmark's usual error relative to the detector's typical one."""
    noise = torch.ones(LANDMARK_COUNT, dtype=torch.float64)
    for landmark in LANDMARKS:
        noise[list(landmark.indices)] = landmark.noise
    return noise


@dataclass(frozen=True)
class LandmarkRegressor:
    """Landmarks as a joint or a vertex each, plus a fixed shift; made once, on the default shape."""

    anchor_joint: tuple[int | None, ...]
    anchor_vertex: tuple[int | None, ...]
    shift_m: Float[Tensor, "l 3"]
    carrier: Float[Tensor, "l j"]
    offset_jacobian: Float[Tensor, "l 3 o"]

    def points(self, model: LinearBody, landmark_offsets_m: Float[Tensor, "o"]) -> SkinnedPoints:
        """The landmarks on a rest body; the shape axis is the body's shape followed by the offsets."""
        places, derivatives = [], []
        for joint, vertex in zip(self.anchor_joint, self.anchor_vertex, strict=True):
            if joint is not None:
                places.append(model.full_joints[joint])
                derivatives.append(model.full_joints_shape_jacobian[joint])
            else:
                places.append(model.vertices[vertex])
                derivatives.append(model.vertices_shape_jacobian[vertex])
        rest = torch.stack(places) + self.shift_m + self.offset_jacobian @ landmark_offsets_m
        shape_jacobian = torch.cat([torch.stack(derivatives), self.offset_jacobian], dim=-1)
        return SkinnedPoints(rest[None], self.carrier[None], shape_jacobian[None])


def landmark_regressor(default: LinearBody) -> LandmarkRegressor:
    """Tie a body's landmark places to joints and vertices of its default shape."""
    joints: list[int | None] = [None] * LANDMARK_COUNT
    vertices: list[int | None] = [None] * LANDMARK_COUNT
    shift = torch.zeros(LANDMARK_COUNT, 3, dtype=torch.float64)
    carrier = torch.zeros(LANDMARK_COUNT, len(ACTIVE_JOINTS), dtype=torch.float64)
    offset_jacobian = torch.zeros(LANDMARK_COUNT, 3, LANDMARK_OFFSET_COUNT, dtype=torch.float64)
    for row, landmark in enumerate(LANDMARKS):
        for side, index in enumerate(landmark.indices):
            mirror = torch.tensor([-1.0 if side else 1.0, 1.0, 1.0], dtype=torch.float64)
            place = torch.tensor(default.landmark_positions_m[landmark.name], dtype=torch.float64) * mirror
            if landmark.anchor is None:
                vertices[index] = int((default.vertices - place).norm(dim=1).argmin())
                anchor = default.vertices[vertices[index]]
            else:
                carrier_index = default.joint_index_by_name[_on_side(landmark.carrier, side)]
                joints[index] = default.joint_index_by_name.get(_on_side(landmark.anchor, side), carrier_index)
                anchor = default.full_joints[joints[index]]
            shift[index] = place - anchor
            carrier[index, ACTIVE_JOINTS.index(_on_side(landmark.carrier, side))] = 1.0
            offset_jacobian[index, :, 3 * row : 3 * row + 3] = torch.diag(mirror)
    return LandmarkRegressor(tuple(joints), tuple(vertices), shift, carrier, offset_jacobian)


def _on_side(name: str, side: int) -> str:
    return name.replace("Left", "Right") if side else name
