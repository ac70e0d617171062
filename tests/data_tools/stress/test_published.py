"""Published tables: rows without results on this machine keep what the document shows."""

from pathlib import Path

import pytest

from data_tools.stress.published import read_published
from data_tools.stress.row import DONE, MISSING, Row, Trial, TrialResult, bounded
from data_tools.stress.rows import ROWS
from data_tools.stress.tables import TABLE_END, TABLE_START, write_document
from pipeline.core.measure import REPOSITORY_DIR

NOTHING = TrialResult(MISSING)


def make_row(name: str) -> Row:
    trials = (Trial("a", 0, {"n": 0}), Trial("b", 1, {"n": 1}))
    return Row(name, "failure", "at most 2", trials, bounded("error", high=2.0), "error", "error, mm")


def result(error: float, commit: str, machine: str = "cpu") -> TrialResult:
    return TrialResult(DONE, {"error": error}, seconds=60.0, commit=commit, machine=machine)


@pytest.fixture
def document(tmp_path: Path) -> Path:
    path = tmp_path / "stress.md"
    path.write_text(f"before\n{TABLE_START}\n{TABLE_END}\nafter\n")
    return path


def test_rows_without_results_here_stay(document: Path) -> None:
    rows = {name: make_row(name) for name in ("one-row", "other")}
    both = {"a": result(1.0, "aaaaaaaaaaaaaa"), "b": result(3.0, "bbbbbbbbbbbbbb")}
    write_document(document, rows, {"one-row": both, "other": {"a": NOTHING, "b": NOTHING}}, "make stress")
    first = read_published(document.read_text())
    assert first.rows["one-row"].trials == 2
    assert first.rows["one-row"].commits == ["aaaaaaaaaa", "bbbbbbbbbb"]
    assert first.rows["other"].trials == 0
    assert "not run" in first.rows["other"].section
    assert first.machines == "cpu"
    one = {"a": result(1.5, "cccccccccccccc", "gpu"), "b": NOTHING}
    write_document(document, rows, {"one-row": one, "other": one}, "make stress")
    second = read_published(document.read_text())
    assert second.rows["one-row"] == first.rows["one-row"]
    assert "**incomplete** | 1 of 2" in second.rows["other"].summary
    assert second.machines == "cpu; gpu"
    assert "Commit aaaaaaaaaa; bbbbbbbbbb; cccccccccc, cpu; gpu; `make stress`." in document.read_text()


def test_as_many_results_here_replace_a_row(document: Path) -> None:
    rows = {"row": make_row("row")}
    for commit in ("aaaaaaaaaaaaaa", "bbbbbbbbbbbbbb"):
        write_document(document, rows, {"row": {"a": result(1.0, commit), "b": NOTHING}}, "make stress")
    text = document.read_text()
    assert "bbbbbbbbbb" in text
    assert "aaaaaaaaaa" not in text


def test_writing_without_results_changes_no_published_row(tmp_path: Path) -> None:
    path = tmp_path / "stress.md"
    path.write_text((REPOSITORY_DIR / "docs" / "stress.md").read_text(encoding="utf-8"))
    before = read_published(path.read_text())
    sweep = {name: {trial.label: NOTHING for trial in row.trials} for name, row in ROWS.items()}
    write_document(path, ROWS, sweep, "make stress")
    after = read_published(path.read_text())
    assert len(before.rows) >= 20
    assert {name: after.rows[name] for name in before.rows} == dict(before.rows)
    assert after.machines == before.machines
