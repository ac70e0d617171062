"""Shared by the benchmarks: medians, peak rates of this machine, and the table of results."""

import csv
import json
import platform
import time
from collections.abc import Callable, Mapping
from itertools import chain
from pathlib import Path

import numpy as np
import torch
from numba import get_num_threads

from pipeline.core.measure import cpu_name, describe_environment

RESULTS = Path(__file__).parent / "results"
CORNERS = 8
"""Rows that are summed at a time, as for the corners of a grid cell."""


def median_ms(run: Callable[[], object], repeats: int) -> float:
    """Return the median time of warm runs."""
    run()
    times = []
    for _ in range(repeats):
        start = time.perf_counter()
        run()
        times.append(time.perf_counter() - start)
    return 1e3 * float(np.median(times))


def memory_gb_s(repeats: int, touched_bytes: int = 1 << 28) -> float:
    """Measure the bandwidth of a copy; source and target have `touched_bytes` together, by default more than caches."""
    source, target = torch.ones(touched_bytes // 8), torch.empty(touched_bytes // 8)
    return 2 * source.numel() * 4 / 1e6 / median_ms(lambda: target.copy_(source), repeats)


def multiply_gflop_s(repeats: int) -> float:
    """Measure the rate of a large matrix product."""
    a, b = torch.rand(2048, 2048), torch.rand(2048, 2048)
    return 2 * 2048**3 / 1e6 / median_ms(lambda: a @ b, repeats)


def gather_mrow_s(rows: int, features: int, repeats: int) -> float:
    """Measure the rate of loading random rows of a float32 table, in groups of eight that are summed (Mrow/s)."""
    random = torch.Generator().manual_seed(0)
    table = torch.rand(rows, features, generator=random)
    drawn = torch.randint(rows, (1 << 16, CORNERS), generator=random, dtype=torch.int32)
    add = torch.nn.functional.embedding_bag
    return drawn.numel() / 1e3 / median_ms(lambda: add(drawn, table, mode="sum"), repeats)


def machine_info() -> dict[str, str | int]:
    """Return commit, machine and numbers of threads."""
    return {
        "commit": describe_environment()["commit"] or "unknown",
        "machine": platform.node(),
        "cpu": cpu_name(),
        "threads": torch.get_num_threads(),
        "kernel_threads": get_num_threads(),
    }


def append_result(
    bench: str, results: Mapping[str, object], json_path: Path | None = None, folder: Path = RESULTS
) -> Path:
    """Append a row to the machine's table, which has the columns of all benchmarks; return the path of the table.

    json_path: additional file for the same row, not rounded.
    """
    row = {"bench": bench} | machine_info() | results
    if json_path:
        json_path.write_text(json.dumps(row, indent=2) + "\n", encoding="utf-8")
    folder.mkdir(exist_ok=True)
    path = folder / f"{platform.node()}.csv"
    rows: list[Mapping[str, object]] = []
    if path.exists():
        with path.open(newline="", encoding="utf-8") as stream:
            rows = list(csv.DictReader(stream))
    rows.append({name: round(value, 3) if isinstance(value, float) else value for name, value in row.items()})
    with path.open("w", newline="", encoding="utf-8") as stream:
        writer = csv.DictWriter(stream, list(dict.fromkeys(chain.from_iterable(rows))), restval="")
        writer.writeheader()
        writer.writerows(rows)
    return path
