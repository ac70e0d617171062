"""The cost of a stage by parts: parts follow the stage's loops and add up, files are counted, the table names all."""

import os
import sys
import time
from pathlib import Path

import pytest

from pipeline.core.config import Config
from pipeline.core.progress import track
from pipeline.core.stage import Stage
from tests.bench.bench_way import REST, START_UP, Part, StageCost, format_table, measure_stage

SIZE = 300_000


def run_toy(inputs, out: Path, config: Config):
    """Sleep before and in a loop, compute in another, write and read a file after both."""
    time.sleep(0.05)
    for _ in track(range(2), "sleeping"):
        time.sleep(0.05)
    end_s = time.process_time() + 0.2
    for _ in track(range(1), "computing"):
        while time.process_time() < end_s:
            pass
    path = out / "bytes"
    path.write_bytes(os.urandom(SIZE))
    path.read_bytes()
    return {}


def test_parts_follow_the_loops_and_files_are_counted(tmp_path):
    toy = Stage("toy", version=1, needs=(), makes=(), config=Config, run=run_toy)
    cost = measure_stage(toy, {}, tmp_path, Config(), Part(START_UP, 2.0, 1.0))
    assert [part.name for part in cost.parts] == [START_UP, "sleeping", "computing", REST]
    _, sleeping, computing, rest = cost.parts
    assert sleeping.seconds >= 0.15 > 0.1 > sleeping.cpu_seconds
    assert computing.cpu_seconds >= 0.19
    assert rest.seconds < 0.2
    assert cost.seconds == pytest.approx(2.0 + sum(part.seconds for part in cost.parts[1:]))
    assert cost.cpu_seconds > 1.19
    assert cost.peak_mib > 20
    if sys.platform == "linux":
        assert SIZE <= cost.read_bytes < 2 * SIZE
        assert SIZE <= cost.written_bytes < 2 * SIZE


def test_table_has_the_parts_that_matter_and_the_floor():
    parts = (Part(START_UP, 1.0, 1.0), Part("much", 8.0, 12.0), Part("little", 0.01, 0.01))
    text = format_table([StageCost("toy", parts, 512.0, 3_000_000_000, 1_000_000_000)], copy_gb_s=2.0)
    assert "much" in text
    assert "little" not in text
    row = next(line for line in text.splitlines() if line.startswith("toy")).split()
    assert row[1:] == ["9.0", "13.0", "512", "3000", "2.00"]
