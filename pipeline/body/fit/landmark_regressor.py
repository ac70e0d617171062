"""Positions of the detector's landmarks on the body.

First BlazePose's 33 landmarks (Bazarevsky et al., "BlazePose: On-device real-time body pose tracking", 2020, figure 3),
then some landmarks of each hand and of the face, which other models detect (`pipeline.capture.hand_detector`,
`pipeline.capture.face_detector`).
"""

from dataclasses import dataclass

import torch
from jaxtyping import Float
from torch import Tensor

from pipeline.body.fit.linear_body import ACTIVE_JOINTS, LinearBody
from pipeline.body.fit.posed_points import SkinnedPoints

POSE_LANDMARK_COUNT = 33


@dataclass(frozen=True)
class Landmark:
    """A central landmark, or a left one and its mirror image. Its position is in `ParametricBody.landmark_positions_m`.

    indices: of the left and the right landmark.
    parent_joint: the joint that it moves with.
    reference_joint: the joint from which its offset is measured; None: the nearest vertex. Bodies without this joint
        use `parent_joint`.
    std_ratio: standard deviation of its detection over the typical one.
    offset_std_ratio: standard deviation of its position on the body over the typical one.
    """

    name: str
    indices: tuple[int, ...]
    parent_joint: str
    reference_joint: str | None
    std_ratio: float
    offset_std_ratio: float = 1.0


FACE_OFFSET_RATIO = 0.3
"""The corners of eyes and mouth are exact points of the body; people's faces differ by some millimetres."""

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
    Landmark("face_eye_outer", (41, 42), "Head", None, 1.0, FACE_OFFSET_RATIO),
    Landmark("face_eye_inner", (43, 44), "Head", None, 1.0, FACE_OFFSET_RATIO),
    Landmark("face_mouth", (45, 46), "Head", None, 1.0, FACE_OFFSET_RATIO),
    Landmark("face_nose", (47,), "Head", None, 1.0, FACE_OFFSET_RATIO),
    Landmark("face_bridge", (48,), "Head", None, 1.0, FACE_OFFSET_RATIO),
)

FACE_MESH_START, LANDMARK_COUNT = 41, 49
"""Index of the first landmark of the face detector, and number of all landmarks."""

HAND_LANDMARKS = (0, 2, 5, 17)
"""Hand landmarks used after the pose landmarks, left and right alternating: those that finger flexion does not move."""

LANDMARK_OFFSET_COUNT = 3 * len(LANDMARKS)
"""Offsets of the landmarks on the body for one recording: x, y, z for each `Landmark`, mirrored for the right one."""

LEFT_RIGHT_PAIRS = tuple(landmark.indices for landmark in LANDMARKS if len(landmark.indices) == 2)

SWAP_PAIR_GROUPS = {
    "arms": tuple(
        pair for pair in LEFT_RIGHT_PAIRS if 13 <= pair[0] <= 21 or POSE_LANDMARK_COUNT <= pair[0] < FACE_MESH_START
    ),
    "legs": tuple(pair for pair in LEFT_RIGHT_PAIRS if 25 <= pair[0] < POSE_LANDMARK_COUNT),
    "whole body": tuple(pair for pair in LEFT_RIGHT_PAIRS if pair[0] < FACE_MESH_START),
}
"""Pairs of landmarks that the pose detector swaps together; the face detector does not swap the sides of a face."""


def mirror_permutation(pairs: tuple[tuple[int, ...], ...]) -> list[int]:
    """Return the order of the landmarks with left and right swapped in these pairs."""
    order = list(range(LANDMARK_COUNT))
    for left, right in pairs:
        order[left], order[right] = right, left
    return order


def landmark_std_ratio() -> Float[Tensor, "l"]:
    """Return the standard deviation of each landmark over the typical one."""
    std_ratio = torch.ones(LANDMARK_COUNT, dtype=torch.float64)
    for landmark in LANDMARKS:
        std_ratio[list(landmark.indices)] = landmark.std_ratio
    return std_ratio


