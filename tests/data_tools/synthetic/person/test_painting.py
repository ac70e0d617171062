"""Colours of the texture: skin on hands, star on the chest, hair on the crown."""

import numpy as np
import pytest
import torch

from data_tools.synthetic.person.anatomy import measure_anatomy
from data_tools.synthetic.person.face import paint_eyes
from data_tools.synthetic.person.outfit import Outfit, choose_outfit
from data_tools.synthetic.rig.subject import Subject
from pipeline.body.body import Body, load_anny
from pipeline.geometry.texture_rendering import sample_texture


def colour_near(subject: Subject, place_m: np.ndarray, radius_m: float = 0.012) -> np.ndarray:
    """Median colour of the texels at the corners of the faces around a surface point."""
    corners = subject.body.vertices[subject.body.faces]
    near = np.linalg.norm(corners - place_m, axis=2) < radius_m
    assert near.any()
    uv = torch.from_numpy(subject.uv[subject.faces_uv[near]])
    return sample_texture(subject.texture_tensor(), uv).median(dim=0).values.numpy()


def surface_at(subject: Subject, x: float, y: float, is_front: bool) -> np.ndarray:
    """Frontmost or rearmost vertex within a centimetre of a line along Z."""
    vertices = subject.body.vertices
    rows = np.flatnonzero(np.hypot(vertices[:, 0] - x, vertices[:, 1] - y) < 0.012)
    return vertices[rows[vertices[rows, 2].argmax() if is_front else vertices[rows, 2].argmin()]]


@pytest.fixture(scope="module")
def outfit() -> Outfit:
    return choose_outfit(0)


@pytest.fixture(scope="module")
def chest(subject: Subject) -> np.ndarray:
    joint = subject.body.joint
    return 0.5 * (subject.body.joints_m[joint("Spine1")] + subject.body.joints_m[joint("Spine2")])


def test_the_star_is_on_the_chest(subject: Subject, chest: np.ndarray) -> None:
    red, green, blue = colour_near(subject, surface_at(subject, chest[0], chest[1] + 0.055, is_front=True))
    assert red > 0.8
    assert 0.5 < green < 0.9
    assert blue < 0.5


def test_the_shirt_is_red_outside_the_prints(subject: Subject, chest: np.ndarray, outfit: Outfit) -> None:
    for is_front in (True, False):
        place = surface_at(subject, chest[0], chest[1] - 0.13, is_front)
        assert np.allclose(colour_near(subject, place), outfit.shirt, atol=0.12)


def test_hands_are_skin_and_the_crown_is_hair(subject: Subject, outfit: Outfit, bare: Body) -> None:
    hand = bare.vertices[bare.skin_weights[:, bare.joint("LeftHandIndex1")].argmax()]
    assert np.allclose(colour_near(subject, hand), outfit.skin, atol=0.12)
    crown = subject.body.vertices[subject.body.vertices[:, 1].argmax()]
    assert np.allclose(colour_near(subject, crown, 0.03), outfit.hair, atol=0.15)


def test_trousers_are_blue_in_front_and_behind(subject: Subject, bare: Body) -> None:
    knee = bare.joints_m[bare.joint("LeftLeg")]
    for is_front in (True, False):
        red, _, blue = colour_near(subject, surface_at(subject, knee[0], knee[1], is_front))
        assert blue > red + 0.05


def test_colours_agree_across_seams(subject: Subject) -> None:
    """A vertex with several UVs has nearly equal colours at each, up to the size of a texel."""
    faces, faces_uv = subject.body.faces.ravel(), subject.faces_uv.ravel()
    pairs = np.unique(np.stack([faces, faces_uv], axis=1), axis=0)
    same = pairs[1:, 0] == pairs[:-1, 0]
    texture = subject.texture_tensor()
    first = sample_texture(texture, torch.from_numpy(subject.uv[pairs[:-1][same, 1]]))
    second = sample_texture(texture, torch.from_numpy(subject.uv[pairs[1:][same, 1]]))
    assert same.sum() > 300
    assert (first - second).abs().mean() < 0.04


def test_texels_outside_the_charts_are_filled(subject: Subject) -> None:
    """No texel is black: outside the charts, texels have the colour of the nearest chart."""
    assert subject.texture.max(axis=2).min() > 0
    assert subject.texture.shape == (512, 512, 3)


def test_pupils_are_dark(bare: Body, outfit: Outfit) -> None:
    anatomy = measure_anatomy(load_anny(), bare)
    axis = anatomy.eyes_m[0] + np.array([0.0, 0.0, anatomy.eye_radius_m])
    offsets = np.array([[0.0, 0, 0], [0.0045, 0, 0], [0.011, 0, 0]])
    pupil, iris, white = paint_eyes((axis + offsets).astype(np.float32), anatomy, outfit)
    assert pupil.max() < 0.1
    assert np.allclose(iris, outfit.iris, atol=0.01)
    assert white.min() > 0.8
