"""The BVH reader on a file with known rotations, on damaged and on real files."""

from pathlib import Path

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from pipeline.core.errors import UserError
from pipeline.io.bvh import MAX_FRAMES, BvhMotion, read_bvh, write_bvh

ARM = """HIERARCHY
ROOT Hips
{
  OFFSET 0.0 1.0 0.0
  CHANNELS 6 Xposition Yposition Zposition Zrotation Xrotation Yrotation
  JOINT LeftArm
  {
    OFFSET 2.0 0.0 0.0
    CHANNELS 3 Yrotation Xrotation Zrotation
    JOINT LeftHand
    {
      OFFSET 0.0 3.0 0.0
      CHANNELS 3 Zrotation Xrotation Yrotation
      End Site
      {
        OFFSET 0.0 0.5 0.0
      }
    }
  }
}
MOTION
Frames: 2
Frame Time: 0.04
0 1 0  0 0 0  0 0 0  0 0 0
5 6 7  10 20 30  40 50 60  -5 -15 25
"""


@pytest.fixture
def bvh_motion(tmp_path: Path) -> BvhMotion:
    (tmp_path / "arm.bvh").write_text(ARM)
    return read_bvh(tmp_path / "arm.bvh")


def test_skeleton(bvh_motion: BvhMotion) -> None:
    assert bvh_motion.joint_names == ("Hips", "LeftArm", "LeftHand", "LeftHand_end")
    assert bvh_motion.parents.tolist() == [-1, 0, 1, 2]
    assert bvh_motion.offsets.tolist() == [[0, 1, 0], [2, 0, 0], [0, 3, 0], [0, 0.5, 0]]
    assert bvh_motion.fps == pytest.approx(25.0)
    assert bvh_motion.root_positions.tolist() == [[0, 1, 0], [5, 6, 7]]


def test_rotations_compose_in_channel_order(bvh_motion: BvhMotion) -> None:
    """Intrinsic Euler angles, as capital letters in scipy."""
    assert np.allclose(bvh_motion.rotations[0], np.eye(3))
    expected = [("ZXY", (10, 20, 30)), ("YXZ", (40, 50, 60)), ("ZXY", (-5, -15, 25))]
    for joint, (order, angles) in enumerate(expected):
        slow = Rotation.from_euler(order, angles, degrees=True).as_matrix()
        assert np.allclose(bvh_motion.rotations[1, joint], slow, atol=1e-12)


def test_positions_of_the_rest_pose_are_summed_offsets(bvh_motion: BvhMotion) -> None:
    _, positions = bvh_motion.forward_kinematics(bvh_motion.rotations[:1])
    assert np.allclose(positions[0], [[0, 0, 0], [2, 0, 0], [2, 3, 0], [2, 3.5, 0]])


def test_bones_keep_their_length_and_rotate_with_their_parents(bvh_motion: BvhMotion) -> None:
    world, positions = bvh_motion.forward_kinematics(bvh_motion.rotations)
    lengths = np.linalg.norm(np.diff(positions[1], axis=0), axis=1)
    assert np.allclose(lengths, [2.0, 3.0, 0.5])
    hips, arm, hand = bvh_motion.rotations[1, :3]
    assert np.allclose(world[1, 2], hips @ arm @ hand)
    assert np.allclose(positions[1, 2] - positions[1, 1], hips @ arm @ [0, 3, 0])


@pytest.mark.parametrize(
    "text", ["", "HIERARCHY", ARM.split("MOTION")[0], ARM[: ARM.index("5 6 7") + 10], ARM.replace("30", "thirty")]
)
def test_damaged_files_are_errors(text: str, tmp_path: Path) -> None:
    (tmp_path / "damaged.bvh").write_text(text)
    with pytest.raises(UserError, match="damaged.bvh is not a complete BVH"):
        read_bvh(tmp_path / "damaged.bvh")


def test_missing_file_is_an_error(tmp_path: Path) -> None:
    with pytest.raises(UserError, match="does not exist"):
        read_bvh(tmp_path / "none.bvh")
    with pytest.raises(UserError, match="is a folder; choose a .bvh file in it"):
        read_bvh(tmp_path)


