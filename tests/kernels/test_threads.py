"""Every kernel with a parallel loop gives the same bytes with 1, 2 and 16 threads.

The number of threads of a process is limited at its start, so a separate process with 16 threads does the work. Sizes
are such that each kernel has more blocks than threads.
"""

import hashlib
import json
import os
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path

import numba
import pytest
import torch
from torch import Tensor

from pipeline.kernels.adam import adam_step_
from pipeline.kernels.blend import SparseWeights, blend
from pipeline.kernels.broyden import find_roots
from pipeline.kernels.composite import composite
from pipeline.kernels.hashgrid import GridLayout, encode
from pipeline.kernels.interpolate import interpolate
from pipeline.kernels.inverse_skinning import bake_warp_grid, newton_step
from pipeline.kernels.march import PackedWarpGrids, Rays, SamplingVolume, march
from pipeline.kernels.raster import rasterize
from pipeline.kernels.texel_projection import (
    ImageView,
    ProjectedMesh,
    ProjectionWeights,
    TexelPoints,
    TexelSums,
    add_projections_,
    project_texels,
)
from pipeline.kernels.texture_sampling import supersample_texture
from pipeline.kernels.transmittance_stats import transmittance_from_weights
from tests.kernels.bar import CELL_M, bar_skin, bend

THREADS = (1, 2, 16)
FRAMES, RAYS = 20, 4000
HEIGHT, WIDTH = 288, 96


def seeded() -> torch.Generator:
    return torch.Generator().manual_seed(1)


def hash_grid_results() -> list[Tensor]:
    cells = ((5, 7, 6), (16, 20, 11), (60, 80, 40), (200, 300, 150), (400, 500, 350))
    layout, random = GridLayout(cells, 4, 12), seeded()
    points = torch.rand(6000, 3, generator=random).requires_grad_(True)
    table = torch.randn(layout.rows, 4, generator=random).requires_grad_(True)
    encoded = encode(points, table, layout)
    grad_output = torch.randn(encoded.shape, generator=random)
    return [encoded, *torch.autograd.grad(encoded, (points, table), grad_output)]


def march_and_newton_results() -> list[Tensor]:
    skin, random = bar_skin(), seeded()
    matrices = torch.stack([bend(float(angle)) for angle in torch.linspace(-1.2, 1.2, FRAMES)])
    warps = PackedWarpGrids.from_grids([bake_warp_grid(skin, pose) for pose in matrices], CELL_M)
    targets = (torch.rand(RAYS, 3, generator=random) - 0.5) * torch.tensor([1.0, 0.4, 0.2])
    origins = torch.tensor([0.0, 0.0, 2.0]).repeat(RAYS, 1)
    directions = torch.nn.functional.normalize(targets - origins, dim=-1)
    frame, jitter = torch.arange(RAYS) * FRAMES // RAYS, torch.rand(RAYS, generator=random)
    occupied, box = torch.ones(8, 4, 4, dtype=torch.uint8), torch.tensor([[-0.6, -0.15, -0.15], [0.6, 0.15, 0.15]])
    samples = march(Rays(origins, directions, frame, jitter), SamplingVolume(warps, occupied, box), 0.02)
    ray = torch.repeat_interleave(torch.arange(RAYS), samples.ray_offsets.diff())
    posed = origins[ray] + samples.distance_m[:, None] * directions[ray]
    frame_offsets = samples.ray_offsets[torch.searchsorted(frame, torch.arange(FRAMES + 1))]
    blended = skin.blend(matrices).requires_grad_(True)
    refined = newton_step(blended, samples.canonical_m, posed, frame_offsets, skin)
    (gradient,) = torch.autograd.grad(refined, blended, torch.randn(refined.shape, generator=random))
    roots, exists = find_roots(posed[:2000], frame[ray[:2000]], matrices, blended.detach(), skin)
    return [samples.canonical_m, samples.distance_m, samples.ray_offsets, refined, gradient, roots, exists]


def composite_results() -> list[Tensor]:
    random, ray_offsets = seeded(), torch.arange(0, 4 * RAYS + 1, 4)
    density = (30 * torch.rand(4 * RAYS, generator=random)).requires_grad_(True)
    colour = torch.rand(4 * RAYS, 3, generator=random).requires_grad_(True)
    image, alpha, weights = composite(density, colour, torch.full((4 * RAYS,), 0.01), ray_offsets)
    gradients = torch.autograd.grad(image.square().sum() + alpha.square().sum(), (density, colour))
    return [image, alpha, weights, transmittance_from_weights(weights, ray_offsets), *gradients]


