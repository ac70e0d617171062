"""Bad input of the real commands: one sentence, exit status 2, no run folder, no traceback."""

import io
import subprocess
import sys
from contextlib import redirect_stderr
from pathlib import Path

import cv2
import numpy as np
import pytest

from pipeline.core.cli import main_pipeline
from pipeline.core.measure import REPOSITORY_DIR
from stages import PIPELINE
from tests.core.toy_pipeline import user_environment

FRAMES = ("frames",)
ALL = ("--run",)


def run_command(*arguments: str) -> tuple[int, str]:
    """Do what `python -m stages <arguments>` does, in this process; return exit status and standard error."""
    err = io.StringIO()
    with redirect_stderr(err):
        code = main_pipeline(PIPELINE, arguments, isolate=False)
    return code, err.getvalue()


def expect_user_error(video: Path, run_dir: Path, *options: str, command: tuple[str, ...] = FRAMES) -> str:
    """Return the message with which a command refuses a video."""
    code, err = run_command(*command, str(run_dir), "--video", str(video), *options)
    assert code == 2, err
    assert "Traceback" not in err
    (sentence,) = [line for line in err.splitlines() if line.startswith("error: ")]
    assert not run_dir.exists(), list(run_dir.iterdir())
    return sentence


def write_frames(folder: Path, value: int, count: int = 20) -> Path:
    folder.mkdir()
    for number in range(count):
        cv2.imwrite(str(folder / f"{number:03d}.png"), np.full((64, 64, 3), value, np.uint8))
    return folder


def test_an_empty_folder(tmp_path: Path) -> None:
    (tmp_path / "empty").mkdir()
    assert "empty" in expect_user_error(tmp_path / "empty", tmp_path / "run", command=ALL)


def test_a_file_that_is_no_video(tmp_path: Path) -> None:
    (tmp_path / "notes.mp4").write_text("dear diary")
    assert "notes.mp4" in expect_user_error(tmp_path / "notes.mp4", tmp_path / "run")


@pytest.mark.slow
def test_black_frames(tmp_path: Path) -> None:
    assert str(tmp_path / "black") in expect_user_error(write_frames(tmp_path / "black", 0), tmp_path / "run")


def test_too_few_frames(tmp_path: Path) -> None:
    assert "frame" in expect_user_error(write_frames(tmp_path / "few", 120, count=3), tmp_path / "run")


def test_the_real_command_prints_one_sentence(tmp_path: Path) -> None:
    (tmp_path / "notes.mp4").write_text("dear diary")
    command = [sys.executable, "-m", "stages.frames", str(tmp_path / "run"), "--video", str(tmp_path / "notes.mp4")]
    done = subprocess.run(
        command, cwd=REPOSITORY_DIR, env=user_environment(), capture_output=True, text=True, check=False
    )
    assert done.returncode == 2, done.stderr
    assert "Traceback" not in done.stderr
    assert done.stderr.splitlines()[-1].startswith("error: ")


def test_a_broken_config_value(tmp_path: Path) -> None:
    video = write_frames(tmp_path / "any", 120)
    sentence = expect_user_error(video, tmp_path / "run", "--set", "mesh.voxel_size_m=wide", command=ALL)
    assert "mesh.voxel_size_m = 'wide' is not allowed: it must be a number" in sentence


@pytest.mark.slow
def test_the_collected_bad_captures(shared_data: Path, tmp_path: Path) -> None:
    """Every capture in error/ is either refused in one sentence, or processed without the broken parts."""
    folder = shared_data / "error"
    if not folder.is_dir():
        pytest.skip("no error/ captures")
    for number, video in enumerate(sorted(path for path in folder.iterdir() if path.suffix != ".md")):
        code, err = run_command("frames", str(tmp_path / f"run{number}"), "--video", str(video))
        assert code in (0, 2), f"{video.name}: {err}"
        if code == 2:
            assert err.splitlines()[-1].startswith("error: "), video.name
            assert not (tmp_path / f"run{number}").exists()
