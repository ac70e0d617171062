"""Trials as processes: results, refusals and faults are told apart, kept, and not run twice; exit status and tables."""

import json
import os
from collections.abc import Callable
from pathlib import Path

import pytest

from data_tools.stress import __main__ as command
from data_tools.stress import run_trial as runner
from data_tools.stress.row import DONE, FAILED, MISSING, REFUSED, Row, Trial, TrialResult, bounded
from data_tools.stress.store import index_results, load_result, save_result, trial_key
from data_tools.stress.tables import TABLE_END, TABLE_START, draw_figure, summary_table, trial_table, write_document

TRIAL = Trial("box", 1, {"capture": {"frames": 8}})


def stand_in(code: int | None, scores: dict[str, float | None], log: str = "") -> Callable[..., int | None]:
    """Return a replacement of the process of a trial, which counts its calls."""

    def run(request: Path, scores_file: Path, log_file: Path) -> int | None:
        run.calls += 1  # type: ignore[attr-defined]
        assert json.loads(request.read_text())["procedure"] == "reconstruct"
        log_file.write_text(log)
        if code == 0:
            scores_file.write_text(json.dumps(scores))
        return code

    run.calls = 0  # type: ignore[attr-defined]
    return run


def test_a_trial_runs_once(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    process = stand_in(0, {"error": 1.5, "nothing": None}, "warning: dark\nwarning: dark\n")
    monkeypatch.setattr(runner, "_run_process", process)
    assert runner.read_trial(tmp_path, TRIAL).state == MISSING
    first, second = (runner.run_trial(tmp_path, TRIAL) for _ in range(2))
    assert process.calls == 1  # type: ignore[attr-defined]
    assert first.state == second.state == DONE
    assert second.scores["error"] == 1.5
    assert second.scores["nothing"] != second.scores["nothing"]
    assert second.warnings == ("dark",)


@pytest.mark.parametrize(
    ("code", "log", "state", "message"),
    [
        (2, "error: no person was found\n", REFUSED, "no person was found"),
        (1, "Traceback (most recent call last):\nKeyError: 'x'\n", FAILED, "KeyError: 'x'"),
        (-9, "", FAILED, "exit status -9"),
        (None, "", FAILED, "it hung"),
    ],
)
def test_ends_are_told_apart(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, code: int | None, log: str, state: str, message: str
) -> None:
    monkeypatch.setattr(runner, "_run_process", stand_in(code, {}, log))
    result = runner.run_trial(tmp_path, TRIAL)
    assert (result.state, result.message) == (state, message)
    assert runner.read_trial(tmp_path, TRIAL) == result


def test_what_this_machine_cannot_run_is_not_run(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(runner, "_run_process", stand_in(3, {}, "error: the trial needs Slurm\n"))
    result = runner.run_trial(tmp_path, TRIAL)
    assert (result.state, result.message) == (MISSING, "the trial needs Slurm")
    assert not runner.result_path(tmp_path, TRIAL).exists()


def test_an_interrupted_sweep_continues(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def killed(*_: Path) -> int:
        raise KeyboardInterrupt

    monkeypatch.setattr(runner, "_run_process", killed)
    with pytest.raises(KeyboardInterrupt):
        runner.run_trial(tmp_path, TRIAL)
    assert runner.read_trial(tmp_path, TRIAL).state == MISSING
    monkeypatch.setattr(runner, "_run_process", stand_in(0, {"error": 1.0}))
    assert runner.run_trial(tmp_path, TRIAL).state == DONE


def test_tables_show_the_newest_result_of_earlier_versions(tmp_path: Path) -> None:
    """It is never taken for a result of these versions: the trial runs again."""
    other = Trial("other", 1, {"capture": {"frames": 9}})
    for number, (trial, name) in enumerate(((TRIAL, "older"), (TRIAL, "newer"), (other, "other"))):
        path = tmp_path / "results" / f"{name}.json"
        save_result(path, trial, TrialResult(DONE, {"error": float(number)}, commit=name))
        os.utime(path, (number, number))
    (tmp_path / "results" / "damaged.json").write_text("{")
    older = index_results(tmp_path / "results")
    assert runner.read_trial(tmp_path, TRIAL).state == MISSING
    assert runner.read_latest(tmp_path, TRIAL, older).commit == "newer"
    assert runner.read_latest(tmp_path, Trial("never", 2, {"capture": {}}), older).state == MISSING
    save_result(runner.result_path(tmp_path, TRIAL), TRIAL, TrialResult(DONE, {"error": 5.0}, commit="exact"))
    os.utime(runner.result_path(tmp_path, TRIAL), (0, 0))
    assert runner.read_latest(tmp_path, TRIAL, index_results(tmp_path / "results")).commit == "exact"


def test_the_key_depends_on_what_determines_the_result(tmp_path: Path) -> None:
    preset = tmp_path / "preset.yaml"
    preset.write_text("mesh: {}\n")
    keys = {
        trial_key(TRIAL),
        trial_key(Trial("box", 1, {"capture": {"frames": 9}})),
        trial_key(Trial("box", 1, {"capture": {"frames": 8}}, "hostile")),
        trial_key(TRIAL, preset),
    }
    assert len(keys) == 4
    assert trial_key(Trial("other label", 5, {"capture": {"frames": 8}})) == trial_key(TRIAL)


def test_results_come_back_and_damaged_ones_are_run_again(tmp_path: Path) -> None:
    result = TrialResult(DONE, {"a": 1.0}, "", ("w",), 3.0, "abc", "cpu")
    save_result(tmp_path / "r.json", TRIAL, result)
    assert load_result(tmp_path / "r.json") == result
    (tmp_path / "r.json").write_text("{")
    assert load_result(tmp_path / "r.json").state == MISSING


def make_rows() -> dict[str, Row]:
    trials = (Trial("a", 0, {"n": 0}), Trial("b|c", 1, {"n": 1}))
    return {"row": Row("row", "failure", "at most 2", trials, bounded("error", high=2.0), "error", "error, mm")}


@pytest.mark.parametrize(("error", "status"), [(1.0, 0), (3.0, 1)])
def test_exit_status_and_files(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, error: float, status: int) -> None:
    document = tmp_path / "stress.md"
    document.write_text(f"before\n{TABLE_START}\nold\n{TABLE_END}\nafter\n")
    monkeypatch.setattr(command, "ROWS", make_rows())
    monkeypatch.setattr(runner, "_run_process", stand_in(0, {"error": error}))
    out = tmp_path / "out"
    assert command.main(["--out", str(out), "--document", str(document), "--rows", "row"]) == status
    text = document.read_text()
    assert text.startswith("before\n")
    assert text.endswith("after\n")
    assert "old" not in text
    assert ("**pass**" in text) == (status == 0)
    lines = (out / "stress.csv").read_text().splitlines()
    assert len(lines) == 3
    assert (out / "stress.png").stat().st_size > 0


def test_an_unknown_row_is_refused(capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(SystemExit) as stopped:
        command.main(["--rows", "nothing"])
    assert stopped.value.code == 2
    assert "nothing" in capsys.readouterr().err


def test_tables_name_what_is_not_run_and_what_is_crossed() -> None:
    rows = make_rows()
    results = {
        "a": TrialResult(DONE, {"error": 3.0}, seconds=60.0, commit="0123456789abcdef+"),
        "b|c": TrialResult(MISSING),
    }
    summary = summary_table(rows, {"row": results})
    assert "**crossed** | 1 of 2 | 1 | stress | 0123456789+ |" in summary
    assert "- a: error 3" in trial_table(rows["row"], results)
    nothing = {label: TrialResult(MISSING) for label in results}
    assert trial_table(rows["row"], nothing).startswith("`row`: not run; `make stress ROWS=row`")
    with pytest.raises(ValueError, match="no row"):
        draw_figure(rows, {"row": nothing})


def test_a_document_without_marks_is_an_error(tmp_path: Path) -> None:
    (tmp_path / "a.md").write_text("text")
    with pytest.raises(ValueError, match="stress"):
        write_document(tmp_path / "a.md", {}, {}, "make stress")
