"""Sweeps of presets over captures: resuming, shared stages, tables and errors."""

import csv
import shutil
import subprocess
from dataclasses import replace
from pathlib import Path

import pytest

from data_tools.sweep.chart import _make_sample_captures, provenance, run_and_compare, write_results
from data_tools.sweep.chart import main as chart
from data_tools.sweep.chart_trials import Trial, chart_point, read_progress, table_row
from data_tools.sweep.runs import RunState
from data_tools.synthetic.scene.capture import CAPTURE_VERSION
from pipeline.core.errors import UserError
from pipeline.core.manifest import Manifest, read_manifest
from stages import STAGES
from tests.core.toy_pipeline import Toy
from tests.data_tools.ground_truth_run import write_fake_comparison, write_fake_report
from tests.test_resume import wait_for

SWEEP = ("data_tools.sweep.chart", "numbers.mp4", "--presets", "quick", "default", "--out", "runs/chart")
BOTH = "mesh_psnr_full_db chamfer_mm"
SCORES = {"mesh_psnr_full_db": 28.0, "field_psnr_full_db": 30.0, "chamfer_mm": 6.5}


@pytest.fixture
def sweep(toy: Toy) -> Toy:
    """The toy pipeline with a capture."""
    shutil.copy(toy.video, toy.folder / "numbers.mp4")
    return toy


def rows(path: Path) -> list[dict[str, str]]:
    with path.open(newline="") as file:
        return list(csv.DictReader(file))


def finished(seconds: float, scores: dict[str, float], resumed: tuple[str, ...] = ()) -> RunState:
    """A finished run in which each stage took `seconds`."""
    place = {"commit": "abc", "cpu": "Xeon", "cores": 2, "gpu": None}
    manifests = {
        name: Manifest(name, 1, "", {}, {}, {}, {}, seconds, 100.0, name in resumed, [], place) for name in STAGES
    }
    return RunState(dict.fromkeys(STAGES, "fresh"), manifests, scores, "")


@pytest.mark.slow
def test_killed_sweep_resumes_and_restarts_the_interrupted_stage(sweep: Toy) -> None:
    runner = sweep.start(*SWEEP, TOY_SLEEP_S="3")
    wait_for(sweep.folder / "runs/chart/numbers-default-0/learn.part/checkpoint.json", runner)
    runner.kill()
    runner.communicate()
    first = sweep.folder / "runs" / "chart" / "numbers-quick-0" / "learn"
    before = first.stat().st_ctime_ns
    done = sweep.call(*SWEEP)
    assert done.returncode == 0, done.stderr
    assert first.stat().st_ctime_ns == before
    cut = read_manifest(sweep.folder / "runs" / "chart" / "numbers-default-0" / "learn")
    assert cut is not None
    assert (cut.resumed, cut.metrics) == (False, {"first_step": 0})
    table = rows(sweep.folder / "runs" / "chart" / "chart.csv")
    assert [(row["preset"], row["seed"], row["status"]) for row in table] == [
        ("quick", "0", "done"),
        ("default", "0", "done"),
    ]
    assert all(row["commit"] and "cores" in row["machine"] for row in table)
    assert float(table[0]["seconds"]) > 2.9  # the toy's long step
    assert not table[1]["resumed"]


@pytest.mark.slow
def test_shared_stages_are_computed_once(sweep: Toy) -> None:
    """Both presets read the same input and train differently; stages with other options or seeds are not shared."""
    done = sweep.call(*SWEEP)
    assert done.returncode == 0, done.stderr
    quick, default = (sweep.folder / "runs" / "chart" / f"numbers-{preset}-0" for preset in ("quick", "default"))
    assert (quick / "read" / "manifest.json").read_bytes() == (default / "read" / "manifest.json").read_bytes()
    assert (quick / "learn" / "manifest.json").read_bytes() != (default / "learn" / "manifest.json").read_bytes()
    assert not list(default.glob("*.part"))
    assert "read: cached" in (default.parent / f"{default.name}.log").read_text()


def test_steps_are_in_label_folder_and_table(tmp_path: Path) -> None:
    own, fewer = (Trial(tmp_path / "ann", "ihm", 2, tmp_path, steps) for steps in (None, 600))
    assert (own.label, fewer.label) == ("ihm", "ihm, 600 steps")
    assert own.run_dir != fewer.run_dir
    assert set(fewer.assignments) - set(own.assignments) == {"field.steps=600"}
    judged = Trial(tmp_path / "ann", "ihm", 2, tmp_path, 600, ("frames.split=disjoint",))
    assert judged.label == "ihm, frames.split=disjoint, 600 steps"
    assert judged.run_dir != fewer.run_dir
    assert set(judged.assignments) - set(fewer.assignments) == {"frames.split=disjoint"}
    run = finished(10.0, SCORES)
    run.manifests["field"].metrics["steps"] = 450.0  # it stopped early
    assert chart_point(fewer, run).preset == "ihm, 600 steps"
    assert table_row(fewer, run)["steps"] == 450.0
    write_results(tmp_path, {fewer: run})
    assert "ihm, 600 steps" in (tmp_path / "chart.svg").read_text()


