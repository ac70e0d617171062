"""Where limbs touch each other: what faces the other limb is hidden, its outer side is not."""

import numpy as np
import torch

from pipeline.geometry.camera import Camera
from pipeline.texture.contact import BALL_RADIUS_M, CONTACT_M, Limbs, hide_contacts, touches_other_limb
from pipeline.texture.views import BakeView


def sheet(y_m: float, facing: float, size_m: float = 0.1) -> tuple[np.ndarray, np.ndarray]:
    """Points and normals of a horizontal square with points every 5 mm."""
    axis = np.arange(-size_m, size_m + 1e-9, 0.005)
    x, z = np.meshgrid(axis, axis, indexing="ij")
    points = np.stack([x.ravel(), np.full(x.size, y_m), z.ravel()], axis=1)
    return points, np.tile([0.0, facing, 0.0], (len(points), 1))


def touching(*sheets: tuple[np.ndarray, np.ndarray], limbs: tuple[int, ...]) -> list[np.ndarray]:
    points, normals = (np.concatenate(parts) for parts in zip(*sheets, strict=True))
    limb = np.repeat(limbs, [len(part) for part, _ in sheets])
    found = touches_other_limb(points, normals, limb)
    return np.split(found, np.cumsum([len(part) for part, _ in sheets])[:-1])


def middle(points: np.ndarray) -> np.ndarray:
    return np.abs(points[:, [0, 2]]).max(axis=1) < 0.03


def test_a_finger_on_the_thigh_hides_the_thigh_and_its_own_inner_side() -> None:
    """The finger is 15 mm thick and 2 mm off the thigh: its outer side is seen, although the thigh is near."""
    thigh, inner, outer = sheet(0.0, 1.0), sheet(0.002, -1.0, 0.05), sheet(0.017, 1.0, 0.05)
    on_thigh, on_inner, on_outer = touching(thigh, inner, outer, limbs=(0, 1, 1))
    assert on_thigh[middle(thigh[0])].all()
    assert on_inner[middle(inner[0])].all()
    assert not on_outer.any()
    beside = np.abs(thigh[0][:, 0]) > 0.05 + 2.0 * BALL_RADIUS_M
    assert not on_thigh[beside].any()


def test_an_arm_that_sinks_into_the_trunk_hides_it() -> None:
    trunk, inner, outer = sheet(0.0, 1.0), sheet(-0.01, -1.0, 0.05), sheet(0.06, 1.0, 0.05)
    on_trunk, on_inner, on_outer = touching(trunk, inner, outer, limbs=(0, 1, 1))
    assert on_trunk[middle(trunk[0])].all()
    assert on_inner.all()
    assert not on_outer.any()


def test_an_arm_whose_outer_side_lies_beside_the_trunk_hides_it() -> None:
    """A trunk that bulges around a sunk arm: both outer sides face the camera, one centimetre from each other."""
    trunk, outer = sheet(0.0, 1.0), sheet(0.01, 1.0, 0.05)
    on_trunk, on_outer = touching(trunk, outer, limbs=(0, 1))
    assert on_trunk[middle(trunk[0])].all()
    assert not on_outer.any()


def test_a_gap_is_seen_into_and_a_surface_that_goes_on_is_no_contact() -> None:
    trunk, arm = sheet(0.0, 1.0), sheet(max(CONTACT_M, 2.0 * BALL_RADIUS_M) + 0.002, -1.0)
    assert not np.concatenate(touching(trunk, arm, limbs=(0, 1))).any()
    points, normals = sheet(0.0, 1.0)
    assert not touches_other_limb(points, normals, (points[:, 0] > 0.0).astype(int)).any()
    rng = np.random.default_rng(0)
    sphere = rng.normal(size=(4000, 3))
    sphere /= np.linalg.norm(sphere, axis=1, keepdims=True)
    assert not touches_other_limb(0.2 * sphere, sphere, (sphere[:, 1] > 0.0).astype(int)).any()


def test_hands_belong_to_arms_and_all_else_to_the_trunk() -> None:
    names = ("Hips", "Spine", "Head", "LeftArm", "LeftHandIndex1", "RightForeArm", "LeftUpLeg", "LeftFoot")
    limbs = Limbs.of_vertices(np.arange(8)[:, None], np.ones((8, 1)), names)
    limb = limbs.limb
    assert np.flatnonzero(limbs.is_hand).tolist() == [4]
    assert limb[0] == limb[1] == limb[2]
    assert limb[3] == limb[4]
    assert limb[6] == limb[7] == limb[0]
    assert len(set(limb.tolist())) == 3
    blended = Limbs.of_vertices(np.array([[3, 0], [4, 0]]), np.array([[0.7, 0.3], [0.3, 0.7]]), names)
    assert blended.limb.tolist() == [limb[3], limb[0]]
    assert not blended.is_hand.any()


def test_hidden_vertices_face_away() -> None:
    vertices = torch.tensor([[0.0, 0, 0], [1, 0, 0], [0, 0, -1], [0, 0.01, 0], [0, 0.01, -1], [1, 0.01, 0]])
    faces = np.array([[0, 1, 2], [3, 4, 5]])
    camera = Camera(50.0, 50.0, 8.0, 8.0, 16, 16, np.eye(4, dtype=np.float32))
    empty = np.zeros((16, 16), np.uint8)
    view = BakeView(np.zeros((16, 16, 3), np.uint8), empty, camera, vertices, torch.full((6,), 0.8))
    assert hide_contacts(view, faces, np.array([0, 0, 0, 1, 1, 1])).view_cosine.tolist() == [0.0] * 6
    assert torch.equal(hide_contacts(view, faces, np.zeros(6, dtype=int)).view_cosine, view.view_cosine)
