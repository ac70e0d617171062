"""What a machine is prepared with: made ahead, or beside the first run, where it is missing; ended with the run."""

import sys
import time
from pathlib import Path

import pytest

from pipeline.core.errors import UserError
from pipeline.core.preparation import preparations, prepare_machine

MODULE = """
import time
from pathlib import Path

folder = Path(__file__).parent


def is_prepared():
    return (folder / "done").exists()


def prepare():
    (folder / "started").touch()
    while not (folder / "go").exists():
        time.sleep(0.01)
    (folder / "done").touch()
"""


@pytest.fixture
def module(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> str:
    """A module that prepares something once `go` exists in its folder."""
    (tmp_path / "slow_preparation.py").write_text(MODULE)
    monkeypatch.syspath_prepend(tmp_path)
    monkeypatch.delitem(sys.modules, "slow_preparation", raising=False)
    return "slow_preparation"


def wait_until_exists(path: Path) -> None:
    deadline = time.monotonic() + 60.0
    while not path.exists():
        assert time.monotonic() < deadline, f"{path} was not made"
        time.sleep(0.01)


def test_what_is_missing_is_made_beside_the_block(module: str, tmp_path: Path) -> None:
    with preparations([module]):
        wait_until_exists(tmp_path / "started")
        assert not (tmp_path / "done").exists()
        (tmp_path / "go").touch()
        wait_until_exists(tmp_path / "done")


def test_it_ends_with_the_block(module: str, tmp_path: Path) -> None:
    with preparations([module]):
        wait_until_exists(tmp_path / "started")
    (tmp_path / "go").touch()
    time.sleep(0.2)
    assert not (tmp_path / "done").exists()


def test_what_is_there_is_not_made_again(
    module: str, tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    (tmp_path / "done").touch()
    monkeypatch.setattr("pipeline.core.preparation._start", lambda *_: pytest.fail("started"))
    with preparations([module]):
        pass
    prepare_machine([module])
    assert capsys.readouterr().err == ""


def test_a_machine_is_prepared_when_the_call_returns(module: str, tmp_path: Path) -> None:
    (tmp_path / "go").touch()
    prepare_machine([module])
    assert (tmp_path / "done").exists()


def test_a_module_that_fails_is_named_after_its_own_error(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capfd: pytest.CaptureFixture[str]
) -> None:
    lines = (
        "from pipeline.core.errors import UserError",
        "def is_prepared(): return False",
        "def prepare(): raise UserError('no place left')",
    )
    (tmp_path / "failing_preparation.py").write_text("\n".join(lines))
    monkeypatch.syspath_prepend(tmp_path)
    with pytest.raises(UserError, match="failing_preparation could not be prepared"):
        prepare_machine(["failing_preparation"])
    assert capfd.readouterr().err == "error: no place left\n"
