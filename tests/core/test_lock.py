"""One writer per run folder."""

import os
import subprocess
import sys
from pathlib import Path
from typing import Any

import pytest

from pipeline.core.errors import UserError
from pipeline.core.lock import LOCK_FD_VARIABLE, run_lock
from pipeline.core.measure import REPOSITORY_DIR
from pipeline.core.parent import PARENT_PID_VARIABLE, is_runner_child

TAKE = "import sys; from pathlib import Path; from pipeline.core.lock import run_lock\n"
TAKE += "with run_lock(Path(sys.argv[1]), timeout_s=0.0): print('taken')"


def take(run_dir: Path, **options: Any) -> subprocess.CompletedProcess[str]:
    """Try to take the lock in another process."""
    return subprocess.run(
        [sys.executable, "-c", TAKE, str(run_dir)], capture_output=True, text=True, cwd=REPOSITORY_DIR, **options
    )


def test_second_writer_is_refused_with_holder_pid(tmp_path: Path) -> None:
    with run_lock(tmp_path), pytest.raises(UserError, match=f"process {os.getpid()}"), run_lock(tmp_path, 0.0):
        pytest.fail("two writers")


def test_another_process_is_refused_until_the_lock_is_free(tmp_path: Path) -> None:
    with run_lock(tmp_path):
        assert "in use by process" in take(tmp_path).stderr
    assert take(tmp_path).stdout == "taken\n"


def test_a_child_works_under_its_parents_lock(tmp_path: Path) -> None:
    with run_lock(tmp_path) as lock:
        environment = lock.child_environment()
        assert take(tmp_path, env=environment, pass_fds=lock.passed_descriptors).stdout == "taken\n"


def test_the_lock_outlives_a_killed_runner_until_its_child_ends(tmp_path: Path) -> None:
    code = "import os, subprocess, sys; from pathlib import Path; from pipeline.core.lock import run_lock\n"
    code += "with run_lock(Path(sys.argv[1])) as lock:\n"
    code += "    child = subprocess.Popen(['cat'], stdin=0, pass_fds=lock.passed_descriptors)\n"
    code += "    os.kill(os.getpid(), 9)"
    runner = subprocess.Popen([sys.executable, "-c", code, str(tmp_path)], cwd=REPOSITORY_DIR, stdin=subprocess.PIPE)
    runner.wait()
    assert "in use by process" in take(tmp_path).stderr
    assert runner.stdin is not None
    runner.stdin.close()  # ends the child
    with run_lock(tmp_path, timeout_s=30.0):
        pass


def test_an_inherited_lock_of_another_run_does_not_count(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    here, there = tmp_path / "here", tmp_path / "there"
    here.mkdir()
    there.mkdir()
    with run_lock(here) as lock, run_lock(there):
        monkeypatch.setenv(LOCK_FD_VARIABLE, str(lock.descriptor))
        with pytest.raises(UserError), run_lock(there, 0.0):
            pytest.fail("the lock of another run was taken for this one's")


def test_a_dead_holder_holds_nothing(tmp_path: Path) -> None:
    killed = TAKE.replace("print('taken')", "import os; os.kill(os.getpid(), 9)")
    subprocess.run([sys.executable, "-c", killed, str(tmp_path)], check=False, cwd=REPOSITORY_DIR)
    assert take(tmp_path).stdout == "taken\n"


def test_a_stage_process_knows_its_runner(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.delenv(PARENT_PID_VARIABLE, raising=False)
    assert not is_runner_child()
    monkeypatch.setenv(PARENT_PID_VARIABLE, "1")
    assert is_runner_child()
