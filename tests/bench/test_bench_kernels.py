import json
from functools import partial

import pytest

from tests.bench import bench_kernels
from tests.bench.machine import append_result, machine_info


@pytest.mark.slow
def test_kernels(capsys):
    figures = bench_kernels.field_parts(bench_kernels.FieldConfig(), 7) | bench_kernels.warp_parts(7)
    with capsys.disabled():
        for name, value in figures.items():
            print(f"{name:32s} {value:10.2f}")
    assert all(value > 0 for value in figures.values())


def test_the_command_prints_and_writes(tmp_path, monkeypatch, capsys):
    monkeypatch.setattr(bench_kernels, "append_result", partial(append_result, folder=tmp_path))
    for name in ("field_parts", "warp_parts"):
        monkeypatch.setattr(bench_kernels, name, lambda *_, name=name: {f"{name}_ms": 2.5})
    for name in ("memory_gb_s", "multiply_gflop_s"):
        monkeypatch.setattr(bench_kernels, name, lambda _: 10.0)
    path = tmp_path / "out.json"
    bench_kernels.main(["--repeats", "1", "--json", str(path)])
    figures = json.loads(path.read_text())
    assert figures.items() >= (machine_info() | {"seed": 0, "repeats": 1, "memory_gb_s": 10.0}).items()
    assert figures["field_parts_ms"] == figures["warp_parts_ms"] == 2.5
    assert "warp_parts_ms" in capsys.readouterr().out
    assert len(list(tmp_path.glob("*.csv"))) == 1
