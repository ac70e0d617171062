"""Cast shadows in renders: what they darken, and what they leave."""

from dataclasses import replace

import numpy as np
import pytest
import torch

from data_tools.synthetic.rig.subject import Subject
from data_tools.synthetic.scene.renderer import FLAT, HARD, Light, render_subject, shade
from pipeline.geometry.camera import Camera


def test_shadows_are_cast_only_if_enabled(subject: Subject) -> None:
    """An arm casts a shadow on the chest; no pixel gets brighter, and the coverage is unchanged."""
    camera = Camera(200.0, 200.0, 64.0, 64.0, 128, 128, np.diag([1.0, -1.0, -1.0, 1.0]).astype(np.float32))
    camera.world_to_camera[:3, 3] = [0.0, 0.9, 3.4]
    vertices = torch.from_numpy(subject.body.vertices)
    light = replace(HARD, key_direction=(1.0, 0.3, 0.3))
    hard = render_subject(subject, vertices, camera, light, 1)
    open_ = render_subject(subject, vertices, camera, replace(light, casts_shadows=False), 1)
    assert np.array_equal(hard[..., 3], open_[..., 3])
    darker = (open_ - hard)[..., :3].max(axis=2)
    assert (darker > 0.1).sum() > 0.02 * (hard[..., 3] > 0).sum()
    assert darker.min() >= 0


def test_shadowed_points_get_only_ambient_light() -> None:
    grey, up = torch.full((2, 3), 0.5), torch.tensor([[0.0, 0.0, 1.0]] * 2)
    light = Light(
        key_intensity=0.5, key_direction=(0.0, 0.0, 1.0), ambient_intensity=0.7, sky_gradient=0.0, specular_strength=0.4
    )
    shaded = shade(grey, up, up, torch.tensor([1.0, 0.0]), light)
    ambient = shade(grey[:1], up[:1], up[:1], torch.ones(1), replace(FLAT, ambient_intensity=0.7))
    assert torch.allclose(shaded[1], ambient[0])
    assert float(shaded[0, 0]) == pytest.approx(1.055 * (0.21404 * 1.2 + 0.4) ** (1 / 2.4) - 0.055, abs=1e-4)
