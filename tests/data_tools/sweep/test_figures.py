"""Tables of the documents: cells come from the runs, markers are replaced, mixed commits are refused."""

from pathlib import Path

import pytest

import stages
from data_tools.sweep.chart_trials import Trial
from data_tools.sweep.figures import END, insert_tables, preset_table, single_origin, stage_table
from data_tools.sweep.runs import RunState
from pipeline.core.errors import UserError

SCORES = {"mesh_psnr_full_db": 30.04, "mesh_psnr_body_db": 22.06, "chamfer_mm": 2.66}
REPORT = {
    "mesh": {"faces": 21035},
    "peak_rss_mib": {"total": 1234.4},
    "seconds": {name: 10.0 + k for k, name in enumerate((*stages.STAGES, "total"))},
}


def trial(preset: str = "default") -> Trial:
    return Trial(Path("captures/ann"), preset, 0, Path("runs/figures"))


def run(scores: dict[str, float] = SCORES) -> RunState:
    return RunState(dict.fromkeys(stages.STAGES, "fresh"), {}, scores, "")


def test_preset_rows_hold_the_figures_of_the_run() -> None:
    row = preset_table({trial(): run()}, {trial(): REPORT}).splitlines()[-1]
    assert row == "| ann | `default` | 0 | 30.0 / 22.1 | 2.7 | 21,035 | 1234 |"


def test_a_real_capture_has_no_distance_to_the_truth() -> None:
    scores = {name: value for name, value in SCORES.items() if name != "chamfer_mm"}
    assert "|  | 21,035 |" in preset_table({trial(): run(scores)}, {trial(): REPORT})


def test_stage_rows_hold_all_stages_in_order() -> None:
    row = stage_table({trial(): run()}, {trial(): REPORT}).splitlines()[-1]
    assert row == "| ann | `default` | 10 | 11 | 12 | 13 | 14 | 15 | 16 | 17 |"


def test_only_marked_tables_are_replaced() -> None:
    text = f"before\n<!-- figures: presets -->\nold\n{END}\nafter"
    inserted = insert_tables(text, {"presets": "| new |"}, Path("README.md"))
    assert inserted == f"before\n<!-- figures: presets -->\n\n| new |\n{END}\nafter"
    assert insert_tables(inserted, {"presets": "| new |"}, Path("README.md")) == inserted


@pytest.mark.parametrize("text", ["<!-- figures: presets -->\nno end", f"<!-- figures: other -->\n{END}"])
def test_wrong_markers_are_errors_that_name_the_document(text: str) -> None:
    with pytest.raises(UserError, match=r"README\.md"):
        insert_tables(text, {"presets": ""}, Path("README.md"))


def test_runs_of_several_commits_are_refused(monkeypatch: pytest.MonkeyPatch) -> None:
    rows = iter([{"commit": "a" * 40, "machine": "m"}, {"commit": "b" * 40, "machine": "m"}])
    monkeypatch.setattr("data_tools.sweep.figures.table_row", lambda *_: next(rows))
    with pytest.raises(UserError, match="several commits"):
        single_origin({trial(): run(), trial("fine"): run()})
