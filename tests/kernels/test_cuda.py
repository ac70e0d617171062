"""CUDA kernels against the compiled loops of the CPU: on a GPU, or in numba's simulator where there is none.

The simulator runs each thread as one of Python, so the scenes are small. It does not compile: `tests/conftest.py` turns
it on where torch finds no GPU.
"""

from contextlib import ExitStack
from dataclasses import replace
from importlib import import_module
from typing import Any
from unittest import mock

import numba
import numpy as np
import pytest
import torch
from torch import Tensor

from pipeline.kernels.adam import adam_step_
from pipeline.kernels.adam import cuda as adam
from pipeline.kernels.common import cuda as launches
from pipeline.kernels.common.cuda import IS_SIMULATED, launch
from pipeline.kernels.common.numba_options import CUDA_SOURCES
from pipeline.kernels.cuda_signatures import SIGNATURES
from pipeline.kernels.hashgrid import FeatureGradients, GridLayout, add_table_gradient_, encode
from pipeline.kernels.hashgrid import cuda as hashgrid
from pipeline.kernels.march import cuda as march_cuda
from pipeline.kernels.march import march
from pipeline.kernels.ray_losses import cuda as ray_losses
from pipeline.kernels.ray_losses import ray_loss_gradients
from pipeline.kernels.transmittance_stats import cuda as transmittance_stats
from pipeline.kernels.transmittance_stats import update_voxel_maxima
from pipeline.kernels.volume_rendering import OutputGradients, render_rays_with_gradients
from pipeline.kernels.volume_rendering.cuda import CudaRenderer
from tests.kernels.test_volume_rendering import EXACT, make_scene, with_gate

DEVICE = torch.device("cpu" if IS_SIMULATED else "cuda")
LAYOUT = GridLayout(((3, 5, 4), (20, 30, 10)), 4, 8)
"""One dense and one hashed level."""
KERNEL_FOLDERS = [path.parent.name for path in CUDA_SOURCES if path.name == "cuda.py"]
FEW_SAMPLES = replace(EXACT, max_samples=50)


def on_device(value: Any) -> Any:
    """Copy a tensor, or those of a named tuple or a dataclass, to the device of the tests."""
    if isinstance(value, Tensor):
        return value.detach().to(DEVICE, copy=True)
    if hasattr(value, "_fields"):
        return type(value)(*map(on_device, value))
    if hasattr(value, "__dataclass_fields__"):
        fields = {name: on_device(getattr(value, name)) for name in value.__dataclass_fields__}
        return replace(value, **fields)
    return value


@pytest.fixture
def random() -> torch.Generator:
    return torch.Generator().manual_seed(5)


def assert_close(found: Tensor, expected: Tensor, relative: float = 1e-5) -> None:
    assert torch.isfinite(expected).all()
    assert float((found.cpu() - expected).norm()) <= relative * float(expected.norm())


def points_of_the_box(random: torch.Generator, count: int) -> Tensor:
    """Points of the unit box, some beside it, and one that is not a number."""
    points = 1.4 * torch.rand(count, 3, generator=random) - 0.2
    points[0] = torch.nan
    points[1], points[2] = 0.0, 1.0
    return points


def test_features_of_the_hash_grid(random: torch.Generator) -> None:
    points, table = points_of_the_box(random, 30), torch.randn(LAYOUT.rows, 4, generator=random)
    found = hashgrid.encode(on_device(points), on_device(table), LAYOUT.level_params)
    assert_close(found, encode(points, table, LAYOUT))


