"""The fused renderer without approximations against the reference, in values and gradients, on a bent bar.

Early termination and gradient subsampling are tested on a trained field in `tests/field/test_volume_rendering.py`.
"""

from dataclasses import replace

import pytest
import torch

from pipeline.kernels.hashgrid import FeatureGradients, GridLayout, add_table_gradient_
from pipeline.kernels.inverse_skinning import bake_warp_grid
from pipeline.kernels.march import PackedWarpGrids, Rays, SamplingVolume
from pipeline.kernels.volume_rendering import (
    BatchSkinning,
    OutputGradients,
    RadianceNetwork,
    RenderSettings,
    reference,
    render_rays_fused,
    render_rays_with_gradients,
)
from tests.kernels.bar import CELL_M, bar_skin, bend

BOUNDS_M = torch.tensor([[-0.65, -0.2, -0.2], [0.65, 0.2, 0.2]])
EXACT = RenderSettings(0.02, 160, min_transmittance=0.0, gradient_subsampling_threshold=0.0)
ANGLES = (0.4, -0.7)
POSES = "canonical_to_posed"


def make_network(random: torch.Generator) -> RadianceNetwork:
    layout = GridLayout(((6, 3, 3), (20, 8, 8)), 4, 10)
    table = 0.5 * torch.randn(layout.rows, 4, generator=random)
    hidden, output = torch.randn(8, 16, generator=random), torch.randn(16, 4, generator=random)
    weights = (tensor.requires_grad_() for tensor in (hidden, output, torch.randn(4, generator=random)))
    return RadianceNetwork(BOUNDS_M, table.requires_grad_(), layout, *weights, 5.0, 4.0)


def make_scene():
    """Rays of two frames, both in one block of 128 rays; a skinning slightly different from the warp grids."""
    random, skin = torch.Generator().manual_seed(2), bar_skin()
    warps = PackedWarpGrids.from_grids([bake_warp_grid(skin, bend(angle)) for angle in ANGLES], CELL_M)
    origins = torch.tensor([0.0, 0.0, 1.5]) + 0.2 * torch.randn(300, 3, generator=random)
    targets = (torch.rand(300, 3, generator=random) - 0.5) * torch.tensor([0.9, 0.2, 0.1])
    frame = torch.arange(300) // 150
    directions = torch.nn.functional.normalize(targets - origins, dim=-1)
    rays = Rays(origins, directions, frame, torch.rand(300, generator=random))
    volume = SamplingVolume(warps, torch.ones(8, 4, 4, dtype=torch.uint8), BOUNDS_M)
    matrices = torch.stack([bend(angle + 0.01) for angle in ANGLES]).requires_grad_()
    return rays, volume, make_network(random), BatchSkinning(skin, matrices, frame)


def with_gate(network: RadianceNetwork) -> RadianceNetwork:
    gate = 0.1 + torch.rand(5, 3, 4, generator=torch.Generator().manual_seed(4))
    return replace(network, gate=gate.requires_grad_())


def leaves(network: RadianceNetwork, skinning: BatchSkinning) -> dict[str, torch.Tensor]:
    names = ("hidden", "output", "bias", *(["gate"] if network.gate is not None else []))
    named = {name: getattr(network, name) for name in names}
    return named | {POSES: skinning.canonical_to_posed}


