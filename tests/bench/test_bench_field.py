import json
import threading
from functools import partial

import numpy as np
import pytest
import torch

from pipeline.core.errors import UserError
from pipeline.field.baked_inverse_skinning import BakedInverseSkinning
from pipeline.field.config import FieldConfig
from pipeline.field.occupancy import INITIAL_EMA_RATIO
from pipeline.field.trainer import Trainer
from pipeline.kernels.hashgrid import _Encode
from tests.bench import bench_field
from tests.bench.bench_field import (
    PARTS,
    Peaks,
    Work,
    format_table,
    minimum_work,
    occupancy_period,
    time_steps,
    trainer_from_synthetic_body,
    warm_up_step_count,
)
from tests.bench.machine import append_result, machine_info
from tests.bench.parts import REBAKE, TIMED_FUNCTIONS, PartTimer, timed_parts
from tests.field.scene import field_config

TINY = field_config(
    steps=40,
    rays_per_step=512,
    frames_per_step=2,
    max_frames=3,
    max_person_px=64,
    levels=3,
    log2_hashmap_size=12,
    min_clothing_offset_m=0.04,
    step_fraction=0.02,
    occupancy_update_interval=2,
    occupancy_warmup_steps=2,
    pose_start_fraction=0.0,
)


@pytest.fixture(scope="module")
def trainer_and_timing():
    clock = PartTimer()
    with timed_parts(clock):
        trainer = trainer_from_synthetic_body(TINY)
        return trainer, time_steps(trainer, clock, warm_up=2, steps=2)


@pytest.mark.slow
def test_parts_sum_to_the_step(trainer_and_timing):
    _, timing = trainer_and_timing
    assert sum(timing.parts_ms.values()) == pytest.approx(timing.step_ms, rel=0.15)
    assert [part for part, part_ms in timing.parts_ms.items() if part_ms <= 0] == []
    assert timing.samples > 0


@pytest.mark.slow
def test_timers_do_not_change_training(trainer_and_timing):
    timed_trainer, _ = trainer_and_timing
    plain = trainer_from_synthetic_body(TINY)
    for _ in range(4):
        plain.step()
    assert plain.completed_steps == timed_trainer.completed_steps
    expected = timed_trainer.state_dict()
    for name, tensor in plain.state_dict().items():
        assert torch.equal(tensor, expected[name]), name


def test_timed_functions_are_restored():
    before = Trainer.step, _Encode.forward, _Encode.backward
    with timed_parts(PartTimer()):
        assert Trainer.step is not before[0]
    assert (Trainer.step, _Encode.forward, _Encode.backward) == before


def test_rebake_time_is_excluded_from_the_step(monkeypatch):
    """Step 24 of 40 begins with a rebake; with this clock nothing else takes time."""
    trainer, now_s = trainer_from_synthetic_body(TINY), [0.0]
    monkeypatch.setattr(BakedInverseSkinning, "bake", lambda _: now_s.append(now_s[-1] + 1000.0))
    clock = PartTimer(lambda: now_s[-1])
    trainer.completed_steps = 24
    with timed_parts(clock):
        trainer.step()
    taken = clock.pop_seconds()
    assert taken.pop(REBAKE) == 1000.0
    assert sum(taken.values()) == 0.0


def test_every_timed_function_has_a_part():
    assert {part for part, *_ in TIMED_FUNCTIONS} == {*PARTS, REBAKE}


def test_nested_parts_are_not_counted_twice():
    clock = PartTimer(iter(range(100)).__next__)
    inner = clock.timed("inner", lambda: None)
    clock.timed("outer", lambda: (inner(), inner()))()
    assert clock.pop_seconds() == {"outer": 3, "inner": 2}
    clock.timed("occupancy_update", inner)()
    assert clock.pop_seconds() == {"occupancy_update": 1}
    assert clock.pop_seconds() == {}


