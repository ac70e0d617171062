"""Time of each part of a training step of the field, and a lower bound of that time on this machine.

    python -m tests.bench.bench_field [--run runs/x ...] [--baseline runs/y ...] [--preset default] [--json out.json]

With finished runs, quality metrics are added: see `tests.bench.quality`.

The step uses frames and body of the first run, or a synthetic body. Warm-up steps come first, until poses are refined
and permanently empty cells are marked empty. The occupancy is updated only every few steps: a block has as many steps
as its period, and the time of a part is the median over blocks of its mean in a block. Parts that threads run
concurrently share the elapsed time. The median excludes the few steps that begin with a rebake of the warp grids;
rebake_ms is the time of one rebake. A row is appended to tests/bench/results/<machine>.csv.

The lower bound of a part is the longest of three times, each at a rate that is measured in the same run: bytes at the
rate of a copy of the size of the table with its gradient and moments; multiplications and additions at the rate of a
large matrix product; table rows at the rate of random rows of a table of the size of the largest level. Consecutive
rows, as for neighbouring samples, load faster: a part can be faster than a bound by rows. With n rays, s samples, p
points (the samples, and points that should be empty), l levels of f features, w = l f, hidden width h, and for poses j
joints, m nodes:

| part | work of a step |
|---|---|
| pixel_sampling | 84 n bytes: pixel and colour read; origin, direction, colour, background, jitter, frame written |
| poses | none: kinematics of the frames of the step |
| render_rays: march | 8 s rows of a warp grid, 16 s bytes written |
| render_rays: Newton | s rows of skin weights, 40 s bytes |
| render_rays: hash grid | 8 l p rows, (12 + 4 w) p bytes |
| render_rays: network | 2 (w h + 4 h) p operations, (4 w + 16) p bytes |
| render_rays: compositing | 32 s + 24 n bytes |
| losses | 44 n bytes |
| render_backward: network | twice the network's operations in render_rays, (8 w + 32) p + 32 s + 68 n bytes |
| render_backward: positions | 8 l p rows, and s rows of skin weights for Newton |
| table_backward | 16 l p rows: each is read and written |
| rest_backward | none: kinematics |
| adam | 32 bytes for each parameter |
| occupancy_record | 4 s rows, 24 s bytes |
| occupancy_update | hash grid and network of one point in each cell |
| skin_grid_crop | 8 m j bytes: the weights near occupied cells, copied |
| other | none: concatenation, opacities, sums |

The work of occupancy_update and skin_grid_crop is divided by the number of steps between two of them.
"""

import argparse
import math
import sys
import time
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from data_tools.command import run_command
from pipeline.body.files import load_body, load_camera, load_motion
from pipeline.capture.capture import load_capture
from pipeline.capture.frame_selection import evenly_spaced
from pipeline.capture.usable_frames import usable_positions
from pipeline.core.config import build_config, load_layers
from pipeline.core.errors import UserError
from pipeline.core.progress import warn
from pipeline.field.config import FieldConfig
from pipeline.field.occupancy import INITIAL_EMA_RATIO
from pipeline.field.setup import create_trainer, training_scale
from pipeline.field.trainer import REBAKE_FRACTIONS, Trainer
from stages.field import read_masked_image
from tests.bench.machine import append_result, gather_mrow_s, machine_info, median_ms, memory_gb_s, multiply_gflop_s
from tests.bench.parts import OTHER, REBAKE, UPDATE, PartTimer, timed_parts
from tests.bench.quality import compare_quality
from tests.field.scene import painted_scene

PARTS = (
    "pixel_sampling",
    "poses",
    "render_rays",
    "losses",
    "render_backward",
    "table_backward",
    "rest_backward",
    "adam",
    "occupancy_record",
    UPDATE,
    "skin_grid_crop",
    OTHER,
)
SYNTHETIC_FRAMES = 32
BAKE_REPEATS = 3
"""Number of timed rebakes."""
IMAGE_HEIGHT_RATIO = 1.25
"""Approximate ratio of the height of a synthetic image to the height of the person in it."""


@dataclass(frozen=True)
class Peaks:
    """Peak rates of this machine."""

    memory_gb_s: float
    multiply_gflop_s: float
    gather_mrow_s: float


@dataclass(frozen=True)
class Work:
    """Minimum work of a part: bytes of memory traffic, arithmetic operations, random table rows."""

    bytes: float = 0.0
    operations: float = 0.0
    rows: float = 0.0

    def lower_bound_ms(self, peaks: Peaks) -> float:
        """Return the longest of the three times: at best the others overlap with it."""
        seconds = (self.bytes / peaks.memory_gb_s, self.operations / peaks.multiply_gflop_s)
        return max(*(value / 1e6 for value in seconds), self.rows / peaks.gather_mrow_s / 1e3)


