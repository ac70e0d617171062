import csv
import json

import torch

from tests.bench.machine import append_result, gather_mrow_s, machine_info


def test_rows_of_all_benchmarks_share_a_table(tmp_path):
    folder = tmp_path / "results"
    append_result("kernels", {"adam_ms": 1.23456}, folder=folder)
    append_result("field", {"step_ms": 20, "preset": "default"}, folder=folder)
    path = append_result("kernels", {"adam_ms": 2.0}, folder=folder)
    with path.open(newline="") as stream:
        rows = list(csv.DictReader(stream))
    assert [row["bench"] for row in rows] == ["kernels", "field", "kernels"]
    assert [row["adam_ms"] for row in rows] == ["1.235", "", "2.0"]
    assert rows[1]["preset"] == "default"
    assert rows[0]["threads"] == str(torch.get_num_threads())


def test_table_with_fewer_columns_is_extended(tmp_path):
    path = append_result("kernels", {}, folder=tmp_path)
    path.write_text("commit,adam_ms\nabc,3\n")
    append_result("field", {"step_ms": 4}, folder=tmp_path)
    with path.open(newline="") as stream:
        first, second = csv.DictReader(stream)
    assert (first["commit"], first["adam_ms"], first["step_ms"]) == ("abc", "3", "")
    assert (second["commit"], second["adam_ms"], second["step_ms"]) == (machine_info()["commit"], "", "4")


def test_json_file_holds_results_and_machine_info(tmp_path):
    append_result("kernels", {"adam_ms": 1.23456}, tmp_path / "out.json", tmp_path)
    assert json.loads((tmp_path / "out.json").read_text()) == {"bench": "kernels", "adam_ms": 1.23456} | machine_info()


def test_gather_rate_is_positive():
    assert gather_mrow_s(1 << 10, 4, 1) > 0
