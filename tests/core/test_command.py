"""Commands in messages work when they are copied."""

import os
import shlex
import shutil
import subprocess
import sys
from pathlib import Path

import pytest

from pipeline.core.command import COMMAND_VARIABLE, format_command, format_module_command


@pytest.fixture(autouse=True)
def without_console_command(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.delenv(COMMAND_VARIABLE, raising=False)


def test_a_command_of_the_message_runs_in_a_shell_that_has_no_python(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Packages are in a virtual environment that the user need not have activated; names may have any characters."""
    (tmp_path / "echo.py").write_text("import sys\nprint(sys.argv[1:])\n")
    monkeypatch.chdir(tmp_path)
    command = format_module_command("echo", "my run's", Path("ü$HOME"))
    shell = shutil.which("sh")
    assert shell
    done = subprocess.run(
        [shell, "-c", command], env={"PATH": "/nowhere"}, capture_output=True, text=True, check=False, cwd=tmp_path
    )
    assert done.stdout == f"{['my run' + chr(39) + 's', 'ü$HOME']}\n", done.stderr


def test_the_interpreter_of_a_checkout_is_named_from_its_folder(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(sys, "executable", str(tmp_path / ".venv" / "bin" / "python"))
    assert format_command("mesh", "runs/a b") == ".venv/bin/python -m stages mesh 'runs/a b'"
    monkeypatch.chdir(os.sep)
    inner = tmp_path / "my venv" / "bin" / "python"
    monkeypatch.setattr(sys, "executable", str(inner))
    monkeypatch.chdir(Path(__file__).parent)
    assert shlex.split(format_command())[0] == str(inner)


def test_the_console_command_names_itself(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv(COMMAND_VARIABLE, "instant-human-mesh")
    assert format_command("mesh", Path("runs/a")) == "instant-human-mesh mesh runs/a"
