import json
from functools import partial

import pytest

from tests.bench import bench_kernels
from tests.bench.machine import append_result, machine_info


@pytest.mark.slow
def test_kernels(capsys):
    results = bench_kernels.field_parts(bench_kernels.FieldConfig(), 7) | bench_kernels.warp_parts(7)
    with capsys.disabled():
        for name, value in results.items():
            print(f"{name:32s} {value:10.2f}")
    assert all(value > 0 for value in results.values())


def test_command_prints_and_writes_results(tmp_path, monkeypatch, capsys):
    monkeypatch.setattr(bench_kernels, "append_result", partial(append_result, folder=tmp_path))
    for name in ("field_parts", "warp_parts"):
        monkeypatch.setattr(bench_kernels, name, lambda *_, name=name: {f"{name}_ms": 2.5})
    for name in ("memory_gb_s", "multiply_gflop_s"):
        monkeypatch.setattr(bench_kernels, name, lambda _: 10.0)
    path = tmp_path / "out.json"
    bench_kernels.main(["--repeats", "1", "--json", str(path)])
    results = json.loads(path.read_text())
    assert results.items() >= (machine_info() | {"seed": 0, "repeats": 1, "memory_gb_s": 10.0}).items()
    assert results["field_parts_ms"] == results["warp_parts_ms"] == 2.5
    assert "warp_parts_ms" in capsys.readouterr().out
    assert len(list(tmp_path.glob("*.csv"))) == 1
