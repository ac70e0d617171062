from unittest import mock

import numpy as np
import pytest
import torch

from pipeline.body.body import canonical_to_world
from pipeline.field import rendering as render
from pipeline.field.trainer import Trainer
from pipeline.kernels.volume_rendering import MIN_TRANSMITTANCE
from tests.field.scene import painted_scene
from tests.field.test_trainer import make_trainer


@pytest.fixture(scope="module")
def scene():
    return painted_scene(12, 110)


def show(trainer: Trainer, scene) -> np.ndarray:
    """The first frame."""
    pose, grid = canonical_to_world(scene.body, scene.motion)[0], trainer.occupancy.grid()
    return render.render_field(trainer.field, grid, scene.body, pose, scene.camera, trainer.scene.skin).numpy()


def draw(trainer: Trainer, scene) -> tuple[np.ndarray, int]:
    """The first frame in the way that serves any field, and how many points this one was asked for."""
    with (
        mock.patch.object(trainer.field, "radiance", wraps=trainer.field.radiance) as asked,
        mock.patch.object(render, "uses_early_termination", return_value=False),
    ):
        image = show(trainer, scene)
    return image, sum(len(call.args[0]) for call in asked.call_args_list)


def test_rays_end_where_nothing_behind_is_seen(scene):
    trainer = make_trainer(scene, steps=10)
    with torch.no_grad():
        trainer.field.bias[3] = 6.0
    with mock.patch.object(render, "SAMPLE_CHUNK_SIZE", 1):
        early, few = draw(trainer, scene)
    with mock.patch.object(render, "MAX_OPTICAL_DEPTH", np.inf):
        whole, all_points = draw(trainer, scene)
    assert np.abs(early - whole).max() < 2 * np.exp(-render.MAX_OPTICAL_DEPTH)
    # One sample hides all behind it.
    assert few == (whole[..., 3] > 0).sum() < all_points


def test_rays_go_on_where_something_behind_is_seen(scene):
    trainer = make_trainer(scene, steps=10)
    with torch.no_grad():
        trainer.field.bias[3] = -3.0
    _, points = draw(trainer, scene)
    with mock.patch.object(render, "MAX_OPTICAL_DEPTH", np.inf):
        assert draw(trainer, scene)[1] == points > 0


def test_a_picture_does_not_depend_on_how_many_samples_are_asked_at_once(scene):
    trainer = make_trainer(scene, steps=10)
    image, _ = draw(trainer, scene)
    with mock.patch.object(render, "SAMPLE_CHUNK_SIZE", 3), mock.patch.object(render, "RAY_CHUNK_SIZE", 1000):
        other, _ = draw(trainer, scene)
    # float32 products of another number of rows
    assert np.abs(image - other).max() < 1e-5


def test_both_ways_show_the_same(scene):
    trainer = make_trainer(scene, steps=60)
    for _ in range(60):
        trainer.step()
    traced, (image, _) = show(trainer, scene), draw(trainer, scene)
    assert image[..., 3].max() > 0.9
    assert np.abs(traced - image).max() < 1.1 * MIN_TRANSMITTANCE


def test_threads_change_no_byte(scene, monkeypatch):
    trainer, found = make_trainer(scene, steps=10), []
    monkeypatch.setattr(render, "RAY_CHUNK_SIZE", 1000)
    for threads in (1, 2):
        monkeypatch.setattr(torch, "get_num_threads", lambda count=threads: count)
        found.append(show(trainer, scene))
    assert np.array_equal(*found)
