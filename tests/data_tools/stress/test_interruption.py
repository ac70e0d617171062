"""Interruptions of the toy pipeline with real kills, and what counts as a difference."""

import os
import shutil
import subprocess
from pathlib import Path
from types import SimpleNamespace

import pytest

from data_tools.stress import interruption
from data_tools.stress.interruption import KillLog, KillTime, differing_files, interruption_scores, kill_times
from data_tools.stress.row import CannotRunError
from tests.core.toy_pipeline import Toy
from tests.test_resume import TOY_STAGES


@pytest.fixture
def folders(toy: Toy, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> tuple[Path, Path]:
    """Folders of captures and runs; runs are those of the toy pipeline."""

    def start(run: Path, video: Path, log: Path) -> subprocess.Popen[str]:
        process = toy.start("stages", "--run", str(run), "--video", "numbers.txt")
        _, errors = ("", "") if run.name.startswith("run") else process.communicate()
        log.parent.mkdir(parents=True, exist_ok=True)
        log.write_text(errors)
        return process

    monkeypatch.setattr(interruption, "_start", start)
    monkeypatch.setenv("OMP_NUM_THREADS", "1")
    monkeypatch.setattr(interruption, "make_capture", lambda *_: toy.folder)
    monkeypatch.setattr(interruption, "STAGES", TOY_STAGES)
    monkeypatch.setattr(interruption, "TIMELESS", TOY_STAGES)
    return tmp_path / "captures", tmp_path / "trial"


@pytest.mark.slow
def test_killed_runs_end_with_the_same_bytes(folders: tuple[Path, Path]) -> None:
    scores = interruption_scores(*folders, kind="kills")
    assert scores["differing_files"] == 0.0
    assert scores["interruptions"] == len(TOY_STAGES) + interruption.EXTRA_KILLS
    assert 0.0 <= scores["repeated_seconds"] < 20.0


@pytest.mark.slow
def test_two_runs_at_once_end_with_the_same_bytes(folders: tuple[Path, Path]) -> None:
    scores = interruption_scores(*folders, kind="two runs", count=1)
    assert scores["differing_files"] == 0.0
    assert scores["interruptions"] <= 1.0


@pytest.mark.slow
def test_differences_are_counted(folders: tuple[Path, Path]) -> None:
    interruption_scores(*folders, kind="kills")
    expected, found = folders[0].parent / "undisturbed-1-threads", folders[1] / "run0"
    assert differing_files(expected, found) == []
    shutil.rmtree(found / TOY_STAGES[-1])
    (found / "learn.part").mkdir()
    differing = differing_files(expected, found)
    assert "learn.part" in differing
    assert any(name.startswith(f"{TOY_STAGES[-1]}/") for name in differing)


def test_the_runs_of_a_trial_have_its_threads(folders: tuple[Path, Path], monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("NUMBA_NUM_THREADS", "1")
    seen = []

    def stop(run: Path, _: Path) -> float:
        seen.append((run.name, os.environ["OMP_NUM_THREADS"], os.environ["NUMBA_NUM_THREADS"]))
        raise KeyboardInterrupt

    monkeypatch.setattr(interruption, "_run_undisturbed", stop)
    with pytest.raises(KeyboardInterrupt):
        interruption_scores(*folders, kind="kills", threads=3)
    assert seen == [("undisturbed-3-threads", "3", "3")]


def test_each_stage_is_killed_within_its_seconds(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    seconds = {"a": 1.0, "b": 10.0, "c": 100.0}
    monkeypatch.setattr(interruption, "STAGES", tuple(seconds))
    monkeypatch.setattr(interruption, "read_manifest", lambda folder: SimpleNamespace(seconds=seconds[folder.name]))
    times = kill_times(tmp_path, seed=3)
    assert len(times) == len(seconds) + interruption.EXTRA_KILLS
    assert list(dict.fromkeys(time.stage for time in times)) == list(seconds)
    assert all(0.0 <= time.delay_s <= seconds[time.stage] for time in times)
    assert times == kill_times(tmp_path, seed=3)
    assert times != kill_times(tmp_path, seed=4)


def test_a_kill_waits_for_its_stage_or_a_later_one(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(interruption, "STAGES", ("a", "b", "c"))
    (tmp_path / "a").mkdir()
    kill, late = KillTime("b", 0.0), KillTime("b", 60.0)
    assert not kill.has_come(tmp_path)
    (tmp_path / "c.part").mkdir()
    assert kill.has_come(tmp_path)
    assert not late.has_come(tmp_path)


def test_scores_of_kills_are_the_worst_of_each_stage(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(interruption, "STAGES", ("a", "b", "c"))
    log = KillLog(["a", "b", "a"], [1.0, 5.0, 3.0], cpu_s=230.0, differing=2, runs=2)
    assert log.scores(undisturbed_cpu_s=100.0) == {
        "differing_files": 2.0,
        "interruptions": 3.0,
        "repeated_seconds": 5.0,
        "extra_seconds_a_kill": 10.0,
        "kills_in_a": 2.0,
        "kills_in_b": 1.0,
        "kills_in_c": 0.0,
        "repeated_in_a": 3.0,
        "repeated_in_b": 5.0,
    }
    nothing = KillLog(runs=1).scores(100.0)
    assert nothing["repeated_seconds"] != nothing["repeated_seconds"]


def test_without_mount_a_full_disk_is_refused_in_one_sentence(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def refused(command: list[str]) -> None:
        raise subprocess.CalledProcessError(32, command)

    monkeypatch.setattr(interruption, "_command", refused)
    monkeypatch.setattr(shutil, "which", lambda name: f"/bin/{name}")
    with pytest.raises(CannotRunError, match="run it as root"), interruption._small_disk(tmp_path / "disk", 4):
        pass
