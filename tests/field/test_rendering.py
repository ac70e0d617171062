from unittest import mock

import numpy as np
import pytest
import torch

from pipeline.body.body import canonical_to_world
from pipeline.field import rendering as render
from pipeline.field.trainer import Learning
from pipeline.kernels.volume_rendering import LEAST_LIGHT
from tests.field.scene import painted_scene
from tests.field.test_trainer import begin


@pytest.fixture(scope="module")
def scene():
    return painted_scene(12, 110)


def show(learning: Learning, scene) -> np.ndarray:
    """The first frame."""
    pose, grid = canonical_to_world(scene.body, scene.motion)[0], learning.occupancy.grid()
    return render.render_field(learning.field, grid, scene.body, pose, scene.camera, learning.scene.skin).numpy()


def draw(learning: Learning, scene) -> tuple[np.ndarray, int]:
    """The first frame in the way that serves any field, and how many points this one was asked for."""
    with (
        mock.patch.object(learning.field, "radiance", wraps=learning.field.radiance) as asked,
        mock.patch.object(render, "ends_with_the_light", return_value=False),
    ):
        image = show(learning, scene)
    return image, sum(len(call.args[0]) for call in asked.call_args_list)


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


def test_both_ways_show_the_same(scene):
    learning = begin(scene, steps=60)
    for _ in range(60):
        learning.step()
    traced, (image, _) = show(learning, scene), draw(learning, scene)
    assert image[..., 3].max() > 0.9
    assert np.abs(traced - image).max() < 1.1 * LEAST_LIGHT


def test_threads_change_no_byte(scene, monkeypatch):
    learning, found = begin(scene, steps=10), []
    monkeypatch.setattr(render, "RAYS_AT_ONCE", 1000)
    for threads in (1, 2):
        monkeypatch.setattr(torch, "get_num_threads", lambda count=threads: count)
        found.append(show(learning, scene))
    assert np.array_equal(*found)
