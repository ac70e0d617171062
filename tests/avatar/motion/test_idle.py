"""The idle clip: it repeats, breathes, and its feet stand."""

import numpy as np

from pipeline.avatar.motion.feet import joint_positions_m, lowest_foot_offset_m
from pipeline.avatar.motion.idle import BREATHS, idle_motion
from pipeline.body.body import Body
from tests.avatar.avatar_sample import sample_body


def test_it_ends_as_it_begins_and_the_feet_stand(bare: Body) -> None:
    motion = idle_motion(bare, 0.0)
    joints = joint_positions_m(bare, motion)
    np.testing.assert_allclose(joints[-1], joints[0], atol=1e-5)
    speed_m_s = np.linalg.norm(np.diff(joints, axis=0), axis=2) / np.diff(motion.time_s)[:, None]
    feet = [bare.joint(side + part) for side in ("Left", "Right") for part in ("Foot", "ToeBase")]
    assert speed_m_s[:, feet].max() < 1e-3
    assert speed_m_s.max() < 0.05
    np.testing.assert_allclose(lowest_foot_offset_m(bare, motion), 0.0, atol=1e-5)


def test_shoulders_rise_with_every_breath_and_arms_hang(bare: Body) -> None:
    motion = idle_motion(bare, 0.0)
    joints = joint_positions_m(bare, motion)
    height_m = joints[:, bare.joint("LeftArm"), 1] + joints[:, bare.joint("RightArm"), 1]
    rises = np.flatnonzero((height_m[1:-1] > height_m[:-2]) & (height_m[1:-1] >= height_m[2:]))
    assert len(rises) == BREATHS
    assert 0.004 < np.ptp(height_m) / 2 < 0.03
    for side, outward in (("Left", 1.0), ("Right", -1.0)):
        arm = joints[:, bare.joint(f"{side}ForeArm")] - joints[:, bare.joint(f"{side}Arm")]
        assert (arm[:, 1] < -0.8 * np.linalg.norm(arm, axis=1)).all()
        assert (
            outward * joints[:, bare.joint(f"{side}Hand"), 0] > outward * joints[:, bare.joint(f"{side}UpLeg"), 0]
        ).all()


def test_a_skeleton_without_arms_and_legs_has_one_too() -> None:
    motion = idle_motion(sample_body(), 0.0)
    assert np.ptp(motion.rotations_wxyz, axis=0).max() > 1e-3
