"""Unknowns and observations of a fit.

Dimensions: n frames, j active joints (`pipeline.body.fit.linear_body.ACTIVE_JOINTS`), l landmarks, s shape parameters,
o landmark offset parameters, p = 3 j + 3 parameters of a frame, g shared parameters.
"""

from dataclasses import dataclass, replace

import numpy as np
import torch
from jaxtyping import Float, Int
from torch import Tensor

from pipeline.body.fit.camera_parameters import INTRINSICS_COUNT
from pipeline.body.fit.root_placement import perspective_to_world, world_to_perspective
from pipeline.geometry.camera import Camera
from pipeline.geometry.rotation import axis_angle_to_matrix


@dataclass(frozen=True)
class FitState:
    """Unknowns of the fit, float64.

    rotations: local rotations; identity is the A-pose.
    root_m: world positions of the root joint.
    landmark_offsets_m: as in `pipeline.body.fit.landmark_regressor`.
    intrinsics_delta: as in `pipeline.body.fit.camera_parameters`.
    """

    rotations: Float[Tensor, "n j 3 3"]
    root_m: Float[Tensor, "n 3"]
    shape: Float[Tensor, "s"]
    landmark_offsets_m: Float[Tensor, "o"]
    intrinsics_delta: Float[Tensor, "3"]

    def retract(self, frame_step: Float[Tensor, "n p"], shared_step: Float[Tensor, "g"], camera: Camera) -> "FitState":
        """Return the state after a step.

        frame_step: rotation vectors of the joints (rad, applied in the parent's frame), then the step of the root in
            perspective coordinates (`pipeline.body.fit.root_placement`).
        shared_step: steps of shape, landmark offsets and intrinsics; an empty tensor keeps them.
        """
        step_rotations = axis_angle_to_matrix(frame_step[:, :-3].reshape(*self.rotations.shape[:2], 3))
        root_perspective = world_to_perspective(self.root_m, camera) + frame_step[:, -3:]
        updated = replace(
            self, rotations=step_rotations @ self.rotations, root_m=perspective_to_world(root_perspective, camera)
        )
        if len(shared_step) == 0:
            return updated
        shape_count = len(self.shape)
        return replace(
            updated,
            shape=self.shape + shared_step[:shape_count],
            landmark_offsets_m=self.landmark_offsets_m + shared_step[shape_count:-INTRINSICS_COUNT],
            intrinsics_delta=self.intrinsics_delta + shared_step[-INTRINSICS_COUNT:],
        )

    def shared_parameters(self) -> Float[Tensor, "g"]:
        """Return shape, landmark offsets and intrinsics, in the order of a shared step."""
        return torch.cat([self.shape, self.landmark_offsets_m, self.intrinsics_delta])

    def select(self, rows: Int[np.ndarray, "k"] | slice) -> "FitState":
        """Return the state with the poses of the selected frames."""
        return replace(self, rotations=self.rotations[rows], root_m=self.root_m[rows])


@dataclass(frozen=True)
class Observations:
    """Detected landmarks. No value is nan; missing landmarks have confidence 0.

    landmarks_3d_m: relative to the middle of the hips, of unknown overall scale, in world axes as if the person were on
        the optical axis: in truth they are relative to the line of sight (`pipeline.body.fit.detections.landmarks_3d`).
    confidence, confidence_3d: of `landmarks_px` and `landmarks_3d_m`, in [0, 1].
    camera: the camera at which the fit starts.
    """

    time_s: Float[Tensor, "n"]
    landmarks_px: Float[Tensor, "n l 2"]
    landmarks_3d_m: Float[Tensor, "n l 3"]
    confidence: Float[Tensor, "n l"]
    confidence_3d: Float[Tensor, "n l"]
    camera: Camera

    def select(self, rows: Int[np.ndarray, "k"] | slice) -> "Observations":
        """Return the observations of the selected frames."""
        return replace(
            self,
            time_s=self.time_s[rows],
            landmarks_px=self.landmarks_px[rows],
            landmarks_3d_m=self.landmarks_3d_m[rows],
            confidence=self.confidence[rows],
            confidence_3d=self.confidence_3d[rows],
        )
