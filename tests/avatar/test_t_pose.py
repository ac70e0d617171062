"""The T-pose of the built-in body, by the definitions of VRM's specification."""

import numpy as np
import pytest

from pipeline.avatar.t_pose import t_pose_transforms
from tests.avatar.formats.anny_avatar import anny_body


def t_pose() -> tuple[np.ndarray, np.ndarray]:
    body = anny_body()
    transforms = t_pose_transforms(body.joint_names, body.parents, body.joints_m)
    joints_m = np.einsum("jab,jb->ja", transforms[:, :3, :3], body.joints_m) + transforms[:, :3, 3]
    return transforms, joints_m


def direction(start: str, end: str) -> np.ndarray:
    body, (_, joints_m) = anny_body(), t_pose()
    bone = joints_m[body.joint(end)] - joints_m[body.joint(start)]
    return bone / np.linalg.norm(bone)


@pytest.mark.parametrize(("side", "out"), [("Left", 1.0), ("Right", -1.0)])
def test_bones_have_the_directions_of_the_specification(side: str, out: float) -> None:
    along_x = [("Arm", "ForeArm"), ("ForeArm", "Hand"), ("HandIndex1", "HandIndex2"), ("HandPinky2", "HandPinky3")]
    for start, end in along_x:
        np.testing.assert_allclose(direction(side + start, side + end), [out, 0, 0], atol=1e-6)
    for start, end in [("UpLeg", "Leg"), ("Leg", "Foot")]:
        np.testing.assert_allclose(direction(side + start, side + end), [0, -1, 0], atol=1e-6)
    thumb = direction(f"{side}HandThumb1", f"{side}HandThumb2")
    np.testing.assert_allclose(thumb, np.array([out, 0, 1]) / np.sqrt(2), atol=1e-6)
    foot = direction(f"{side}Foot", f"{side}ToeBase")
    assert abs(foot[0]) < 1e-6
    assert foot[2] > 0.9


@pytest.mark.parametrize("side", ["Left", "Right"])
def test_palms_face_down(side: str) -> None:
    """From the little to the index finger is forward, and the middle finger points outward: the palm faces -Y."""
    across = direction(f"{side}HandPinky1", f"{side}HandIndex1")
    assert across[2] > 0.95
    assert abs(across[1]) < 1e-6


def test_transforms_are_rigid_and_keep_the_skeleton_together() -> None:
    body, (transforms, joints_m) = anny_body(), t_pose()
    rotations = transforms[:, :3, :3]
    identity = np.tile(np.eye(3), (len(rotations), 1, 1))
    np.testing.assert_allclose(rotations @ rotations.transpose(0, 2, 1), identity, atol=1e-6)
    np.testing.assert_allclose(np.linalg.det(rotations), 1.0, atol=1e-6)
    children = np.flatnonzero(body.parents >= 0)
    parents = body.parents[children]
    carried = np.einsum("jab,jb->ja", rotations[parents], body.joints_m[children]) + transforms[parents, :3, 3]
    np.testing.assert_allclose(carried, joints_m[children], atol=1e-6)


def test_torso_and_shoulders_do_not_move() -> None:
    body, (transforms, _) = anny_body(), t_pose()
    for name in ("Hips", "Spine2", "Head", "LeftShoulder"):
        np.testing.assert_array_equal(transforms[body.joint(name)], np.eye(4))


def test_a_skeleton_without_fingers_and_toes_is_posed_as_far_as_it_goes() -> None:
    names = ("Hips", "LeftUpLeg", "LeftLeg", "LeftFoot", "LeftArm", "LeftForeArm", "LeftHand")
    body = anny_body()
    rows = [body.joint(name) for name in names]
    transforms = t_pose_transforms(names, np.array([-1, 0, 1, 2, 0, 4, 5]), body.joints_m[rows])
    np.testing.assert_array_equal(transforms[3, :3, :3], transforms[2, :3, :3])  # without toes: with the lower leg
    np.testing.assert_array_equal(transforms[6, :3, :3], transforms[5, :3, :3])
    assert not np.allclose(transforms[5, :3, :3], np.eye(3))
