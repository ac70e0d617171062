"""What a step of learning draws, and the learning rates at both ends, in closed form."""

from types import SimpleNamespace

import numpy as np
import pytest
import torch

from pipeline.avatar.field_config import FieldConfig
from pipeline.avatar.prepare import start_learning
from pipeline.avatar.train import WARM_UP, Batch, Learning
from tests.avatar.scene import painted_scene


def at(done: int, **options) -> SimpleNamespace:
    """All that a rate depends on."""
    return SimpleNamespace(done=done, config=FieldConfig(**options))


@pytest.mark.parametrize("steps", [200, 600])
def test_the_rate_rises_in_the_warm_up_and_ends_at_its_last_part(steps: int) -> None:
    options = {"steps": steps, "final_rate": 0.05}
    assert Learning._rate(at(0, **options)) == pytest.approx(1 / WARM_UP)
    assert Learning._rate(at(WARM_UP - 1, **options)) == pytest.approx(0.05 ** ((WARM_UP - 1) / steps))
    assert Learning._rate(at(steps, **options)) == pytest.approx(0.05)
    whole = [Learning._rate(at(done, **options)) for done in range(steps)]
    assert np.argmax(whole) == WARM_UP - 1
    # After the warm-up each step takes the same part of the one before.
    ratios = np.array(whole[WARM_UP:]) / whole[WARM_UP - 1 : -1]
    np.testing.assert_allclose(ratios, 0.05 ** (1 / steps), rtol=1e-12)


@pytest.mark.parametrize("begun", [0.0, 0.25])
def test_the_poses_rate_is_whole_at_first_and_a_tenth_at_the_end(begun: float) -> None:
    options = {"steps": 200, "pose_start": begun}
    assert Learning._pose_rate(at(round(200 * begun), **options)) == pytest.approx(1.0)
    assert Learning._pose_rate(at(200, **options)) == pytest.approx(0.1)
    assert Learning._pose_rate(at(round(100 * (1 + begun)), **options)) == pytest.approx(0.1**0.5)


def test_poses_that_begin_at_the_very_end_have_a_rate() -> None:
    assert Learning._pose_rate(at(200, steps=200, pose_start=1.0)) == pytest.approx(1.0)


@pytest.fixture(scope="module")
def learning() -> Learning:
    scene, config = (
        painted_scene(4, 64),
        FieldConfig(rays=600, frames_per_step=2, levels=2, log2_rows=10, margin_m=0.03),
    )
    pictures = list(zip(scene.images, scene.masks, strict=True))
    return start_learning(scene.body, scene.motion, scene.camera, pictures, config)


def drawn(learning: Learning, step: int) -> Batch:
    learning.done = step
    return learning._draw(learning._random())


def test_every_ray_has_a_background_of_its_own(learning: Learning) -> None:
    background = drawn(learning, 0).background
    assert len(background.unique(dim=0)) == len(background) > 300
    assert float(background.min()) >= 0
    assert float(background.max()) < 1
    # Every colour is as likely: before greys alone a grey field would pass for nothing.
    assert background.mean(0).tolist() == pytest.approx([0.5] * 3, abs=0.06)
    assert (torch.corrcoef(background.T) - torch.eye(3)).abs().max() < 0.15


def test_a_step_draws_anew_and_always_the_same(learning: Learning) -> None:
    first, second, again = drawn(learning, 0), drawn(learning, 1), drawn(learning, 0)
    for name in ("background", "jitter"):
        assert torch.equal(getattr(first, name), getattr(again, name))
        assert not torch.equal(getattr(first, name), getattr(second, name))


@pytest.mark.parametrize(
    ("slots", "cut"),
    [
        ([0, 0, 1, 1, 2, 2, 3, 3], [[0, 1], [2, 3]]),
        ([0, 0, 1, 1, 2, 2], [[0], [1, 2]]),
        ([1, 1, 2, 2], [[0, 1], [2]]),
        ([2, 2, 2], [[0, 1, 2]]),
        ([0, 3, 3, 3], [[0, 1, 2], [3]]),
        ([], [[0, 1, 2, 3]]),
    ],
)
def test_a_batch_is_cut_between_frames_and_no_part_is_without_rays(slots: list[int], cut: list[list[int]]) -> None:
    """Also where frames have no rays, because their masks are empty."""
    frames, count = sum(len(frames_of) for frames_of in cut), len(slots)
    numbers = torch.arange(float(3 * count)).view(count, 3)
    batch = Batch(
        torch.arange(frames) + 10,
        torch.tensor(slots, dtype=torch.int64),
        np.arange(count),
        numbers,
        numbers + 1,
        torch.zeros(count, 4),
        numbers + 2,
        numbers[:, 0],
    )
    parts = batch.parts(2)
    assert [part.frames.tolist() for part in parts] == [[10 + frame for frame in frames_of] for frames_of in cut]
    assert torch.cat([part.frames[part.slot] for part in parts]).tolist() == [10 + slot for slot in slots]
    assert np.concatenate([part.rows for part in parts]).tolist() == list(range(count))
    for name in ("origins_m", "directions", "rgba", "background", "jitter"):
        assert torch.equal(torch.cat([getattr(part, name) for part in parts]), getattr(batch, name)), name
    assert all(len(part.rows) for part in parts) or not slots
