from unittest import mock

import numpy as np
import pytest
import torch

from pipeline.avatar import render
from pipeline.avatar.body import canonical_to_world
from pipeline.avatar.train import Learning
from tests.avatar.scene import painted_scene
from tests.avatar.test_train import begin


@pytest.fixture(scope="module")
def scene():
    return painted_scene(12, 110)


def draw(learning: Learning, scene) -> tuple[np.ndarray, int]:
    """The first frame, and how many points the field was asked for."""
    pose = canonical_to_world(scene.body, scene.motion)[0]
    with mock.patch.object(learning.field, "radiance", wraps=learning.field.radiance) as asked:
        image = render.render_field(
            learning.field, learning.occupancy.grid(), scene.body, pose, scene.camera, learning.scene.skin
        )
    return image.numpy(), sum(len(call.args[0]) for call in asked.call_args_list)


def test_rays_end_where_nothing_behind_is_seen(scene):
    learning = begin(scene, steps=10)
    with torch.no_grad():
        learning.field.bias[3] = 6.0
    with mock.patch.object(render, "SAMPLES_AT_ONCE", 1):
        early, few = draw(learning, scene)
    with mock.patch.object(render, "OPAQUE", np.inf):
        whole, all_points = draw(learning, scene)
    assert np.abs(early - whole).max() < 2 * np.exp(-render.OPAQUE)
    # One sample hides all behind it.
    assert few == (whole[..., 3] > 0).sum() < all_points


def test_rays_go_on_where_something_behind_is_seen(scene):
    learning = begin(scene, steps=10)
    with torch.no_grad():
        learning.field.bias[3] = -3.0
    _, points = draw(learning, scene)
    with mock.patch.object(render, "OPAQUE", np.inf):
        assert draw(learning, scene)[1] == points > 0


def test_a_picture_does_not_depend_on_how_many_samples_are_asked_at_once(scene):
    learning = begin(scene, steps=10)
    image, _ = draw(learning, scene)
    with mock.patch.object(render, "SAMPLES_AT_ONCE", 3), mock.patch.object(render, "RAYS_AT_ONCE", 1000):
        other, _ = draw(learning, scene)
    # float32 products of another number of rows
    assert np.abs(image - other).max() < 1e-5