@pytest.mark.parametrize(("newton", "gated"), [(True, False), (False, False), (True, True)])
def test_values_and_gradients_match_reference(newton: bool, gated: bool) -> None:
    rays, volume, network, skinning = make_scene()
    network = with_gate(network) if gated else network
    points_m = torch.tensor([[0.1, 0.02, 0.0], [-0.3, 0.0, 0.05]])
    feature_gradients: FeatureGradients = []
    used = skinning if newton else None
    fused = render_rays_fused(rays, volume, network, used, points_m, EXACT, feature_gradients)
    expected = reference.render_rays(rays, volume, network, used, points_m, EXACT)
    assert float(expected.alpha.detach().max()) > 0.5
    assert len(fused.weight) == len(expected.weight) > 1000
    for name in ("image", "alpha", "density_per_m"):
        torch.testing.assert_close(getattr(fused, name), getattr(expected, name), atol=2e-5, rtol=1e-4)
    for name in ("transmittance", "weight"):
        ours, theirs = (getattr(result, name).sort().values for result in (fused, expected))
        torch.testing.assert_close(ours, theirs, atol=2e-5, rtol=0)
    random = torch.Generator().manual_seed(3)
    to_image, to_alpha = torch.randn(300, 3, generator=random), torch.randn(300, generator=random)
    parameters = {name: leaf for name, leaf in leaves(network, skinning).items() if newton or name != POSES}
    gradients = []
    for result, extra in ((fused, []), (expected, [network.table])):
        loss = (result.image * to_image).sum() + (result.alpha * to_alpha).sum() + result.density_per_m.sum()
        gradients.append(torch.autograd.grad(loss, [*parameters.values(), *extra]))
    grad_table = torch.zeros_like(network.table)
    add_table_gradient_(grad_table, feature_gradients, network.layout)
    names = [*parameters, "table"]
    for name, ours, theirs in zip(names, (*gradients[0], grad_table), gradients[1], strict=True):
        # A hidden unit near zero may be active in one and not in the other.
        assert float((ours - theirs).norm()) < 1e-3 * float(theirs.norm()), name


def test_max_samples_limits_each_ray() -> None:
    rays, volume, network, _ = make_scene()
    settings = replace(EXACT, max_samples=3)
    fused = render_rays_fused(rays, volume, network, None, torch.zeros(0, 3), settings, [])
    expected = reference.render_rays(rays, volume, network, None, torch.zeros(0, 3), settings)
    assert len(fused.weight) == len(expected.weight) <= 3 * len(rays.frame_index)
    torch.testing.assert_close(fused.image, expected.image, atol=2e-5, rtol=1e-4)


@pytest.mark.parametrize(("newton", "gated"), [(True, True), (False, False)])
def test_gradients_without_autograd_are_the_same(newton: bool, gated: bool) -> None:
    """The second call uses the buffers of the first, which must not change its result."""
    rays, volume, network, skinning = make_scene()
    network, used = with_gate(network) if gated else network, skinning if newton else None
    points_m = torch.tensor([[0.1, 0.02, 0.0], [-0.3, 0.0, 0.05]])
    random, features = torch.Generator().manual_seed(3), FeatureGradients()
    slopes = torch.randn(300, 3, generator=random), torch.randn(300, generator=random), torch.ones(2)
    expected = render_rays_fused(rays, volume, network, used, points_m, RenderSettings(0.02, 160), features)
    loss = sum((value * slope).sum() for value, slope in zip(expected[:3], slopes, strict=True))
    parameters = {name: leaf for name, leaf in leaves(network, skinning).items() if newton or name != POSES}
    by_autograd = dict(zip(parameters, torch.autograd.grad(loss, list(parameters.values())), strict=True))
    of_output = OutputGradients(*slopes)
    other_rays = rays._replace(jitter=1 - rays.jitter)
    results = [
        render_rays_with_gradients(
            drawn, volume, network, used, points_m, RenderSettings(0.02, 160), lambda *_: of_output
        )
        for drawn in (rays, other_rays) * 2
    ]
    assert not torch.equal(results[1][0].weight, expected.weight)
    for output, gradients, found_features in results[::2]:
        for name, value in expected._asdict().items():
            assert torch.equal(getattr(output, name), value), name
        found = {name: value for name, value in gradients._asdict().items() if value is not None}
        assert found.keys() == by_autograd.keys()
        assert all(torch.equal(found[name], value) for name, value in by_autograd.items())
        assert all(torch.equal(a, b) for a, b in zip(found_features[0], features[0], strict=True))
