"""Milliseconds of the kernels of field training on synthetic data of the default preset's size, and machine peaks.

    python -m tests.bench.bench_kernels [--json out.json] [--repeats 15]

Medians of warm runs, on an otherwise idle machine. A row is appended to tests/bench/results/<machine>.csv.
`tests.bench.bench_field` measures a complete training step and the lower bound of each of its parts.
"""

import argparse
from collections.abc import Sequence
from pathlib import Path

import numpy as np
import torch

from pipeline.field.config import FieldConfig
from pipeline.field.field import RadianceField, hash_grid_layout
from pipeline.kernels.adam import adam_step_
from pipeline.kernels.composite import composite
from pipeline.kernels.hashgrid import FeatureGradients, add_table_gradient_, encode
from pipeline.kernels.inverse_skinning import bake_warp_grid, newton_step
from pipeline.kernels.march import PackedWarpGrids, Rays, SamplingVolume, march
from tests.bench.machine import append_result, median_ms, memory_gb_s, multiply_gflop_s
from tests.kernels.bar import CELL_M, bar_skin, bend

BOUNDS = np.array([[-0.8, -0.1, -0.3], [0.8, 1.9, 0.5]], dtype=np.float32)
RAYS, SAMPLES_PER_RAY = 4096, 16
SEED = 0
"""Seed of the synthetic data."""


def ray_points(random: torch.Generator) -> torch.Tensor:
    """Return samples along short ray segments in the unit box, as near a surface."""
    start = torch.rand(RAYS, 1, 3, generator=random) * 0.8 + 0.1
    direction = torch.nn.functional.normalize(torch.randn(RAYS, 1, 3, generator=random), dim=-1)
    reach = torch.linspace(0, 0.06, SAMPLES_PER_RAY)[None, :, None]
    return (start + reach * direction).reshape(-1, 3).clamp(0, 1)


def field_parts(config: FieldConfig, repeats: int) -> dict[str, float]:
    """Measure encoding, network, compositing and Adam, forward and backward."""
    random = torch.Generator().manual_seed(SEED)
    layout = hash_grid_layout(
        BOUNDS, 0.003, config.settings.levels, config.settings.features_per_level, config.log2_hashmap_size
    )
    field = RadianceField(BOUNDS, layout, config.settings.hidden_width)
    points, sums = ray_points(random), torch.zeros_like(field.table)
    features = encode(points, field.table, layout)
    grad_output = torch.randn(features.shape, generator=random)
    low, high = field.bounds_m
    placed = points * (high - low) + low
    colour, density = field.radiance(placed)
    ray_offsets = torch.arange(0, len(points) + 1, SAMPLES_PER_RAY)
    step_m = torch.full((len(points),), 0.004)

    def shade() -> None:
        inputs = (density.detach().requires_grad_(True), colour.detach().requires_grad_(True))
        image, alpha, _ = composite(*inputs, step_m, ray_offsets)
        (image.sum() + alpha.sum()).backward()

    def whole() -> None:
        feature_gradients: FeatureGradients = []
        rgb, sigma = field.radiance(placed, feature_gradients)
        (rgb.sum() + sigma.sum()).backward()
        add_table_gradient_(sums, feature_gradients, layout)

    def back() -> None:
        feature_gradients: FeatureGradients = []
        encode(points, field.table, layout, feature_gradients).backward(grad_output)
        add_table_gradient_(sums, feature_gradients, layout)

    moments = torch.zeros_like(field.table), torch.zeros_like(field.table)
    with torch.no_grad():
        forward = median_ms(lambda: encode(points, field.table, layout), repeats)
    return {
        "encode_forward_ms": forward,
        "encode_backward_ms": median_ms(back, repeats) - forward,
        "field_forward_backward_ms": median_ms(whole, repeats),
        "composite_ms": median_ms(shade, repeats),
        "adam_ms": median_ms(lambda: adam_step_(field.table, sums, *moments, 1, 1e-3), repeats),
    }


def warp_parts(repeats: int) -> dict[str, float]:
    """Measure warp-grid baking, ray marching and one Newton step with its gradient, on a bent bar."""
    skin, matrices = bar_skin(half_length_m=0.9, half_width_m=0.3), bend(0.6)
    warps = PackedWarpGrids.from_grids([bake_warp_grid(skin, matrices)], CELL_M)
    random = torch.Generator().manual_seed(SEED)
    targets = (torch.rand(RAYS, 3, generator=random) - 0.5) * torch.tensor([0.8, 0.2, 0.0])
    origins = torch.tensor([0.0, 0.0, 3.0]).expand(RAYS, 3).contiguous()
    directions = torch.nn.functional.normalize(targets - origins, dim=-1)
    box = torch.tensor([[-0.9, -0.3, -0.1], [0.9, 0.3, 0.1]])
    occupied = torch.ones(64, 64, 64, dtype=torch.uint8)
    rays = Rays(origins, directions, torch.zeros(RAYS, dtype=torch.long), torch.rand(RAYS, generator=random))

    def march_rays():
        return march(rays, SamplingVolume(warps, occupied, box), 0.2 / SAMPLES_PER_RAY)

    samples = march_rays()
    ray = torch.repeat_interleave(torch.arange(RAYS), samples.ray_offsets.diff())
    posed = origins[ray] + samples.distance_m[:, None] * directions[ray]
    slots = torch.tensor([0, len(ray)])
    blended = skin.blend(matrices[None]).requires_grad_(True)
    return {
        "bake_frame_ms": median_ms(lambda: bake_warp_grid(skin, matrices), max(3, repeats // 3)),
        "march_ms": median_ms(march_rays, repeats),
        "newton_and_pose_gradient_ms": median_ms(
            lambda: newton_step(blended, samples.canonical_m, posed, slots, skin).sum().backward(), repeats
        ),
        "march_samples": float(len(ray)),
    }


def main(argv: Sequence[str] | None = None) -> None:
    """Measure, print the results, append them to the table."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("--json", type=Path, help="file for the results")
    parser.add_argument("--repeats", type=int, default=15, help="timed runs of each kernel")
    arguments = parser.parse_args(argv)
    results = {"memory_gb_s": memory_gb_s(arguments.repeats), "multiply_gflop_s": multiply_gflop_s(arguments.repeats)}
    results |= field_parts(FieldConfig(), arguments.repeats) | warp_parts(arguments.repeats)
    for name, value in results.items():
        print(f"{name:32s} {value:10.2f}")
    print(append_result("kernels", {"seed": SEED, "repeats": arguments.repeats} | results, arguments.json))


if __name__ == "__main__":
    main()