@pytest.mark.parametrize(
    ("name", "frames", "fps"),
    [("cmu1_jumping_jacks", 125, 30.0), ("fair1_zombie", 779, 30.0), ("rokoko_jesse_dance", 1007, 100.0)],
)
def test_real_files(name: str, frames: int, fps: float, shared_data: Path) -> None:
    bvh_motion = read_bvh(shared_data / "motions" / f"{name}.bvh")
    assert len(bvh_motion.rotations) == frames
    assert bvh_motion.fps == pytest.approx(fps, rel=1e-3)
    assert np.allclose(bvh_motion.rotations @ bvh_motion.rotations.transpose(0, 1, 3, 2), np.eye(3), atol=1e-9)


def test_what_is_written_is_read_back(bvh_motion: BvhMotion, tmp_path: Path) -> None:
    write_bvh(tmp_path / "again.bvh", bvh_motion)
    again = read_bvh(tmp_path / "again.bvh")
    assert again.joint_names == bvh_motion.joint_names
    assert again.parents.tolist() == bvh_motion.parents.tolist()
    assert again.fps == pytest.approx(bvh_motion.fps, rel=1e-6)
    np.testing.assert_allclose(again.offsets, bvh_motion.offsets, atol=1e-6)
    np.testing.assert_allclose(again.rotations, bvh_motion.rotations, atol=1e-7)
    np.testing.assert_allclose(again.root_positions, bvh_motion.root_positions, atol=1e-6)


def test_position_channels_of_children_move_them(tmp_path: Path) -> None:
    """Expected by hand: the root at (5, 6, 7) turns its child, at (1, 2, 3), by 90 degrees about z."""
    six = ARM.replace("CHANNELS 3 Yrotation", "CHANNELS 5 Xposition Zposition Yrotation")
    six = six[: six.index("0 1 0  0 0 0")] + "0 1 0  0 0 0  2 0 0 0 0  0 0 0\n5 6 7  90 0 0  1 3 0 0 0  0 0 0\n"
    (tmp_path / "six.bvh").write_text(six.replace("OFFSET 2.0 0.0 0.0", "OFFSET 2.0 2.0 0.0"))
    read = read_bvh(tmp_path / "six.bvh")
    assert read.child_positions[1].tolist() == [[2, 2, 0], [1, 2, 3]]
    np.testing.assert_allclose(read.trajectory(1), [[2, 3, 0], [3, 7, 10]], atol=1e-12)
    np.testing.assert_allclose(read.trajectory(2), [[2, 6, 0], [0, 7, 10]], atol=1e-12)
    write_bvh(tmp_path / "again.bvh", read)
    np.testing.assert_allclose(read_bvh(tmp_path / "again.bvh").trajectory(2), read.trajectory(2), atol=1e-5)


def test_joints_are_written_depth_first_and_get_an_end_site(tmp_path: Path) -> None:
    """The second child of the root comes after the descendants of the first."""
    rotations = Rotation.from_euler("XYZ", np.arange(12.0).reshape(4, 3), degrees=True).as_matrix()[None]
    offsets = np.array([[0.0, 1, 0], [2, 0, 0], [0, 4, 0], [6, 0, 0]])
    motion = BvhMotion(("Root", "A", "B", "A1"), np.array([-1, 0, 0, 1]), offsets, rotations, np.zeros((1, 3)), 30.0)
    write_bvh(tmp_path / "tree.bvh", motion)
    read = read_bvh(tmp_path / "tree.bvh")
    assert read.joint_names == ("Root", "A", "A1", "A1_end", "B", "B_end")
    assert read.offsets[[3, 5]].tolist() == [[3, 0, 0], [0, 2, 0]]
    np.testing.assert_allclose(read.rotations[0, [0, 1, 4, 2]], rotations[0], atol=1e-7)


@pytest.mark.parametrize(
    ("change", "words"),
    [
        (("Frames: 2", "Frames: 10000000"), f"10000000 frames; supply a clip of 1 to {MAX_FRAMES}"),
        (("Frames: 2", "Frames: 0"), "0 frames"),
        (("Time: 0.04", "Time: 0"), "not a complete BVH"),
        (("5 6 7", "5 nan 7"), "not finite"),
    ],
)
def test_unusable_clips_are_errors(change: tuple[str, str], words: str, tmp_path: Path) -> None:
    (tmp_path / "bad.bvh").write_text(ARM.replace(*change))
    with pytest.raises(UserError, match=rf"bad\.bvh.*{words}"):
        read_bvh(tmp_path / "bad.bvh")
