"""User-supplied shape and poses, which a fit starts from or keeps."""

from dataclasses import dataclass, replace

import numpy as np
import torch
from jaxtyping import Float, Int
from torch import Tensor

from pipeline.body.fit.camera_parameters import INTRINSICS_COUNT
from pipeline.body.fit.initialisation import interpolated_state
from pipeline.body.fit.landmark_regressor import LANDMARK_OFFSET_COUNT
from pipeline.body.fit.state import FitState
from pipeline.geometry.rotation import continuous_quaternions, matrix_to_quaternion


@dataclass(frozen=True)
class SuppliedPoses:
    """Poses of some frames, for a body of this shape.

    rows: positions of the frames, ascending.
    rotations: local rotations of the first k joints; identity is the A-pose.
    root_m: world positions of the root joint.
    """

    rows: Int[np.ndarray, "r"]
    shape: Float[Tensor, "s"]
    rotations: Float[Tensor, "r k 3 3"]
    root_m: Float[Tensor, "r 3"]

    def to_fit_state(self, active: tuple[int, ...], time_s: Float[Tensor, "n"]) -> FitState:
        """Return the poses of all n frames: the supplied ones, interpolated over time in between, constant outside.

        active: indices of the active joints.

        Raises:
            ValueError: there are no poses.
        """
        if len(self.rows) == 0:
            raise ValueError("no frame has a supplied pose")
        state = FitState(
            self.rotations[:, list(active)].double(),
            self.root_m.double(),
            self.shape.double(),
            torch.zeros(LANDMARK_OFFSET_COUNT, dtype=torch.float64),
            torch.zeros(INTRINSICS_COUNT, dtype=torch.float64),
        )
        return interpolated_state(state, self.rows, time_s)

    def overwrite_poses(self, state: FitState, active: tuple[int, ...]) -> FitState:
        """Return the state with the supplied poses in their frames."""
        rotations, root_m = state.rotations.clone(), state.root_m.clone()
        rotations[self.rows], root_m[self.rows] = self.rotations[:, list(active)].double(), self.root_m.double()
        return replace(state, rotations=rotations, root_m=root_m)

    def overwrite_all_rotations(self, rotations_wxyz: Float[np.ndarray, "n full 4"]) -> Float[np.ndarray, "n full 4"]:
        """Return rotations of all joints, inactive ones included, with the supplied ones in their frames."""
        overwritten = torch.from_numpy(rotations_wxyz).clone()
        overwritten[self.rows, : self.rotations.shape[1]] = matrix_to_quaternion(self.rotations)
        return continuous_quaternions(overwritten).numpy()
