import json
import threading
from functools import partial

import numpy as np
import pytest
import torch

from pipeline.core.errors import UserError
from pipeline.field.config import FieldConfig
from pipeline.field.occupancy import GRACE
from pipeline.field.trainer import Learning
from pipeline.kernels.hashgrid import _Encode
from tests.bench import bench_field
from tests.bench.bench_field import PARTS, Peaks, Work, begin_painted, least_work, period, settled, table, time_steps
from tests.bench.machine import circumstances, keep
from tests.bench.parts import REBAKE, SEAMS, Clock, watched

TINY = FieldConfig(
    steps=40,
    rays=512,
    frames_per_step=2,
    max_frames=3,
    max_person_px=64,
    levels=3,
    log2_rows=12,
    margin_m=0.04,
    step_fraction=0.02,
    occupancy_every=2,
    occupancy_start=2,
    pose_start=0.0,
)


@pytest.fixture(scope="module")
def learning_and_timing():
    clock = Clock()
    with watched(clock):
        learning = begin_painted(TINY)
        return learning, time_steps(learning, clock, warm_up=2, steps=2)


def test_parts_sum_to_the_step(learning_and_timing):
    _, timing = learning_and_timing
    assert sum(timing.parts_ms.values()) == pytest.approx(timing.step_ms, rel=0.15)
    assert [part for part, spent_ms in timing.parts_ms.items() if spent_ms <= 0] == []
    assert timing.samples > 0


def test_watching_changes_nothing_that_is_learnt(learning_and_timing):
    watched_one, _ = learning_and_timing
    plain = begin_painted(TINY)
    for _ in range(4):
        plain.step()
    assert plain.done == watched_one.done
    expected = watched_one.state()
    for name, tensor in plain.state().items():
        assert torch.equal(tensor, expected[name]), name


def test_the_seams_are_as_they_were_afterwards():
    before = Learning.step, _Encode.forward, _Encode.backward
    with watched(Clock()):
        assert Learning.step is not before[0]
    assert (Learning.step, _Encode.forward, _Encode.backward) == before


def test_a_rebake_counts_for_no_part_of_a_step(monkeypatch):
    """Step 24 of 40 begins with one; by this clock nothing else takes time."""
    learning, now_s = begin_painted(TINY), [0.0]
    monkeypatch.setattr(Learning, "_bake", lambda _: now_s.append(now_s[-1] + 1000.0))
    clock = Clock(lambda: now_s[-1])
    learning.done = 24
    with watched(clock):
        learning.step()
    taken = clock.take()
    assert taken.pop(REBAKE) == 1000.0
    assert sum(taken.values()) == 0.0


def test_every_seam_has_a_part():
    assert {part for part, *_ in SEAMS} == {*PARTS, REBAKE}


def test_a_clock_counts_each_moment_once():
    clock = Clock(iter(range(100)).__next__)
    inner = clock.timed("inner", lambda: None)
    clock.timed("outer", lambda: (inner(), inner()))()
    assert clock.take() == {"outer": 3, "inner": 2}
    clock.timed("occupancy_update", inner)()
    assert clock.take() == {"occupancy_update": 1}
    assert clock.take() == {}


def test_what_is_done_at_the_same_time_shares_the_time_that_it_takes():
    """Two jobs whose own times are 3 and 1 and of which "inner" takes 1 and 1, in a time of 2 by the step's clock."""
    now, thread_now = [10.0], threading.local()
    clock = Clock(lambda: getattr(thread_now, "s", now[0]))

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

    clock.timed("step", lambda: clock.shared("outer", map_jobs)(None, job, [2.0, 0.0]))()
    assert clock.take() == {"step": 0.0, "outer": 2.0 * 2 / 4, "inner": 2.0 * 2 / 4}


def test_a_part_that_fails_is_counted_and_left():
    clock = Clock(iter(range(100)).__next__)

    def fail():
        raise LookupError

    with pytest.raises(LookupError):
        clock.timed("outer", clock.timed("inner", fail))()
    clock.timed("after", lambda: None)()
    assert clock.take() == {"outer": 2, "inner": 1, "after": 1}


def test_the_floor_is_the_longest_of_three_times():
    peaks = Peaks(memory_gb_s=10, multiply_gflop_s=100, gather_mrow_s=1000)
    assert Work(bytes=1e7).least_ms(peaks) == pytest.approx(1)
    assert Work(operations=1e8).least_ms(peaks) == pytest.approx(1)
    assert Work(rows=1e6).least_ms(peaks) == pytest.approx(1)
    assert Work(bytes=1e7, operations=3e8, rows=2e6).least_ms(peaks) == pytest.approx(3)


def test_the_work_of_a_step(learning_and_timing):
    learning, _ = learning_and_timing
    work = least_work(learning, samples=1000)
    assert set(work) == set(PARTS)
    march, newton, grid, network, _ = work["look"]
    empty = len(learning.occupancy.empty) / learning.occupancy.occupied.numel()
    unproven = TINY.unproven_points if len(learning.occupancy.unproven) else 0
    points = 1000 + round(TINY.empty_points * empty) + unproven
    assert grid.rows == pytest.approx(8 * 3 * points)
    assert march.rows == newton.rows == 8000
    assert network.operations == pytest.approx(2 * points * (12 * 32 + 32 * 4))
    assert work["adam"][0].bytes == 32 * (learning.field.table.numel() + 12 * 32 + 32 * 4 + 4)
    assert work["positions_backward"][0].rows == pytest.approx(8 * 3 * points + 24 * 1000)


def test_warm_up_lasts_until_poses_move_and_cells_are_given_up():
    config = FieldConfig()
    assert period(config) == 8
    updates = (settled(config) - config.occupancy_start) // config.occupancy_every
    assert GRACE * config.occupancy_decay**updates <= 1
    assert settled(config) % 8 == 0
    assert settled(FieldConfig(steps=4000)) == 400


def test_the_command_prints_and_writes(tmp_path, monkeypatch, capsys):
    monkeypatch.setattr(bench_field, "keep", partial(keep, folder=tmp_path))
    monkeypatch.setattr(bench_field, "build", lambda *_: TINY)
    monkeypatch.setattr(bench_field, "memory_gb_s", lambda *_: 10.0)
    monkeypatch.setattr(bench_field, "multiply_gflop_s", lambda *_: 100.0)
    path = tmp_path / "out.json"
    bench_field.main(["--steps", "2", "--warm-up", "0", "--repeats", "1", "--json", str(path)])
    figures = json.loads(path.read_text())
    assert figures["step_ms"] > 0
    assert figures["floor_ms"] == pytest.approx(sum(figures[f"{part}_floor_ms"] for part in PARTS))
    assert np.isfinite(figures["samples"])
    assert figures.items() >= (circumstances() | {"seed": 0, "capture": "painted", "runs": 0}).items()
    assert figures["rebake_ms"] > 0
    assert table(figures) in capsys.readouterr().out
    assert len(list(tmp_path.glob("*.csv"))) == 1


def test_a_field_without_a_hash_grid_is_refused():
    with pytest.raises(UserError, match="hash grid"):
        bench_field.main(["--preset", "animnerf"])
