"""Lost work: CPU seconds of a group of processes since the last file from which a run continues."""

import os
import subprocess
import sys
import time
from pathlib import Path

import pytest

from data_tools.stress import lost_work
from data_tools.stress.lost_work import LostWork, group_cpu_s, kept_files, wait_and_watch

BUSY = "import time\nend = time.process_time() + {seconds}\nwhile time.process_time() < end: pass\n"
linux = pytest.mark.skipif(sys.platform != "linux", reason="reads /proc")


def test_kept_files_are_finished_stages_and_checkpoints(tmp_path: Path) -> None:
    for name in (
        "frames/manifest.json",
        "field.part/checkpoint.safetensors",
        "field.part/checkpoint_progress.csv",
        "field.part/manifest.json",
        "field.part/field.safetensors",
        "manifest.json",
    ):
        (tmp_path / name).parent.mkdir(exist_ok=True)
        (tmp_path / name).touch()
    assert {name for name, _ in kept_files(tmp_path)} == {"frames/manifest.json", "field.part/checkpoint.safetensors"}


def test_work_is_lost_since_the_last_kept_file(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    clock = iter([3.0, 5.0, 9.0, 12.0])
    monkeypatch.setattr(lost_work, "group_cpu_s", lambda _: next(clock))
    checkpoint = tmp_path / "field.part" / "checkpoint.safetensors"
    checkpoint.parent.mkdir()
    checkpoint.touch()
    watch = LostWork(tmp_path, 0)
    watch.poll()
    assert watch.lost_s == 3.0
    os.utime(checkpoint, (1, 1))
    watch.poll()
    assert watch.lost_s == 0.0
    watch.poll()
    assert (watch.cpu_s, watch.lost_s) == (9.0, 4.0)
    checkpoint.parent.rename(tmp_path / "field")
    (tmp_path / "field" / "manifest.json").touch()
    watch.poll()
    assert (watch.cpu_s, watch.lost_s) == (12.0, 0.0)


@linux
def test_children_that_have_ended_count(tmp_path: Path) -> None:
    busy = BUSY.format(seconds=0.4)
    code = f"import subprocess, sys\nsubprocess.run([sys.executable, '-c', {busy!r}])\nprint()\ninput()"
    with subprocess.Popen(
        [sys.executable, "-c", code], stdin=subprocess.PIPE, stdout=subprocess.PIPE, start_new_session=True
    ) as process:
        assert process.stdout
        process.stdout.readline()
        assert 0.4 <= group_cpu_s(process.pid) < 2.0
        process.communicate(b"\n")


@linux
def test_a_process_is_watched_to_its_limit_or_its_end(tmp_path: Path) -> None:
    process = subprocess.Popen([sys.executable, "-c", BUSY.format(seconds=60)], start_new_session=True)
    start, watch = time.monotonic(), LostWork(tmp_path, process.pid)
    try:
        assert not wait_and_watch(process, watch, lambda: time.monotonic() - start > 0.6)
        assert watch.cpu_s > 0.0
    finally:
        process.kill()
        process.wait()
    assert wait_and_watch(process, watch, None)
