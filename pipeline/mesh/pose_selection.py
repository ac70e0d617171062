"""Choice between two motions, judged by the outline and the colours of the mesh on validation frames."""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Bool, Float
from torch import Tensor

from pipeline.body.body import Motion
from pipeline.body.pose_correction import TYPICAL_CORRELATION_TIME_S
from pipeline.geometry.mesh import Mesh
from pipeline.mesh.skin_transfer import SkinnedTopology
from pipeline.mesh.views import PosedView, Shader, mesh_psnr_db, silhouette_iou


@dataclass(frozen=True)
class MotionScores:
    """Silhouette IoU (0 to 1) and validation PSNR (dB; NaN without views) of the mesh in the poses of a motion."""

    silhouette_iou: float
    psnr_db: float

    def is_better_than(self, other: "MotionScores") -> bool:
        """Return whether the outline fits better and the colours no worse; False without views."""
        return self.silhouette_iou > other.silhouette_iou and self.psnr_db >= other.psnr_db


def score_motion(
    mesh: Mesh,
    skin: SkinnedTopology,
    shader: Shader,
    views: Sequence[PosedView],
    canonical_to_world: Float[Tensor, "k j 4 4"],
) -> MotionScores:
    """Score the mesh in other poses of the views."""
    posed = in_other_poses(views, canonical_to_world)
    return MotionScores(silhouette_iou(mesh, skin, posed), mesh_psnr_db(mesh, skin, posed, shader))


def in_other_poses(views: Sequence[PosedView], canonical_to_world: Float[Tensor, "k j 4 4"]) -> list[PosedView]:
    """Return the views with other poses."""
    return [replace(view, canonical_to_world=pose) for view, pose in zip(views, canonical_to_world, strict=True)]


def merge_poses(use_first: Bool[np.ndarray, "n"], first: Motion, second: Motion) -> Motion:
    """Return the poses of the first motion in the given frames and those of the second in the others."""
    return second.with_pose(
        np.where(use_first[:, None, None], first.rotations_wxyz, second.rotations_wxyz),
        np.where(use_first[:, None], first.root_translation_m, second.root_translation_m),
    )


def is_far_from(time_s: Float[np.ndarray, "n"], known_s: Float[np.ndarray, "k"]) -> Bool[np.ndarray, "n"]:
    """Return which times are farther from all known times than learnt pose corrections reach."""
    return np.abs(time_s[:, None] - known_s).min(axis=1) > TYPICAL_CORRELATION_TIME_S
