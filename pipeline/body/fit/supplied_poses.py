"""Shape and poses that others fitted to the recording, in the form in which a fit starts from them or keeps them."""

from dataclasses import dataclass, replace

import numpy as np
import torch
from jaxtyping import Float, Int
from torch import Tensor

from pipeline.body.fit.camera_parameters import INTRINSICS_COUNT
from pipeline.body.fit.energy import FitState
from pipeline.body.fit.initialisation import interpolated_state
from pipeline.body.fit.landmark_regressor import LANDMARK_OFFSET_COUNT
from pipeline.geometry.rotation import continuous_quaternions, matrix_to_quaternion


@dataclass(frozen=True)
class SuppliedPoses:
    """Poses of the frames `rows` (positions, rising) for a body of this shape: local rotations of its first k joints,
    and where its root joint is in the world (m)."""

    rows: Int[np.ndarray, "r"]
    shape: Float[Tensor, "s"]
    rotations: Float[Tensor, "r k 3 3"]
    root_m: Float[Tensor, "r 3"]

    def state(self, active: tuple[int, ...], time_s: Float[Tensor, "n"]) -> FitState:
        """The poses of all n frames: the given ones, and in between by time; `active` are the joints that a fit moves.

        Raises ValueError when no frame has a pose.
        """
        if len(self.rows) == 0:
            raise ValueError("no frame has a pose")
        state = FitState(
            self.rotations[:, list(active)].double(),
            self.root_m.double(),
            self.shape.double(),
            torch.zeros(LANDMARK_OFFSET_COUNT, dtype=torch.float64),
            torch.zeros(INTRINSICS_COUNT, dtype=torch.float64),
        )
        return interpolated_state(state, self.rows, time_s)

    def overwrite_poses(self, state: FitState, active: tuple[int, ...]) -> FitState:
        """A state with the given poses in their frames."""
        rotations, root_m = state.rotations.clone(), state.root_m.clone()
        rotations[self.rows], root_m[self.rows] = self.rotations[:, list(active)].double(), self.root_m.double()
        return replace(state, rotations=rotations, root_m=root_m)

    def overwrite_all_rotations(self, rotations_wxyz: Float[np.ndarray, "n full 4"]) -> Float[np.ndarray, "n full 4"]:
        """Rotations of all joints with the given ones in their frames, those of joints that no fit moves too."""
        whole = torch.from_numpy(rotations_wxyz).clone()
        whole[self.rows, : self.rotations.shape[1]] = matrix_to_quaternion(self.rotations)
        return continuous_quaternions(whole).numpy()
