"""The Python API and the console command of the real pipeline, on the finished run of the test suite."""

import inspect
from pathlib import Path

import pytest

import stages
from pipeline.core.errors import UserError
from stages import STAGES, Progress, reconstruct
from stages.__main__ import console_main


def test_reconstruct_returns_the_files_of_the_run(smoke_run: Path) -> None:
    video = smoke_run.parent / "capture" / "video"
    calls: list[Progress] = []
    avatar = reconstruct(video, smoke_run, progress=calls.append)
    assert avatar.run_dir == smoke_run
    assert all(path.is_file() for path in (avatar.glb, avatar.obj, avatar.page, avatar.report))
    assert [(outcome.stage, outcome.state) for outcome in avatar.stages] == [(name, "cached") for name in STAGES]
    assert [call.stage for call in calls] == list(STAGES)


def test_an_unknown_option_is_a_user_error(tmp_path: Path) -> None:
    video = tmp_path / "video.mp4"
    video.write_bytes(b"not opened")
    with pytest.raises(UserError, match=r"mesh\.max_face is unknown \(did you mean max_faces\?\)"):
        reconstruct(video, tmp_path / "run", overrides={"mesh.max_face": 3})
    assert not (tmp_path / "run").exists()


def test_every_argument_is_documented() -> None:
    text = inspect.getdoc(reconstruct) or ""
    assert [name for name in inspect.signature(reconstruct).parameters if f"\n    {name}: " not in text] == []


def test_the_console_command_shows_help_and_version(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr("sys.argv", ["instant-human-mesh", "--version"])
    monkeypatch.setenv("AVATAR_COMMAND", "instant-human-mesh")
    assert console_main() == 0
    assert capsys.readouterr().out == f"{stages.__version__}\n"
    monkeypatch.setattr("sys.argv", ["instant-human-mesh", "mesh", "--help"])
    with pytest.raises(SystemExit, match="0"):
        console_main()
    assert capsys.readouterr().out.startswith("usage: instant-human-mesh mesh ")