@pytest.fixture
def forbid_runs(monkeypatch: pytest.MonkeyPatch) -> None:
    """Fail the test if a run or a comparison is started."""
    for target in ("chart.run_trial", "chart_trials.subprocess.run"):
        monkeypatch.setattr(f"data_tools.sweep.{target}", lambda *_, **__: pytest.fail("started"))


def test_finished_and_compared_runs_are_not_repeated(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, forbid_runs: None
) -> None:
    trial = Trial(tmp_path / "ann", "quick", 0, tmp_path)
    (trial.capture / "truth").mkdir(parents=True)
    monkeypatch.setattr("data_tools.sweep.chart_trials.read_run", lambda *_: finished(1.0, SCORES))
    write_fake_comparison(trial.run_dir)
    assert run_and_compare(trial, [trial]).status == "done"
    (trial.run_dir / "compare" / "truth.json").unlink()
    with pytest.raises(pytest.fail.Exception, match="started"):
        run_and_compare(trial, [trial])


def test_failed_comparison_is_an_error(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """The chart is written, and the error names the missing comparison."""
    (tmp_path / "ann" / "truth").mkdir(parents=True)
    run_dir = tmp_path / "out" / "ann-default-0"
    write_fake_report(run_dir)
    monkeypatch.setattr("data_tools.sweep.chart_trials.read_run", lambda *_: finished(1.0, SCORES))
    broken = subprocess.CompletedProcess([], 1)
    monkeypatch.setattr("data_tools.sweep.chart_trials.subprocess.run", lambda *_, **__: broken)
    command = [str(tmp_path / "ann"), "--presets", "default", "--out", str(tmp_path / "out")]
    with pytest.raises(UserError, match=r"1 of 1 runs are not compared with their ground truth \(ann-default-0\)"):
        chart(command)
    assert (tmp_path / "out" / "chart.svg").is_file()
    write_fake_comparison(run_dir)
    chart(command)


def test_trials_with_equal_run_folders_are_an_error(tmp_path: Path, forbid_runs: None) -> None:
    """Run folders are named by the stems of capture and preset, so equal stems would share a run."""
    for name in ("a/me.mp4", "b/me.mp4", "instant.yaml"):
        (tmp_path / name).parent.mkdir(exist_ok=True)
        (tmp_path / name).write_text("{}")
    first, second, preset = (str(tmp_path / name) for name in ("a/me.mp4", "b/me.mp4", "instant.yaml"))
    for captures, presets in (((first, second), ("instant",)), ((first,), ("instant", preset))):
        with pytest.raises(UserError, match="would share the run .*me-instant-0"):
            chart([*captures, "--presets", *presets, "--out", str(tmp_path / "out")])
    assert not (tmp_path / "out").exists()


@pytest.mark.slow
def test_run_of_another_capture_is_not_used(sweep: Toy) -> None:
    command = ("--presets", "quick", "--out", "runs/chart")
    assert sweep.call("data_tools.sweep.chart", "numbers.mp4", *command).returncode == 0
    (sweep.folder / "other").mkdir()
    (sweep.folder / "other" / "numbers.mp4").write_text("7 8 9")
    assert "not done (numbers-quick-0)" in sweep.expect_user_error(
        "data_tools.sweep.chart", "other/numbers.mp4", *command
    )
    assert "belongs to the video" in rows(sweep.folder / "runs" / "chart" / "chart.csv")[0]["message"]


def test_sample_captures_of_another_version_are_an_error(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    made: list[list[str]] = []
    monkeypatch.setattr("data_tools.sweep.chart.SAMPLE_CAPTURES", {tmp_path / "ann": 3})
    monkeypatch.setattr("data_tools.sweep.chart.make_sample", made.append)
    _make_sample_captures()
    assert made == [[str(tmp_path / "ann"), "--seed", "3"]]
    settings = tmp_path / "ann" / "truth" / "capture_settings.json"
    settings.parent.mkdir(parents=True)
    for text in ("{}", f'{{"version": {CAPTURE_VERSION + 1}}}'):
        settings.write_text(text)
        with pytest.raises(UserError, match="ann was made by another version"):
            _make_sample_captures()
    settings.write_text(f'{{"version": {CAPTURE_VERSION}}}')
    _make_sample_captures()
    assert len(made) == 1


def test_draw_option_runs_nothing(tmp_path: Path, forbid_runs: None) -> None:
    (tmp_path / "ann").mkdir()
    with pytest.raises(UserError, match="1 of 1 runs are not done"):
        chart([str(tmp_path / "ann"), "--presets", "default", "--out", str(tmp_path / "out"), "--draw"])


def test_draw_option_leaves_out_what_is_not_finished(
    tmp_path: Path, forbid_runs: None, monkeypatch: pytest.MonkeyPatch
) -> None:
    (tmp_path / "ann").mkdir()
    missing = RunState(dict.fromkeys(STAGES, "missing"), {}, {}, "")
    monkeypatch.setattr(
        "data_tools.sweep.chart_trials.read_run",
        lambda run_dir, _: finished(1.0, SCORES) if "instant" in run_dir.name else missing,
    )
    chart([str(tmp_path / "ann"), "--presets", "instant", "fine", "--out", str(tmp_path / "out"), "--draw"])
    assert [row["preset"] for row in rows(tmp_path / "out" / "chart.csv")] == ["instant"]


@pytest.mark.parametrize("entry", ["ihm=600", "default", "default=many", "default=-3"])
def test_invalid_steps_are_an_error(entry: str) -> None:
    with pytest.raises(UserError, match=r"--steps .*: write PRESET=N with one of default"):
        chart(["none.mp4", "--presets", "default", "--steps", entry])


@pytest.mark.slow
def test_failed_run_does_not_stop_the_others(sweep: Toy) -> None:
    (sweep.folder / "words.mp4").write_text("one two")
    message = sweep.expect_user_error(
        "data_tools.sweep.chart", "words.mp4", "numbers.mp4", "--presets", "quick", "--out", "chart"
    )
    assert "1 of 2 runs are not done (words-quick-0)" in message
    table = rows(sweep.folder / "chart" / "chart.csv")
    assert [row["status"] for row in table] == ["failed", "done"]
    assert "not a number" in table[0]["message"]


@pytest.mark.parametrize(
    ("arguments", "message"),
    [(("none.mp4", "--presets", "instant"), r"none\.mp4 does not exist"), (("ann.mp4", "--presets", "x"), "instant")],
)
def test_user_errors_are_reported_before_any_run(
    tmp_path: Path, forbid_runs: None, arguments: tuple[str, ...], message: str
) -> None:
    (tmp_path / "ann.mp4").touch()
    with pytest.raises(UserError, match=message):
        chart([str(tmp_path / arguments[0]), *arguments[1:], "--out", str(tmp_path / "runs")])
    assert not (tmp_path / "runs").exists()


def test_seconds_until_field_and_avatar(tmp_path: Path) -> None:
    trial = Trial(tmp_path / "ann.mp4", "configs/mine.yaml", 3, tmp_path)
    assert trial.run_dir == tmp_path / "ann.mp4-mine-3"
    (trial.run_dir / "field").mkdir(parents=True)
    (trial.run_dir / "field" / "progress.csv").write_text(
        "step,seconds,validation_psnr_db,validation_psnr_body_db\n50,2.5,20,15\n100,5,22,17.5\n"
    )
    point = chart_point(trial, finished(10.0, SCORES))
    assert (point.field_seconds, point.seconds) == (30.0, 60.0)  # the report is not needed for the avatar
    assert point.curve == [(22.5, 20.0, 15.0), (25.0, 22.0, 17.5)]
    run = finished(10.0, SCORES, resumed=("field", "mesh"))
    run.manifests["export"].metrics["glb_faces"] = 24_000.0
    assert chart_point(trial, run).sizes == {"glb_faces": 24_000.0}
    run.manifests["field"] = replace(run.manifests["field"], peak_rss_mib=250.0)
    row = table_row(trial, run)
    assert (row["glb_faces"], row["parameters"]) == (24_000.0, None)
    assert row["peak_rss_mib"] == 250.0
    assert (row["resumed"], row["commit"], row["machine"]) == ("field mesh", "abc", "Xeon, 2 cores")
    assert provenance([row, row | {"seed": 4, "status": "failed"}]) == "commit abc; Xeon, 2 cores; seed 3"


def test_missing_and_damaged_progress(tmp_path: Path) -> None:
    assert read_progress(tmp_path) == []
    (tmp_path / "progress.csv").write_text("seconds,validation_psnr_db\n1,2\n")
    with pytest.raises(UserError, match="validation_psnr_body_db"):
        read_progress(tmp_path)


def test_tables_and_chart_of_finished_runs(tmp_path: Path) -> None:
    """Each capture has its own Pareto fronts; the failure of a finished run is not in the table."""
    quick, slow, bad = (Trial(tmp_path / "ann", preset, 0, tmp_path) for preset in ("quick", "slow", "bad"))
    runs = {
        quick: replace(finished(10.0, SCORES), failure="killed"),
        slow: finished(20.0, SCORES | {"chamfer_mm": 5.0}),
        bad: RunState(dict.fromkeys(STAGES, "missing"), {}, {}, "no person"),
        Trial(tmp_path / "bob", "quick", 0, tmp_path): finished(1.0, SCORES | {"chamfer_mm": 1.0}),
    }
    (slow.run_dir / "field").mkdir(parents=True)
    (slow.run_dir / "field" / "progress.csv").write_text(
        "step,seconds,validation_psnr_db,validation_psnr_body_db\n9,1,20,15\n"
    )
    write_results(tmp_path, runs)
    table = rows(tmp_path / "chart.csv")
    assert [row["pareto_optimal_in"] for row in table] == [BOTH, "chamfer_mm", "", BOTH]
    assert [row["message"] for row in table] == ["", "", "no person", ""]
    assert (tmp_path / "chart.svg").is_file()
    (curve,) = rows(tmp_path / "anytime.csv")
    assert list(curve.values()) == ["ann", "slow", "0", "41.0", "20.0", "15.0"]
