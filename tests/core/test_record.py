"""The record of a run, and the name of its folder."""

import json
from pathlib import Path

import numpy as np
import pytest

from pipeline.core.errors import UserError
from pipeline.core.manifest import MANIFEST_FILE, Manifest, digest_video, write_manifest
from pipeline.core.record import RunRecord
from pipeline.core.run_folder import RunRequest, default_run_dir


def test_options_are_recorded_as_json_holds_them(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Numbers of NumPy as numbers, the path of a file such that a command from another folder finds it."""
    monkeypatch.chdir(tmp_path)
    overrides = {"learn.steps": np.int64(7), "learn.model_file": "m.npz", "read.model_file": Path("m.npz")}
    record = RunRequest(tmp_path / "run", overrides=overrides).apply(RunRecord())
    path = str(tmp_path.resolve() / "m.npz")
    assert json.loads(json.dumps(record.overrides)) == {
        "learn.steps": 7,
        "learn.model_file": path,
        "read.model_file": path,
    }


def test_the_run_is_named_after_the_video(tmp_path: Path) -> None:
    (tmp_path / "ann").mkdir()
    (tmp_path / "ann" / "video.mp4").touch()
    (tmp_path / "ann" / "walk.mp4").touch()
    named = [default_run_dir(tmp_path / "ann" / name) for name in ("video.mp4", "walk.mp4", "")]
    assert named == [Path("runs/ann"), Path("runs/walk"), Path("runs/ann")]
    with pytest.raises(UserError, match="python -m stages VIDEO"):
        default_run_dir(None)


def test_a_moved_video_is_known_beside_folders_with_another_manifest(tmp_path: Path) -> None:
    """The comparison with a ground truth has a manifest of its own format; a user's folder may have one, too."""
    video, run = tmp_path / "moved.mp4", tmp_path / "run"
    video.write_bytes(b"a video")
    for name, text in (("frames", ""), ("compare", '{"version": 6, "outputs": {}}'), ("site", '["a list"]')):
        (run / name).mkdir(parents=True)
        (run / name / MANIFEST_FILE).write_text(text)
    inputs = {"video": digest_video(video)}
    write_manifest(Manifest("frames", 1, "", {}, inputs, {}, {}, 0.0, 0.0), run / "frames" / MANIFEST_FILE)
    recorded = RunRecord(str(tmp_path / "gone.mp4"))
    assert RunRequest(run, video=video).apply(recorded).video == str(video.resolve())
    other = tmp_path / "other.mp4"
    other.write_bytes(b"another video")
    with pytest.raises(UserError, match="belongs to the video"):
        RunRequest(run, video=other).apply(recorded)
    (run / "frames" / MANIFEST_FILE).write_text('{"stage": "frames"')
    with pytest.raises(UserError, match="frames/manifest.json is damaged"):
        RunRequest(run, video=video).apply(recorded)
