import numpy as np
import pytest

from pipeline.body.body import Motion
from pipeline.mesh.pose_selection import MotionScores, is_far_from, merge_poses


@pytest.mark.parametrize(
    ("iou", "psnr_db", "is_better"),
    [(0.98, 30.1, True), (0.98, 30.0, True), (0.97, 30.1, False), (0.98, 29.9, False), (0.98, np.nan, False)],
)
def test_outline_must_gain_and_colours_must_not_lose(iou: float, psnr_db: float, is_better: bool) -> None:
    assert MotionScores(iou, psnr_db).is_better_than(MotionScores(0.97, 30.0)) is is_better


def test_frames_beyond_the_reach_of_corrections_are_far() -> None:
    time_s = np.array([0.0, 0.2, 0.6, 1.0, 1.3, 9.0])
    assert is_far_from(time_s, time_s[[0, 3]]).tolist() == [False, False, True, False, True, True]


def test_poses_are_taken_from_the_first_motion_where_asked() -> None:
    index = np.arange(3)
    first, second = (
        Motion(index, index / 10.0, np.full((3, 2, 4), value, np.float32), np.full((3, 3), value, np.float32))
        for value in (1.0, 2.0)
    )
    chosen = merge_poses(np.array([False, True, False]), first, second)
    assert chosen.root_translation_m[:, 0].tolist() == chosen.rotations_wxyz[:, 1, 3].tolist() == [2.0, 1.0, 2.0]
