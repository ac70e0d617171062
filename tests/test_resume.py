"""kill -9 at any time, then the same command: it resumes, and ends with the bytes of an uninterrupted run."""

import os
import shutil
import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest

from pipeline.core.manifest import digest_json, list_files, read_manifest
from pipeline.core.measure import REPOSITORY_DIR
from stages import STAGES
from tests.core.toy_pipeline import Toy, user_environment

TOY_STAGES = ("read", "learn", "summarise")


def artifacts(run_dir: Path, names: tuple[str, ...]) -> dict[str, str]:
    """Digest of the outputs of each finished stage."""
    manifests = {name: read_manifest(run_dir / name) for name in names}
    return {name: manifest.outputs_digest for name, manifest in manifests.items() if manifest}


@pytest.fixture(scope="module")
def unbroken(tmp_path_factory: pytest.TempPathFactory) -> dict[str, str]:
    """What the toy pipeline makes without a kill."""
    toy = Toy(tmp_path_factory.mktemp("toy") / "unbroken")
    assert toy.all("--video", "numbers.txt").returncode == 0
    return artifacts(toy.run_dir, TOY_STAGES)


@pytest.mark.parametrize("step", [1, 10, 20])
def test_a_killed_stage_resumes_from_its_checkpoint(toy: Toy, unbroken: dict[str, str], step: int) -> None:
    killed = toy.call_all("--video", "numbers.txt", TOY_KILL_STEP=str(step))
    assert killed.returncode == 2
    assert "killed by signal 9" in killed.stderr
    assert not (toy.run_dir / "learn").exists()
    assert "unfinished" in toy.all("--status").stdout
    assert toy.all("--video", "numbers.txt").returncode == 0
    manifest = read_manifest(toy.run_dir / "learn")
    assert manifest is not None
    assert manifest.metrics == {"first_step": step}
    assert manifest.resumed
    assert artifacts(toy.run_dir, TOY_STAGES) == unbroken
    assert not list(toy.run_dir.glob("*.part"))


def test_a_changed_option_drops_the_checkpoint(toy: Toy) -> None:
    toy.call_all("--video", "numbers.txt", TOY_KILL_STEP="10")
    toy.all("--set", "learn.steps=30")
    manifest = read_manifest(toy.run_dir / "learn")
    assert manifest is not None
    assert manifest.metrics == {"first_step": 0}


def test_a_killed_runner_takes_its_stage_along(toy: Toy, unbroken: dict[str, str]) -> None:
    runner = toy.start("stages", "--run", "runs/a", "--video", "numbers.txt", TOY_SLEEP_S="60")
    wait_for(toy.run_dir / "learn.part" / "checkpoint.json", runner)
    runner.kill()
    runner.communicate()
    done = toy.all("--video", "numbers.txt")
    assert done.returncode == 0, done.stderr
    assert artifacts(toy.run_dir, TOY_STAGES) == unbroken


@pytest.mark.parametrize("delay_s", [0.05, 0.15, 0.3, 0.45, 0.6])
def test_a_kill_at_any_moment_does_no_harm(toy: Toy, unbroken: dict[str, str], delay_s: float) -> None:
    runner = toy.start("stages", "--run", "runs/a", "--video", "numbers.txt")
    time.sleep(delay_s)
    os.killpg(runner.pid, signal.SIGKILL)
    runner.communicate()
    for name in TOY_STAGES:
        assert not (toy.run_dir / name).exists() or read_manifest(toy.run_dir / name)
    done = toy.all("--video", "numbers.txt")
    assert done.returncode == 0, done.stderr
    assert artifacts(toy.run_dir, TOY_STAGES) == unbroken


def real_run(run_dir: Path, video: Path) -> subprocess.Popen[bytes]:
    """Start the real pipeline with the smoke preset, in a process group of its own."""
    command = [sys.executable, "-m", "stages", "--run", str(run_dir), "--video", str(video), "--preset", "smoke"]
    return subprocess.Popen(command, cwd=REPOSITORY_DIR, env=user_environment(), start_new_session=True)


@pytest.mark.slow
@pytest.mark.parametrize("name", STAGES)
@pytest.mark.parametrize("share", [0.3, 0.8])
def test_each_real_stage_survives_a_kill(command_run: Path, tmp_path: Path, name: str, share: float) -> None:
    """The killed run starts from copies of what comes before; the report, which holds times, need only end."""
    whole = read_manifest(command_run / name)
    assert whole is not None
    run_dir = tmp_path / "killed"
    run_dir.mkdir()
    for earlier in STAGES[: STAGES.index(name)]:
        shutil.copytree(command_run / earlier, run_dir / earlier)
    video = command_run.parent / "capture" / "video"
    runner = real_run(run_dir, video)
    wait_for(run_dir / f"{name}.part" / ".fingerprint", runner)
    time.sleep(share * whole.seconds)
    os.killpg(runner.pid, signal.SIGKILL)
    runner.wait()
    assert real_run(run_dir, video).wait() == 0
    timeless = tuple(stage for stage in STAGES if stage != "report")
    assert artifacts(run_dir, timeless) == artifacts(command_run, timeless)
    assert not list(run_dir.glob("*.part"))
    assert list_files(run_dir / "report") == list_files(command_run / "report")
    assert digest_json(artifacts(run_dir, STAGES).get("report", "")) != digest_json("")


def wait_for(path: Path, runner: subprocess.Popen[str] | subprocess.Popen[bytes], timeout_s: float = 300.0) -> None:
    """Wait until the runner has made a file."""
    deadline = time.monotonic() + timeout_s
    while not path.exists():
        assert runner.poll() is None, "the run ended before it could be killed"
        assert time.monotonic() < deadline, f"{path} did not appear"
        time.sleep(0.02)
