"""Pixels of a hand that have the colour of what it touches are not taken for the hand."""

import numpy as np
import torch

from pipeline.geometry.camera import Camera
from pipeline.texture.bake import TexturedSurface
from pipeline.texture.contact import Limbs
from pipeline.texture.hand_colours import hide_foreign_hands
from pipeline.texture.settings import TextureSettings
from pipeline.texture.vertex_texels import texels_at_vertices
from pipeline.texture.views import BakeView

SIDE, FOCAL_PX, DEPTH_M = 120, 100.0, 1.0
SKIN, BLUE = (200, 145, 115), (60, 80, 160)
LEFT_HAND, RIGHT_HAND, TRUNK = 0, 1, 2


def square(centre_x_m: float, half_m: float, depth_m: float) -> tuple[np.ndarray, np.ndarray]:
    """A square of 9 x 9 vertices that faces the camera, which looks along +z."""
    axis = np.linspace(-half_m, half_m, 9)
    x, y = np.meshgrid(axis + centre_x_m, axis, indexing="ij")
    vertices = np.stack([x.ravel(), y.ravel(), np.full(x.size, depth_m)], axis=1).astype(np.float32)
    a = (9 * np.arange(8)[:, None] + np.arange(8)).ravel()
    faces = np.concatenate([np.stack([a, a + 1, a + 9], 1), np.stack([a + 1, a + 10, a + 9], 1)])
    return vertices, faces


def scene(trunk_depth_m: float, left: tuple[int, int, int], right_lower: tuple[int, int, int]) -> np.ndarray:
    """Return the cosines of the right hand, [upper half, lower half], that is skin above and of a colour below.

    The left hand has one colour; the trunk is behind the right hand. Cosines are 0.9 before.
    """
    parts = [square(-0.3, 0.15, DEPTH_M), square(0.3, 0.15, DEPTH_M), square(0.3, 0.2, trunk_depth_m)]
    starts = np.cumsum([0, *(len(vertices) for vertices, _ in parts[:-1])])
    vertices = np.concatenate([vertices for vertices, _ in parts])
    faces = np.concatenate([part[1] + start for part, start in zip(parts, starts, strict=True)]).astype(np.int64)
    limb = np.repeat([LEFT_HAND, RIGHT_HAND, TRUNK], [len(part[0]) for part in parts])
    image = np.full((SIDE, SIDE, 3), 128, np.uint8)
    image[:, : SIDE // 2] = left
    image[:, SIDE // 2 :] = SKIN
    image[SIDE // 2 :, SIDE // 2 :] = right_lower
    camera = Camera(FOCAL_PX, FOCAL_PX, SIDE / 2, SIDE / 2, SIDE, SIDE, np.eye(4, dtype=np.float32))
    view = BakeView(
        image, np.full((SIDE, SIDE), 255, np.uint8), camera, torch.from_numpy(vertices), torch.full((len(limb),), 0.9)
    )
    tensor = torch.from_numpy(faces)
    texels = texels_at_vertices(faces, len(vertices))
    surface = TexturedSurface(tensor, tensor, torch.zeros(len(vertices), 2), texels)
    settings = TextureSettings(silhouette_falloff_m=0.01)
    (hidden,) = hide_foreign_hands([view], surface, Limbs(limb, limb != TRUNK), settings)
    cosine = hidden.view_cosine.numpy()
    assert (cosine[limb != RIGHT_HAND] == np.float32(0.9)).all()
    right, y = cosine[limb == RIGHT_HAND], vertices[limb == RIGHT_HAND, 1]
    inner = (np.abs(y) > 0.03) & (np.abs(y) < 0.12) & (np.abs(vertices[limb == RIGHT_HAND, 0] - 0.3) < 0.12)
    return np.stack([right[inner & (y < 0.0)], right[inner & (y > 0.0)]])


def test_trousers_beside_a_hand_are_not_the_hand() -> None:
    upper, lower = scene(DEPTH_M + 0.05, SKIN, BLUE)
    assert (upper == np.float32(0.9)).all()
    assert (lower == 0.0).all()


def test_what_is_far_from_other_limbs_is_the_hand() -> None:
    """A ring, a bandage, a glove: nothing is there that it could be mistaken for."""
    assert (scene(DEPTH_M + 0.5, SKIN, BLUE) == np.float32(0.9)).all()


def test_gloves_and_shadows_stay() -> None:
    """Both hands of another colour, and the same skin at a third of the light."""
    upper, lower = scene(DEPTH_M + 0.05, BLUE, BLUE)
    assert (lower == np.float32(0.9)).all()
    assert (upper == 0.0).all()
    shadow = (67, 48, 38)
    assert (scene(DEPTH_M + 0.05, SKIN, shadow) == np.float32(0.9)).all()
