import numpy as np
import pytest

from pipeline.mesh.pose_selection import MotionScores, is_better_motion, is_far_from

PRESENT = MotionScores(0.97, np.array([28.0, 29.0, 30.0, 31.0]))


@pytest.mark.parametrize(
    ("iou", "gain_db", "is_better"),
    [
        (0.98, [0.3, 0.1, 0.2, 0.0], True),
        (0.97, [0.3, 0.1, 0.2, 0.0], False),
        (0.98, [-0.3, -0.1, -0.2, -0.2], False),
        # The mean is -0.05 dB, its standard error 0.13 dB.
        (0.98, [-0.3, 0.2, -0.2, 0.1], True),
    ],
)
def test_outline_must_gain_and_colours_must_not_lose(iou: float, gain_db: list[float], is_better: bool) -> None:
    assert is_better_motion(MotionScores(iou, PRESENT.psnr_db + gain_db), PRESENT) is is_better


def test_one_view_has_no_noise_and_no_view_no_answer() -> None:
    one, none = MotionScores(0.9, np.array([30.0])), MotionScores(0.0, np.zeros(0))
    assert is_better_motion(MotionScores(0.91, np.array([30.0])), one)
    assert not is_better_motion(MotionScores(0.91, np.array([29.9])), one)
    assert not is_better_motion(none, none)
    assert np.isnan(none.mean_psnr_db())


def test_frames_beyond_the_reach_of_corrections_are_far() -> None:
    time_s = np.array([0.0, 0.2, 0.6, 1.0, 1.3, 9.0])
    assert is_far_from(time_s, time_s[[0, 3]]).tolist() == [False, False, True, False, True, True]