@dataclass(frozen=True)
class Timing:
    """Milliseconds of a step and of each of its parts, and the mean number of samples."""

    step_ms: float
    parts_ms: dict[str, float]
    samples: float


def trainer_from_run(run: Path, config: FieldConfig) -> Trainer:
    """Create the trainer of a finished run, at its first step."""
    capture, camera = load_capture(run / "frames"), load_camera(run / "body" / "camera.npz")
    body, motion = load_body(run / "body" / "body.npz"), load_motion(run / "body" / "motion.npz")
    camera = camera.scaled(training_scale(body, motion, camera, config.max_person_px))
    chosen = usable_positions(capture, run / "body")
    chosen = chosen[evenly_spaced(len(chosen), config.max_frames)]
    masked_images = [read_masked_image(capture, position, camera) for position in chosen]
    return create_trainer(body, motion.select(chosen), camera, masked_images, config)


def trainer_from_synthetic_body(config: FieldConfig) -> Trainer:
    """Create a trainer on images of a rotating synthetic body, at the maximum height of the preset."""
    scene = painted_scene(min(SYNTHETIC_FRAMES, config.max_frames), round(IMAGE_HEIGHT_RATIO * config.max_person_px))
    masked_images = list(zip(scene.images, scene.masks, strict=True))
    return create_trainer(scene.body, scene.motion, scene.camera, masked_images, config)


def occupancy_period(config: FieldConfig) -> int:
    """Return the number of steps between two updates of the occupancy."""
    return config.settings.occupancy_update_interval


def warm_up_step_count(config: FieldConfig) -> int:
    """Return the steps until poses are refined and an always empty cell is marked empty; a multiple of the period."""
    updates = math.ceil(math.log(1 / INITIAL_EMA_RATIO) / math.log(config.settings.occupancy_decay))
    emptied = config.settings.occupancy_warmup_steps + updates * config.settings.occupancy_update_interval
    poses = math.ceil(config.settings.pose_start_fraction * config.steps) if config.pose_refinement else 0
    return math.ceil(max(emptied, poses) / occupancy_period(config)) * occupancy_period(config)


