import csv

import torch

from tests.bench.machine import append_row, circumstances, gather_mrow_s


def test_rows_of_all_benches_share_a_table(tmp_path):
    folder = tmp_path / "results"
    append_row("kernels", {"adam_ms": 1.23456}, folder)
    append_row("field", {"step_ms": 20, "preset": "default"}, folder)
    path = append_row("kernels", {"adam_ms": 2.0}, folder)
    with path.open(newline="") as stream:
        rows = list(csv.DictReader(stream))
    assert [row["bench"] for row in rows] == ["kernels", "field", "kernels"]
    assert [row["adam_ms"] for row in rows] == ["1.235", "", "2.0"]
    assert rows[1]["preset"] == "default"
    assert rows[0]["threads"] == str(torch.get_num_threads())


def test_a_table_of_fewer_columns_is_continued(tmp_path):
    path = append_row("kernels", {}, tmp_path)
    path.write_text("commit,adam_ms\nabc,3\n")
    append_row("field", {"step_ms": 4}, tmp_path)
    with path.open(newline="") as stream:
        first, second = csv.DictReader(stream)
    assert (first["commit"], first["adam_ms"], first["step_ms"]) == ("abc", "3", "")
    assert (second["commit"], second["adam_ms"], second["step_ms"]) == (circumstances()["commit"], "", "4")


def test_random_rows_are_counted():
    assert gather_mrow_s(1 << 10, 4, 1) > 0