def test_parallel_parts_share_the_elapsed_time():
    """Two jobs with times 3 and 1, of which "inner" takes 1 and 1, within an elapsed time of 2."""
    now, thread_now = [10.0], threading.local()
    clock = PartTimer(lambda: getattr(thread_now, "s", now[0]))

    def advance(seconds):
        thread_now.s += seconds

    inner = clock.timed("inner", lambda: advance(1.0))

    def job(before_s):
        advance(before_s)
        inner()

    def map_jobs(_, function, times):
        threads = [threading.Thread(target=begin, args=(function, seconds)) for seconds in times]
        for thread in threads:
            thread.start()
            thread.join()
        now[0] += 2.0

    def begin(function, seconds):
        thread_now.s = 0.0
        function(seconds)

    clock.timed("step", lambda: clock.timed_parallel_map("outer", map_jobs)(None, job, [2.0, 0.0]))()
    assert clock.pop_seconds() == {"step": 0.0, "outer": 2.0 * 2 / 4, "inner": 2.0 * 2 / 4}


def test_failing_part_is_timed_and_closed():
    clock = PartTimer(iter(range(100)).__next__)

    def fail():
        raise LookupError

    with pytest.raises(LookupError):
        clock.timed("outer", clock.timed("inner", fail))()
    clock.timed("after", lambda: None)()
    assert clock.pop_seconds() == {"outer": 2, "inner": 1, "after": 1}


def test_lower_bound_is_the_longest_of_three_times():
    peaks = Peaks(memory_gb_s=10, multiply_gflop_s=100, gather_mrow_s=1000)
    assert Work(bytes=1e7).lower_bound_ms(peaks) == pytest.approx(1)
    assert Work(operations=1e8).lower_bound_ms(peaks) == pytest.approx(1)
    assert Work(rows=1e6).lower_bound_ms(peaks) == pytest.approx(1)
    assert Work(bytes=1e7, operations=3e8, rows=2e6).lower_bound_ms(peaks) == pytest.approx(3)


@pytest.mark.slow
def test_minimum_work_of_a_step(trainer_and_timing):
    trainer, _ = trainer_and_timing
    work = minimum_work(trainer, samples=1000)
    assert set(work) == set(PARTS)
    march, newton, grid, network, _ = work["render_rays"]
    empty = len(trainer.occupancy.empty_cells) / trainer.occupancy.occupied.numel()
    unobserved = TINY.settings.unobserved_points if len(trainer.occupancy.unobserved) else 0
    points = 1000 + round(TINY.settings.empty_points * empty) + unobserved
    assert grid.rows == pytest.approx(8 * 3 * points)
    assert (march.rows, newton.rows) == (8000, 1000)
    assert network.operations == pytest.approx(2 * points * (12 * 32 + 32 * 4))
    assert work["adam"][0].bytes == 32 * (trainer.field.table.numel() + 12 * 32 + 32 * 4 + 4)
    assert work["render_backward"][1].rows == pytest.approx(8 * 3 * points + 1000)


def test_warm_up_covers_pose_refinement_and_occupancy():
    config = FieldConfig()
    assert occupancy_period(config) == 8
    updates = (
        warm_up_step_count(config) - config.settings.occupancy_warmup_steps
    ) // config.settings.occupancy_update_interval
    assert INITIAL_EMA_RATIO * config.settings.occupancy_decay**updates <= 1
    assert warm_up_step_count(config) % 8 == 0
    assert warm_up_step_count(FieldConfig(steps=4000)) == 400


@pytest.mark.slow
def test_command_prints_and_writes_results(tmp_path, monkeypatch, capsys):
    monkeypatch.setattr(bench_field, "append_result", partial(append_result, folder=tmp_path))
    monkeypatch.setattr(bench_field, "build_config", lambda *_: TINY)
    monkeypatch.setattr(bench_field, "memory_gb_s", lambda *_: 10.0)
    monkeypatch.setattr(bench_field, "multiply_gflop_s", lambda *_: 100.0)
    path = tmp_path / "out.json"
    bench_field.main(["--steps", "2", "--warm-up", "0", "--repeats", "1", "--json", str(path)])
    results = json.loads(path.read_text())
    assert results["step_ms"] > 0
    assert results["lower_bound_ms"] == pytest.approx(sum(results[f"{part}_lower_bound_ms"] for part in PARTS))
    assert np.isfinite(results["samples"])
    assert results.items() >= (machine_info() | {"seed": 0, "capture": "synthetic", "runs": 0}).items()
    assert results["rebake_ms"] > 0
    assert format_table(results) in capsys.readouterr().out
    assert len(list(tmp_path.glob("*.csv"))) == 1


def test_preset_without_hash_grid_is_rejected():
    with pytest.raises(UserError, match="hash grid"):
        bench_field.main(["--preset", "animnerf"])