def time_steps(trainer: Trainer, clock: PartTimer, warm_up: int, steps: int) -> Timing:
    """Run and time steps; `trainer` was created within `timed_parts(clock)`."""
    for _ in range(warm_up):
        trainer.step()
    clock.pop_seconds()
    length = min(occupancy_period(trainer.config), steps)
    blocks, step_seconds, samples = [], [], []
    for _ in range(max(1, steps // length)):
        start = time.perf_counter()
        samples += [trainer.step()["samples"] for _ in range(length)]
        step_seconds.append((time.perf_counter() - start) / length)
        taken = clock.pop_seconds()
        blocks.append([1e3 * taken.get(part, 0.0) / length for part in PARTS])
    medians = np.median(np.array(blocks), axis=0).tolist()
    return Timing(1e3 * float(np.median(step_seconds)), dict(zip(PARTS, medians, strict=True)), float(np.mean(samples)))


def minimum_work(trainer: Trainer, samples: float) -> dict[str, tuple[Work, ...]]:
    """Return the table above for the current state of `trainer`: the consecutive pieces of work of each part."""
    config, field, occupancy = trainer.config, trainer.field, trainer.occupancy
    n, levels, hidden = config.rays_per_step, field.layout.levels, config.settings.hidden_width
    point_counts = (config.settings.empty_points, config.settings.unobserved_points)
    points = samples + len(occupancy.sample_empty_points(*point_counts, np.random.default_rng(0)))
    width = len(field.hidden)
    refines = float(trainer.refines_poses)
    refined = refines * samples
    network = 2.0 * (width * hidden + 4 * hidden)
    cells = len(occupancy.candidate_cells) / config.settings.occupancy_update_interval
    render_rays = (
        Work(bytes=16 * samples, rows=8 * samples),
        Work(bytes=40 * refined, rows=refined),
        Work(bytes=(12 + 4 * width) * points, rows=8 * levels * points),
        Work(bytes=(4 * width + 16) * points, operations=network * points),
        Work(bytes=32 * samples + 24 * n),
    )
    return {
        "pixel_sampling": (Work(bytes=84.0 * n),),
        "poses": (),
        "render_rays": render_rays,
        "losses": (Work(bytes=44.0 * n),),
        "render_backward": (
            Work(bytes=(8 * width + 32) * points + 32 * samples + 68.0 * n, operations=2 * network * points),
            Work(rows=refines * (8 * levels * points + samples)),
        ),
        "table_backward": (Work(rows=16 * levels * points),),
        "rest_backward": (),
        "adam": (Work(bytes=32.0 * sum(parameter.numel() for parameter in field.parameters())),),
        "occupancy_record": (Work(bytes=24 * samples, rows=4 * samples),),
        UPDATE: (Work(bytes=(12 + 4 * width) * cells, operations=network * cells, rows=8 * levels * cells),),
        "skin_grid_crop": (
            Work(bytes=8.0 * trainer.inverse_skinning.skin.weights.numel() / config.settings.occupancy_update_interval),
        ),
        OTHER: (),
    }


def measure(trainer: Trainer, clock: PartTimer, warm_up: int, steps: int, repeats: int) -> dict[str, float]:
    """Measure the step, its parts, a rebake and the peak rates; return them with the lower bounds of the parts."""
    timing = time_steps(trainer, clock, warm_up, steps)
    rows = max(trainer.field.layout.rows_per_level, default=1 << 17)
    peaks = Peaks(
        memory_gb_s(repeats, 4 * max(trainer.field.table.nbytes, 1 << 20)),
        multiply_gflop_s(repeats),
        gather_mrow_s(rows, trainer.field.layout.features, repeats),
    )
    work = minimum_work(trainer, timing.samples)
    bounds = {part: sum(one.lower_bound_ms(peaks) for one in work[part]) for part in PARTS}
    results = {"step_ms": timing.step_ms, "lower_bound_ms": sum(bounds.values()), "samples": timing.samples}
    results |= {f"{part}_ms": timing.parts_ms[part] for part in PARTS}
    results[f"{REBAKE}_ms"] = median_ms(trainer.inverse_skinning.bake, BAKE_REPEATS)
    return results | {f"{part}_lower_bound_ms": bounds[part] for part in PARTS} | vars(peaks)


def format_table(results: dict[str, float]) -> str:
    """Return a table of part, milliseconds, lower bound and ratio, and the time of a rebake."""
    lines = [f"{'part':20s} {'ms':>8s} {'bound ms':>9s} {'ratio':>6s}"]
    for name in (*PARTS, "step"):
        measured, bound = (
            results[f"{name}_ms"],
            results["lower_bound_ms" if name == "step" else f"{name}_lower_bound_ms"],
        )
        lines.append(f"{name:20s} {measured:8.2f} {bound:9.2f} {f'{measured / bound:.1f}' if bound else '-':>6s}")
    lines.append(
        f"{REBAKE:20s} {results[f'{REBAKE}_ms']:8.2f} each; {len(REBAKE_FRACTIONS)} in a training, not included above"
    )
    return "\n".join(lines)


def main(argv: Sequence[str]) -> None:
    """Measure, print the table, append the results."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("--run", type=Path, nargs="+", default=[], help="finished runs; default: a synthetic body")
    parser.add_argument(
        "--baseline", type=Path, nargs="+", default=[], help="finished runs of another preset on the same videos"
    )
    parser.add_argument("--preset", default="default", help="preset of the field options")
    parser.add_argument("--warm-up", type=int, help="steps before the measurement")
    parser.add_argument("--steps", type=int, default=80, help="measured steps")
    parser.add_argument("--json", type=Path, help="file for the results")
    parser.add_argument("--repeats", type=int, default=15, help="timed runs for each peak rate")
    options = parser.parse_args(argv)
    config = build_config("field", FieldConfig, load_layers(options.preset, {}))
    if config.settings.network != "hashgrid":
        raise UserError(f"preset {options.preset} has no hash grid, which the lower bounds are for; use PRESET=default")
    quality_metrics, reasons = compare_quality(options.run, options.baseline)
    warm_up = warm_up_step_count(config) if options.warm_up is None else options.warm_up
    clock = PartTimer()
    with timed_parts(clock):
        trainer = trainer_from_run(options.run[0], config) if options.run else trainer_from_synthetic_body(config)
        results = measure(trainer, clock, warm_up, options.steps, options.repeats)
    for reason in reasons:
        warn(reason)
    run_info = {
        "preset": options.preset,
        "seed": config.seed,
        "capture": str(options.run[0]) if options.run else "synthetic",
        "runs": len(options.run),
        "baselines": len(options.baseline),
        "warm_up": warm_up,
        "steps": options.steps,
    }
    print(format_table(results))
    print(", ".join(f"{name} {value}" for name, value in (machine_info() | run_info | quality_metrics).items()))
    path = append_result("field", run_info | results | quality_metrics, options.json)
    print(f"samples a step {results['samples']:.0f}; row appended to {path}")


if __name__ == "__main__":
    sys.exit(run_command(main, sys.argv[1:]))
