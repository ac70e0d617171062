"""Choice between two motions, judged by the outline and the colours of the mesh on validation frames."""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Bool, Float
from torch import Tensor

from pipeline.body.pose_correction import TYPICAL_CORRELATION_TIME_S
from pipeline.geometry.mesh import Mesh
from pipeline.mesh.skin_transfer import SkinnedTopology
from pipeline.mesh.views import PosedView, Shader, mesh_psnr_db, silhouette_iou


@dataclass(frozen=True)
class MotionScores:
    """Scores of the mesh in the poses of a motion.

    silhouette_iou: of all validation views together, in [0, 1]. psnr_db: of each view.
    """

    silhouette_iou: float
    psnr_db: Float[np.ndarray, "k"]

    def mean_psnr_db(self) -> float:
        """Return the mean over the views; NaN without views."""
        return float(self.psnr_db.mean()) if len(self.psnr_db) else float("nan")


def score_motion(
    mesh: Mesh,
    skin: SkinnedTopology,
    shader: Shader,
    views: Sequence[PosedView],
    canonical_to_world: Float[Tensor, "k j 4 4"],
) -> MotionScores:
    """Score the mesh in other poses of the views."""
    posed = [replace(view, canonical_to_world=pose) for view, pose in zip(views, canonical_to_world, strict=True)]
    psnr_db = [mesh_psnr_db(mesh, skin, [view], shader) for view in posed]
    return MotionScores(silhouette_iou(mesh, skin, posed), np.array(psnr_db))


def is_better_motion(candidate: MotionScores, present: MotionScores) -> bool:
    """Return whether the candidate's outline fits better and its colours no worse.

    The mean PSNR may fall by its standard error, estimated from the differences of the views: validation frames
    between training frames have good poses already, so their differences are small and of both signs. Without views
    the answer is no.
    """
    gain_db = candidate.psnr_db - present.psnr_db
    standard_error_db = float(gain_db.std(ddof=1)) / len(gain_db) ** 0.5 if len(gain_db) > 1 else 0.0
    has_better_outline = candidate.silhouette_iou > present.silhouette_iou
    return has_better_outline and float(gain_db.mean()) >= -standard_error_db


def is_far_from(time_s: Float[np.ndarray, "n"], known_s: Float[np.ndarray, "k"]) -> Bool[np.ndarray, "n"]:
    """Return which times are farther from all known times than learnt pose corrections reach."""
    return np.abs(time_s[:, None] - known_s).min(axis=1) > TYPICAL_CORRELATION_TIME_S