def test_gradients_of_the_hash_grid(random: torch.Generator) -> None:
    points, table = points_of_the_box(random, 30), torch.randn(LAYOUT.rows, 4, generator=random)
    points[:2] = 0.5
    points.clamp_(0.01, 0.99).requires_grad_()
    gradient = torch.randn(30, LAYOUT.width, generator=random)
    gradient[4] = 0.0
    (grad_points,) = torch.autograd.grad(encode(points, table, LAYOUT), points, gradient)
    grad_table = torch.zeros_like(table)
    add_table_gradient_(grad_table, [(points.detach(), gradient)], LAYOUT)
    inputs = on_device(points), on_device(table), LAYOUT.level_params, on_device(gradient)
    found_points, found_table = on_device(torch.zeros(30, 3)), on_device(torch.zeros_like(table))
    hashgrid.add_points_gradient(*inputs, found_points)
    hashgrid.add_table_gradient(inputs[0], inputs[3], found_table, LAYOUT.level_params)
    assert_close(found_points, grad_points)
    assert_close(found_table, grad_table)


@pytest.mark.parametrize("max_samples", [3, 50])
def test_samples_of_rays(max_samples: int) -> None:
    rays, volume = few_rays()[:2]
    volume.occupied[4:, :2] = 0
    expected = march(rays, volume, 0.02, max_samples)
    samples, ray_offsets = march_cuda.march(on_device(rays), on_device(volume), 0.02, max_samples)
    assert ray_offsets.cpu().tolist() == expected.ray_offsets.tolist()
    assert len(expected.distance_m) > 20
    assert_close(samples.distance, expected.distance_m)
    assert_close(samples.canonical, expected.canonical_m)
    ray = torch.repeat_interleave(torch.arange(len(rays.jitter)), expected.ray_offsets.diff())
    assert samples.ray_indices.cpu().tolist() == ray.tolist()


def few_rays() -> tuple:
    """The scene of the renderer's tests with every 25th ray; one ray is degenerate, and one misses the body."""
    rays, volume, network, skinning = make_scene()
    rays = type(rays)(*(tensor[::25].clone() for tensor in rays))
    rays.directions[3] = 0.0
    rays.directions[4] = torch.tensor([0.0, 0.0, 1.0])
    return rays, volume, network, skinning._replace(batch_index=skinning.batch_index[::25].clone())


@pytest.mark.parametrize(("newton", "gated"), [(True, False), (False, True)])
def test_renders_and_gradients(newton: bool, gated: bool, random: torch.Generator) -> None:
    rays, volume, network, skinning = few_rays()
    network = with_gate(network) if gated else network
    used = skinning if newton else None
    points_m = torch.tensor([[0.1, 0.02, 0.0], [-0.3, 0.0, 0.05]])
    slopes = torch.randn(12, 3, generator=random), torch.randn(12, generator=random), torch.ones(2)
    expected, expected_gradients, features = render_rays_with_gradients(
        rays, volume, network, used, points_m, FEW_SAMPLES, lambda *_: OutputGradients(*slopes)
    )
    moved = [on_device(value) for value in (rays, volume, network)]
    renderer = CudaRenderer(*moved, on_device(skinning) if newton else None, on_device(points_m), FEW_SAMPLES)
    rendered = renderer.forward_pass()
    output = rendered.output()
    assert_close(output.image, expected.image, 1e-4)
    assert_close(output.alpha, expected.alpha, 1e-4)
    assert_close(output.density_per_m, expected.density_per_m, 1e-4)
    assert_close(output.weight.sort().values, expected.weight.sort().values, 1e-4)
    assert_close(output.transmittance.sort().values, expected.transmittance.sort().values, 1e-4)
    gradients, of_features = renderer.backward_pass(rendered, OutputGradients(*map(on_device, slopes)))
    for name, theirs in expected_gradients._asdict().items():
        found = getattr(gradients, name)
        assert (found is None) == (theirs is None), name
        if theirs is not None:
            assert_close(found, theirs, 1e-3)
    assert_close(table_gradient(network, [of_features]), table_gradient(network, features), 1e-3)


def table_gradient(network: Any, features: FeatureGradients) -> Tensor:
    grad_table = torch.zeros_like(network.table).detach()
    on_cpu = [(points.cpu(), gradient.cpu()) for points, gradient in features]
    add_table_gradient_(grad_table, on_cpu, network.layout)
    return grad_table


