import numpy as np
import pytest

from pipeline.mesh.pose_selection import MotionScores, is_far_from


@pytest.mark.parametrize(
    ("iou", "psnr_db", "is_better"),
    [(0.98, 30.1, True), (0.98, 30.0, True), (0.97, 30.1, False), (0.98, 29.9, False), (0.98, np.nan, False)],
)
def test_outline_must_gain_and_colours_must_not_lose(iou: float, psnr_db: float, is_better: bool) -> None:
    assert MotionScores(iou, psnr_db).is_better_than(MotionScores(0.97, 30.0)) is is_better


def test_frames_beyond_the_reach_of_corrections_are_far() -> None:
    time_s = np.array([0.0, 0.2, 0.6, 1.0, 1.3, 9.0])
    assert is_far_from(time_s, time_s[[0, 3]]).tolist() == [False, False, True, False, True, True]
