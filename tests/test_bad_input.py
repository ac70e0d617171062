"""Bad input, given to the real commands: one sentence, exit status 2, no folder, no traceback."""

import subprocess
import sys
from pathlib import Path

import cv2
import numpy as np
import pytest

from pipeline.core.measure import REPOSITORY_DIR
from tests.core.toy_pipeline import user_environment

ALL = ("stages", "--run")
FRAMES = ("stages.frames",)


def expect_user_error(video: Path, run_dir: Path, *options: str, command: tuple[str, ...] = FRAMES) -> str:
    """The sentence with which a command refuses a video."""
    command = (sys.executable, "-m", *command, str(run_dir), "--video", str(video), *options)
    done = subprocess.run(
        command, cwd=REPOSITORY_DIR, env=user_environment(), capture_output=True, text=True, check=False
    )
    assert done.returncode == 2, done.stderr
    assert "Traceback" not in done.stderr
    (sentence,) = [line for line in done.stderr.splitlines() if line.startswith("error: ")]
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


def test_black_frames(tmp_path: Path) -> None:
    assert str(tmp_path / "black") in expect_user_error(write_frames(tmp_path / "black", 0), tmp_path / "run")


def test_too_few_frames(tmp_path: Path) -> None:
    assert "frame" in expect_user_error(write_frames(tmp_path / "few", 120, count=3), tmp_path / "run")


def test_a_broken_config_value(tmp_path: Path) -> None:
    video = write_frames(tmp_path / "any", 120)
    sentence = expect_user_error(video, tmp_path / "run", "--set", "mesh.voxel_size_m=wide", command=ALL)
    assert "mesh.voxel_size_m = 'wide' is not allowed: it must be a number" in sentence


@pytest.mark.slow
def test_the_collected_bad_captures(shared_data: Path, tmp_path: Path) -> None:
    """Every capture in error/ is either refused in one sentence or walked through with less."""
    folder = shared_data / "error"
    if not folder.is_dir():
        pytest.skip("no error/ captures")
    for number, video in enumerate(sorted(path for path in folder.iterdir() if path.suffix != ".md")):
        command = [sys.executable, "-m", "stages.frames", str(tmp_path / f"run{number}"), "--video", str(video)]
        done = subprocess.run(
            command, cwd=REPOSITORY_DIR, env=user_environment(), capture_output=True, text=True, check=False
        )
        assert done.returncode in (0, 2), f"{video.name}: {done.stderr}"
        assert "Traceback" not in done.stderr
        if done.returncode == 2:
            assert done.stderr.splitlines()[-1].startswith("error: "), video.name
            assert not (tmp_path / f"run{number}").exists()