def blend_results() -> list[Tensor]:
    random = seeded()
    weights = torch.rand(5000, 9, generator=random)
    values = torch.randn(9, 48, generator=random).requires_grad_(True)
    blended = blend(SparseWeights.from_dense(weights * (weights > 0.6)), values)
    return [blended, *torch.autograd.grad(blended, values, torch.randn(blended.shape, generator=random))]


def adam_results() -> list[Tensor]:
    random = seeded()
    parameter, gradient, first, second = (torch.rand(20 << 15, generator=random) for _ in range(4))
    adam_step_(parameter, gradient, first, second, 3, 1e-2)
    return [parameter, first, second]


def raster_results() -> list[Tensor]:
    """A crumpled triangle mesh: rasterised, interpolated, textured and projected."""
    random, columns = seeded(), 20
    y, x = torch.meshgrid(torch.linspace(0, HEIGHT, 40), torch.linspace(0, WIDTH, columns), indexing="ij")
    grid = torch.stack([x.reshape(-1), y.reshape(-1)], dim=1)
    vertices_px = (grid + 4 * torch.rand(grid.shape, generator=random)).requires_grad_(True)
    depth_m = (1 + torch.rand(len(grid), generator=random)).requires_grad_(True)
    attributes = torch.rand(len(grid), 3, generator=random).requires_grad_(True)
    corner = (columns * torch.arange(39)[:, None] + torch.arange(columns - 1)).reshape(-1, 1)
    faces = torch.cat([corner + torch.tensor([0, columns, 1]), corner + torch.tensor([1, columns, columns + 1])]).int()
    face_id, barycentric, depth = rasterize(vertices_px.detach(), depth_m.detach(), faces, HEIGHT, WIDTH)
    covered = torch.nonzero(face_id.reshape(-1) >= 0)[:, 0]
    leaves = vertices_px, depth_m, attributes
    values = interpolate(covered, face_id.reshape(-1)[covered], WIDTH, vertices_px, depth_m, faces, attributes)
    gradients = torch.autograd.grad(values, leaves, torch.randn(values.shape, generator=random))
    texture = torch.rand(64, 64, 3, generator=random)
    textured = supersample_texture(face_id, barycentric, faces, torch.rand(len(grid), 2, generator=random), texture, 2)
    texels = torch.randint(0, len(faces), (4000,), generator=random).int(), torch.full((4000, 3), 1 / 3)
    image, confidence = torch.rand(HEIGHT, WIDTH, 3, generator=random), torch.ones(HEIGHT, WIDTH)
    mesh = ProjectedMesh(vertices_px.detach(), depth_m.detach(), torch.ones(len(grid)), faces)
    view = mesh, TexelPoints(*texels), ImageView(image, depth, confidence)
    sums = TexelSums(torch.zeros(len(texels[0]), image.shape[2]), torch.zeros(len(texels[0])))
    add_projections_(sums, *view, ProjectionWeights(1.0, 2.0))
    return [face_id, barycentric, depth, values, *gradients, textured, *project_texels(*view), *sums]


KERNELS: tuple[Callable[[], list[Tensor]], ...] = (
    hash_grid_results,
    march_and_newton_results,
    composite_results,
    blend_results,
    adam_results,
    raster_results,
)


def digests() -> dict[str, list[str]]:
    """Digest of the results of each kernel, for each number of threads."""
    results: dict[str, list[str]] = {}
    for threads in THREADS:
        numba.set_num_threads(threads)
        for kernel in KERNELS:
            digest = hashlib.sha256()
            for tensor in kernel():
                digest.update(tensor.detach().contiguous().numpy().tobytes())
            results.setdefault(kernel.__name__, []).append(digest.hexdigest())
    return results


@pytest.fixture(scope="module")
def digests_by_kernel(repository: Path) -> dict[str, list[str]]:
    code = "import json; from tests.kernels.test_threads import digests; print(json.dumps(digests()))"
    environment = os.environ | {"NUMBA_NUM_THREADS": str(max(THREADS))}
    command = [sys.executable, "-c", code]
    done = subprocess.run(command, cwd=repository, env=environment, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    return dict(json.loads(done.stdout))


@pytest.mark.parametrize("kernel", KERNELS)
def test_results_do_not_depend_on_thread_count(
    digests_by_kernel: dict[str, list[str]], kernel: Callable[[], list[Tensor]]
) -> None:
    digests_by_threads = digests_by_kernel[kernel.__name__]
    assert len(digests_by_threads) == len(THREADS)
    assert len(set(digests_by_threads)) == 1
