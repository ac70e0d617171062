"""Checkpoint of an unfinished fit: the shared parameters with their uncertainty, and the poses so far."""

from dataclasses import dataclass, field
from pathlib import Path

import torch
from jaxtyping import Float
from torch import Tensor

from pipeline.body.fit.prior.posture import Posture
from pipeline.body.fit.state import FitState
from pipeline.io.tensors import load_tensors, save_tensors


@dataclass(frozen=True)
class FitProgress:
    """A fit whose shared parameters are final, between two matchings of the silhouettes of all frames.

    Attributes:
        state: of all frames.
        posture: of the recording, None if it is not known.
        focal_relative_std, height_std_m: standard deviations from the curvature of the energy, as in `FitResult`.
        rounds_done: number of completed matchings.
        motion_std: `Objective.motion_std` after the last of them; None before the first.
        to_vertical: rotation from the world in which the fit started to that of the state.
    """

    state: FitState
    posture: Posture | None = None
    focal_relative_std: float = 0.0
    height_std_m: float = 0.0
    rounds_done: int = 0
    motion_std: Float[Tensor, "p"] | None = None
    to_vertical: Float[Tensor, "3 3"] = field(default_factory=lambda: torch.eye(3, dtype=torch.float64))


def save_progress(path: Path | None, progress: FitProgress) -> None:
    """Write the progress, complete or not at all; nothing without a path."""
    if path is None:
        return
    tensors = vars(progress.state) | (vars(progress.posture) if progress.posture else {})
    tensors = tensors | {"to_vertical": progress.to_vertical}
    if progress.motion_std is not None:
        tensors = tensors | {"motion_std": progress.motion_std}
    numbers = {name: getattr(progress, name) for name in ("focal_relative_std", "height_std_m", "rounds_done")}
    save_tensors(path, tensors, numbers)


def load_progress(path: Path | None) -> FitProgress | None:
    """Read what `save_progress` wrote; None without a path or a file.

    Raises:
        UserError: the file is damaged.
    """
    if path is None or not path.exists():
        return None
    loaded, numbers = load_tensors(path)
    tensors = {name: tensor.clone() for name, tensor in loaded.items()}  # aligned in memory, as computed ones
    posture = Posture(tensors.pop("mean_rad"), tensors.pop("spread_rad")) if "mean_rad" in tensors else None
    motion_std, to_vertical = tensors.pop("motion_std", None), tensors.pop("to_vertical")
    return FitProgress(FitState(**tensors), posture, motion_std=motion_std, to_vertical=to_vertical, **numbers)