def test_losses_of_rays(random: torch.Generator) -> None:
    shapes = ((50, 3), 50, (50, 4), (50, 3), 50)
    tensors = [torch.rand(shape, generator=random) for shape in shapes]
    tensors[1][:3] = torch.tensor([0.0, 1.0, 1.0 + 1e-6])
    weights = (1.0, 0.3, 0.02)
    found = ray_losses.ray_loss_gradients(*map(on_device, tensors), 0.1, weights)
    for mine, theirs in zip(found, ray_loss_gradients(*tensors, 0.1, weights), strict=True):
        assert_close(mine, theirs)


def test_steps_of_adam(random: torch.Generator) -> None:
    parameter = torch.randn(40, 4, generator=random)
    moments = torch.zeros(40, 4), torch.zeros(40, 4)
    state = [on_device(tensor) for tensor in (parameter, *moments)]
    for step in range(1, 4):
        gradient = torch.randn(40, 4, generator=random)
        gradient[0, 0], gradient[1, 1], gradient[2] = torch.nan, torch.inf, 0.0
        there = on_device(gradient)
        adam_step_(parameter, gradient, *moments, step, 0.01)
        rate, epsilon = 0.01 * (1 - 0.99**step) ** 0.5 / (1 - 0.9**step), 1e-15 * (1 - 0.99**step) ** 0.5
        adam.update(state[0], there, *state[1:], rate, 0.9, 0.99, epsilon)
        assert not there.any()
    for mine, theirs in zip(state, (parameter, *moments), strict=True):
        assert_close(mine, theirs)


def test_maxima_of_voxels(random: torch.Generator) -> None:
    points = 1.4 * torch.rand(60, 3, generator=random) - 0.2
    points[0] = torch.nan
    values = torch.rand(60, generator=random), torch.rand(60, generator=random)
    bounds, shape = torch.tensor([[0.0, 0.0, 0.0], [1.0, 0.9, 0.8]]), (3, 2, 4)
    maxima = torch.zeros(24), torch.full((24,), 0.5)
    there = [on_device(tensor) for tensor in (points, *values, bounds)]
    found = [on_device(tensor) for tensor in maxima]
    transmittance_stats.update_voxel_maxima(*there, shape, *found)
    update_voxel_maxima(points, *values, bounds, shape, *maxima)
    for mine, theirs in zip(found, maxima, strict=True):
        assert_close(mine, theirs, 0.0)


def test_a_kernel_takes_contiguous_tensors_only() -> None:
    columns = torch.zeros(4, 4, device=DEVICE).T[1:]
    with pytest.raises(ValueError, match="contiguous"):
        launch(adam.update_elements, 4, columns, columns, columns, columns, *(np.float32(0),) * 4)


def test_every_launch_is_compiled_ahead(random: torch.Generator) -> None:
    prepared = dict(SIGNATURES)
    launched = {}

    def record(kernel: Any, threads: int, *arguments: Any) -> None:
        launched[kernel] = tuple(numba.typeof(launches._array_argument(argument)) for argument in arguments)
        launch(kernel, threads, *arguments)

    modules = [import_module(f"pipeline.kernels.{name}.cuda") for name in KERNEL_FOLDERS]
    with ExitStack() as patches:
        for module in modules:
            patches.enter_context(mock.patch.object(module, "launch", record))
        test_renders_and_gradients(True, False, random)
        test_gradients_of_the_hash_grid(random)
        test_losses_of_rays(random)
        test_steps_of_adam(random)
        test_maxima_of_voxels(random)
    assert launched.keys() == prepared.keys()
    for kernel, arguments in launched.items():
        assert arguments == prepared[kernel], kernel.__name__


def test_layout_of_an_array_is_that_of_numpy() -> None:
    array = np.zeros((3, 2, 5), np.int16)
    before, after = launches._array_layout(torch.from_numpy(array).shape, array.itemsize)
    assert before == (0, 0, array.size, array.itemsize)
    assert after == (*array.shape, *array.strides)


def test_no_threads_are_no_launch() -> None:
    launch(None, 0)