def landmark_offset_std_ratio() -> Float[Tensor, "o"]:
    """Return the standard deviation of each landmark offset over the typical one."""
    ratios = torch.tensor([landmark.offset_std_ratio for landmark in LANDMARKS], dtype=torch.float64)
    return ratios.repeat_interleave(3)


@dataclass(frozen=True)
class LandmarkRegressor:
    """Each landmark as a joint or vertex of the body, or the canonical origin, plus a constant offset.

    reference_joint, reference_vertex: None where the other one, or the origin, is used.
    offset_jacobian: derivative of the positions with respect to the landmark offsets.
    """

    reference_joint: tuple[int | None, ...]
    reference_vertex: tuple[int | None, ...]
    offset_m: Float[Tensor, "l 3"]
    skin_weights: Float[Tensor, "l j"]
    offset_jacobian: Float[Tensor, "l 3 o"]

    def points(self, model: LinearBody, landmark_offsets_m: Float[Tensor, "o"]) -> SkinnedPoints:
        """Return the landmarks on a rest body; their shape axis is body shape, then landmark offsets."""
        positions, derivatives = [], []
        for joint, vertex in zip(self.reference_joint, self.reference_vertex, strict=True):
            if joint is not None:
                positions.append(model.full_joints_m[joint])
                derivatives.append(model.full_joints_shape_jacobian[joint])
            elif vertex is not None:
                positions.append(model.vertices_m[vertex])
                derivatives.append(model.vertices_shape_jacobian[vertex])
            else:
                positions.append(self.offset_m.new_zeros(3))
                derivatives.append(self.offset_m.new_zeros(3, len(model.shape)))
        rest = torch.stack(positions) + self.offset_m + self.offset_jacobian @ landmark_offsets_m
        shape_jacobian = torch.cat([torch.stack(derivatives), self.offset_jacobian], dim=-1)
        return SkinnedPoints(rest[None], self.skin_weights[None], shape_jacobian[None])


def landmark_regressor(default: LinearBody) -> LandmarkRegressor:
    """Return the regressor of a body, from the landmark positions on its default shape."""
    joints: list[int | None] = [None] * LANDMARK_COUNT
    vertices: list[int | None] = [None] * LANDMARK_COUNT
    offset = torch.zeros(LANDMARK_COUNT, 3, dtype=torch.float64)
    skin_weights = torch.zeros(LANDMARK_COUNT, len(ACTIVE_JOINTS), dtype=torch.float64)
    offset_jacobian = torch.zeros(LANDMARK_COUNT, 3, LANDMARK_OFFSET_COUNT, dtype=torch.float64)
    for row, landmark in enumerate(LANDMARKS):
        for side, index in enumerate(landmark.indices):
            mirror = torch.tensor([-1.0 if side else 1.0, 1.0, 1.0], dtype=torch.float64)
            position = torch.tensor(default.landmark_positions_m[landmark.name], dtype=torch.float64) * mirror
            parent_joint = _on_side(landmark.parent_joint, side)
            if landmark.reference_joint is None:
                vertices[index] = int((default.vertices_m - position).norm(dim=1).argmin())
                reference = default.vertices_m[vertices[index]]
            else:
                joints[index] = default.joint_index_by_name.get(
                    _on_side(landmark.reference_joint, side), default.joint_index_by_name[parent_joint]
                )
                reference = default.full_joints_m[joints[index]]
            offset[index] = position - reference
            skin_weights[index, ACTIVE_JOINTS.index(parent_joint)] = 1.0
            offset_jacobian[index, :, 3 * row : 3 * row + 3] = torch.diag(mirror)
    return LandmarkRegressor(tuple(joints), tuple(vertices), offset, skin_weights, offset_jacobian)


def _on_side(name: str, side: int) -> str:
    """Return the name of a joint on one side; side: 0 for left or centre, 1 for right."""
    return name.replace("Left", "Right") if side else name
