"""What rays see, asked of all samples and only as far as the light goes: two ways to the same picture and gradient."""

from functools import partial

import numpy as np
import pytest
import torch
from torch import Tensor

from pipeline.field import field as field_module
from pipeline.field import volume_rendering as module
from pipeline.field.inverse_skinning import Rays
from pipeline.field.trainer import MAX_SAMPLES, Learning
from pipeline.field.volume_rendering import look, look_at_all
from pipeline.kernels.hashgrid import Towards, add_table_gradient_
from pipeline.kernels.volume_rendering import LEAST_LIGHT, Traced, trace
from tests.field.test_trainer import begin, draw, scene  # noqa: F401 - a fixture


@pytest.fixture(scope="module")
def learning(scene) -> Learning:  # noqa: F811
    """A body half learnt: some of it opaque, poses that have moved away from where the warp grids were baked."""
    learning = begin(scene, steps=160, pose_start=0.1, occupancy_start=8)
    for _ in range(120):
        learning.step()
    return learning


def seen(learning: Learning, way, exact: bool = True, frames: tuple[int, ...] = (1, 4, 6)) -> tuple[Traced, Towards]:
    batch, towards = draw(learning, *frames), Towards()
    rays = Rays(batch.origins_m, batch.directions, batch.frame, batch.jitter)
    placing = learning._placing(batch.frames) if exact else None
    points = torch.tensor([[0.0, 0.9, 0.0], [0.3, 1.2, 0.1], [5.0, 5.0, 5.0]])
    grid = learning.occupancy.grid()
    found = way(learning.field, learning.inverse, grid, rays, placing, points, learning.step_m, MAX_SAMPLES, towards)
    return found, towards


def gradients(learning: Learning, found: Traced, towards: Towards) -> dict[str, Tensor]:
    """Of a loss in which every ray, channel and point counts differently."""
    random = torch.Generator().manual_seed(3)
    values = (found.image, found.alpha, 0.01 * found.density_per_m)
    loss = torch.stack([(value * torch.randn(value.shape, generator=random)).sum() for value in values]).sum()
    of = torch.autograd.grad(loss, list(learning.parameters.values()), allow_unused=True)
    table = torch.zeros_like(learning.field.table)
    add_table_gradient_(table, towards, learning.field.layout)
    named = zip(learning.parameters, of, strict=True)
    return {"table": table} | {name: value for name, value in named if value is not None}


def whole(thinning: float = 0.0):
    """`look` that leaves nothing out."""
    return partial(trace, least_light=0.0, thinning=thinning)


@pytest.mark.parametrize("exact", [True, False])
def test_both_ways_come_to_the_same(learning, monkeypatch, exact):
    monkeypatch.setattr(module, "trace", whole())
    monkeypatch.setattr(field_module, "NEGLIGIBLE", 0.0)
    (ours, towards), (twin, of_twin) = seen(learning, look, exact), seen(learning, look_at_all, exact)
    assert float(twin.alpha.detach().max()) > 0.9
    for name in ("image", "alpha"):
        torch.testing.assert_close(getattr(ours, name), getattr(twin, name), atol=2e-5, rtol=0)
    torch.testing.assert_close(ours.density_per_m, twin.density_per_m, atol=0, rtol=1e-4)
    assert len(ours.light) == len(twin.light) > 5000
    # The order of samples means nothing: compare what they come to.
    for name in ("light", "weight"):
        mine, theirs = (getattr(found, name).double().sort().values for found in (ours, twin))
        torch.testing.assert_close(mine, theirs, atol=2e-5, rtol=0)
    weighted = [(found.canonical_m.double() * found.weight[:, None]).sum(0) for found in (ours, twin)]
    torch.testing.assert_close(*weighted, rtol=1e-5, atol=1e-4)
    mine, theirs = gradients(learning, ours, towards), gradients(learning, twin, of_twin)
    assert mine.keys() == theirs.keys()
    assert ("shift_m" in mine) == exact
    for name, gradient in theirs.items():
        # A hidden unit near zero may be on in one and off in the other.
        assert float((mine[name] - gradient).norm()) < 5e-4 * float(gradient.norm()), name


def test_what_lies_in_the_dark_is_not_asked_and_hardly_missed(learning, monkeypatch):
    (ours, _), (twin, _) = seen(learning, look), seen(learning, look_at_all)
    assert len(ours.light) < 0.75 * len(twin.light)
    assert float((ours.image - twin.image).detach().abs().max()) < LEAST_LIGHT
    assert float((ours.alpha - twin.alpha).detach().abs().max()) < LEAST_LIGHT
    # Everything that light reaches is there.
    for least in (0.01, 0.5):
        assert int((ours.light > least).sum()) == int((twin.light > least).sum())


def test_thinning_keeps_the_gradient_in_the_mean(learning, monkeypatch):
    """Each of the few samples that are taken stands for those that are not: no part of the gradient is lost."""
    monkeypatch.setattr(module, "trace", whole())
    truth = gradients(learning, *seen(learning, look))
    taken = {}
    for thinning in (0.3, 3.0):
        monkeypatch.setattr(module, "trace", whole(thinning))
        found, towards = seen(learning, look)
        thinned = gradients(learning, found, towards)
        taken[thinning] = len(towards[0][0])
        for name, gradient in truth.items():
            error = float((thinned[name] - gradient).norm()) / float(gradient.norm())
            assert error < {0.3: 0.05, 3.0: 0.5}[thinning], name
        # Of many numbers the noise averages out: what is left would be a bias.
        for name in ("table", "hidden"):
            along = float((thinned[name] * truth[name]).sum()) / float(truth[name].square().sum())
            assert along == pytest.approx(1.0, abs={0.3: 0.01, 3.0: 0.1}[thinning]), name
    assert taken[3.0] < taken[0.3] < 0.6 * len(seen(learning, look)[0].light)


def test_room_grows_with_the_samples(learning, monkeypatch):
    monkeypatch.setattr(module, "trace", whole())
    plenty, _ = seen(learning, look)
    monkeypatch.setattr("pipeline.kernels.volume_rendering.ROOM", 1)
    narrow, _ = seen(learning, look)
    assert len(plenty.light) > 768 * 4
    assert torch.equal(plenty.image, narrow.image)


def test_rays_without_samples_see_nothing(learning):
    origins = torch.tensor([[0.0, 1.0, 50.0], [0.0, 1.0, 50.0], [float("nan"), 0.0, 0.0]])
    directions = torch.tensor([[1.0, 0.0, 0.0], [0.0, 1.0, 0.0], [0.0, 0.0, -1.0]])
    rays = Rays(origins, directions, torch.zeros(3, dtype=torch.long), torch.full((3,), 0.5))
    grid, nothing = learning.occupancy.grid(), torch.zeros(0, 3)
    placing = learning._placing(torch.tensor([0]))
    found = look(learning.field, learning.inverse, grid, rays, placing, nothing, 0.01, 160, Towards())
    assert not found.image.any()
    assert not found.alpha.any()
    assert len(found.light) == len(found.density_per_m) == 0
    assert all(np.isfinite(value.detach().numpy()).all() for value in found)
