from unittest import mock

import numpy as np
import torch

from pipeline.body.body import canonical_to_world
from pipeline.field import rendering as render
from pipeline.field.trainer import Trainer
from pipeline.field.volume_rendering import PosedField
from pipeline.kernels.volume_rendering import MIN_TRANSMITTANCE
from tests.field.scene import make_trainer


def render_first_frame(trainer: Trainer, scene) -> np.ndarray:
    """Render the first frame."""
    pose, grid = canonical_to_world(scene.body, scene.motion)[0], trainer.occupancy.binary()
    return render.render_field(trainer.field, grid, scene.body, pose, scene.camera, trainer.scene.skin).numpy()


def render_in_chunks(trainer: Trainer, scene) -> tuple[np.ndarray, int]:
    """Render the first frame without the compiled kernel; also return the number of evaluated points."""
    with (
        mock.patch.object(trainer.field, "radiance", wraps=trainer.field.radiance) as radiance,
        mock.patch.object(PosedField, "is_fused", False),
    ):
        image = render_first_frame(trainer, scene)
    return image, sum(len(call.args[0]) for call in radiance.call_args_list)


def test_rays_end_at_the_maximum_optical_depth(scene):
    trainer = make_trainer(scene, steps=10)
    with torch.no_grad():
        trainer.field.bias[3] = 6.0
    with mock.patch.object(render, "SAMPLE_CHUNK_SIZE", 1):
        early, few = render_in_chunks(trainer, scene)
    with mock.patch.object(render, "MAX_OPTICAL_DEPTH", np.inf):
        whole, all_points = render_in_chunks(trainer, scene)
    assert np.abs(early - whole).max() < 2 * np.exp(-render.MAX_OPTICAL_DEPTH)
    # The first sample is opaque.
    assert few == (whole[..., 3] > 0).sum() < all_points


def test_rays_continue_behind_transparent_samples(scene):
    trainer = make_trainer(scene, steps=10)
    with torch.no_grad():
        trainer.field.bias[3] = -3.0
    _, points = render_in_chunks(trainer, scene)
    with mock.patch.object(render, "MAX_OPTICAL_DEPTH", np.inf):
        assert render_in_chunks(trainer, scene)[1] == points > 0


def test_chunk_sizes_do_not_change_the_image(scene):
    trainer = make_trainer(scene, steps=10)
    image, _ = render_in_chunks(trainer, scene)
    with mock.patch.object(render, "SAMPLE_CHUNK_SIZE", 3), mock.patch.object(render, "RAY_CHUNK_SIZE", 1000):
        other, _ = render_in_chunks(trainer, scene)
    # float32 matrix products with a different number of rows round differently.
    assert np.abs(image - other).max() < 1e-5


def test_the_compiled_kernel_renders_the_same_image(scene, trained):
    traced, (image, _) = render_first_frame(trained, scene), render_in_chunks(trained, scene)
    assert image[..., 3].max() > 0.9
    assert np.abs(traced - image).max() < 1.1 * MIN_TRANSMITTANCE


def test_the_number_of_threads_does_not_change_a_byte(scene, monkeypatch):
    trainer, found = make_trainer(scene, steps=10), []
    monkeypatch.setattr(render, "RAY_CHUNK_SIZE", 1000)
    for threads in (1, 2):
        monkeypatch.setattr(torch, "get_num_threads", lambda count=threads: count)
        found.append(render_first_frame(trainer, scene))
    assert np.array_equal(*found)
