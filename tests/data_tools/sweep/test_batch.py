"""Batches on the toy pipeline: run folders and table with broken videos, kills and restarts."""

import csv
import os
import shutil
import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest

from data_tools.sweep.batch import find_videos, main, newest_mtime_ns, table_row, text_table, write_table
from data_tools.sweep.runs import RunState
from pipeline.core.errors import UserError
from pipeline.core.manifest import read_manifest
from pipeline.core.measure import REPOSITORY_DIR
from stages import STAGES
from tests.core.toy_pipeline import Toy, user_environment
from tests.test_resume import TOY_STAGES, artifacts, wait_for

GOOD, BROKEN = ("ann", "carl"), "bob"
OUTCOME = {"ann": "done", "bob": "failed", "carl": "done"}


@pytest.fixture
def batch(toy: Toy) -> Toy:
    """The toy pipeline with three videos; the second is broken."""
    videos = toy.folder / "videos"
    videos.mkdir()
    for name, text in ((GOOD[0], "1 2"), (BROKEN, "1 two"), (GOOD[1], "3 4 5")):
        (videos / f"{name}.mp4").write_text(text)
    (videos / "notes.txt").write_text("not a video")
    return toy


def rows(toy: Toy) -> dict[str, dict[str, str]]:
    """Rows of batch.csv by video."""
    with (toy.folder / "runs" / "batch.csv").open(newline="") as file:
        return {row["video"]: row for row in csv.DictReader(file)}


@pytest.mark.slow
def test_broken_video_does_not_stop_the_others(batch: Toy) -> None:
    message = batch.expect_user_error("data_tools.sweep.batch", "videos", "--preset", "quick")
    assert "1 of 3 videos have no avatar (bob)" in message
    table = rows(batch)
    assert {name: row["status"] for name, row in table.items()} == OUTCOME
    assert "holds two, which is not a number" in table[BROKEN]["message"]
    assert [table[BROKEN][name] for name in TOY_STAGES] == ["missing", "waits for read", "waits for read"]
    for name in GOOD:
        assert [table[name][stage] for stage in TOY_STAGES] == ["fresh"] * 3
        assert float(table[name]["seconds"]) >= 0
        assert (batch.folder / "runs" / name / "summarise" / "summary.txt").is_file()
    page = (batch.folder / "runs" / "batch.html").read_text()
    assert "2 of 3 avatars" in page
    assert "holds two" in page


@pytest.mark.slow
def test_only_a_repaired_video_runs_again(batch: Toy) -> None:
    batch.call("data_tools.sweep.batch", "videos")
    before = (batch.folder / "runs" / "ann" / "learn").stat().st_ctime_ns
    (batch.folder / "videos" / "bob.mp4").write_text("1 2")
    done = batch.call("data_tools.sweep.batch", "videos")
    assert done.returncode == 0, done.stderr
    assert {row["status"] for row in rows(batch).values()} == {"done"}
    assert (batch.folder / "runs" / "ann" / "learn").stat().st_ctime_ns == before


@pytest.mark.slow
def test_results_of_another_video_or_with_other_options_do_not_count(batch: Toy) -> None:
    """A command that is refused leaves the earlier results, which are complete."""
    (batch.folder / "videos" / "bob.mp4").write_text("1 2")
    assert batch.call("data_tools.sweep.batch", "videos").returncode == 0
    batch.expect_user_error("data_tools.sweep.batch", "videos", "--table", "--set", "learn.steps=30")
    assert [rows(batch)["ann"][name] for name in TOY_STAGES] == ["fresh", "stale", "waits for learn"]
    assert batch.call("data_tools.sweep.batch", "videos", "--table").returncode == 0
    other = batch.folder / "other"
    other.mkdir()
    (other / "ann.mp4").write_text("6 7 8")
    for arguments in ((), ("--table",)):
        batch.expect_user_error("data_tools.sweep.batch", "other", *arguments)
        (row,) = rows(batch).values()
        assert row["status"] == "failed"
        assert "belongs to the video" in row["message"]


@pytest.mark.slow
def test_killed_batch_ends_its_runs_and_resumes(batch: Toy) -> None:
    runner = batch.start("data_tools.sweep.batch", "videos", "--jobs", "3", TOY_SLEEP_S="60")
    for name in GOOD:
        wait_for(batch.folder / "runs" / name / "learn.part" / "checkpoint.json", runner)
    runner.kill()
    runner.communicate()
    batch.expect_user_error("data_tools.sweep.batch", "videos", "--jobs", "3")
    for name in GOOD:
        learnt = read_manifest(batch.folder / "runs" / name / "learn")
        assert learnt is not None
        assert (learnt.resumed, learnt.metrics) == (True, {"first_step": 1})
        undisturbed = batch.call("stages", "--run", "runs/alone", "--video", f"videos/{name}.mp4", "--force")
        assert undisturbed.returncode == 0
        runs = batch.folder / "runs"
        assert artifacts(runs / name, TOY_STAGES) == artifacts(runs / "alone", TOY_STAGES)


@pytest.mark.slow
def test_ctrl_c_stops_all_runs(batch: Toy) -> None:
    process = batch.start("data_tools.sweep.batch", "videos", TOY_SLEEP_S="30")
    wait_for(batch.folder / "runs" / "ann" / "learn.part" / "checkpoint.json", process)
    os.killpg(process.pid, signal.SIGINT)
    _, err = process.communicate(timeout=25)
    assert process.returncode == 130
    assert err.splitlines()[-1] == "interrupted: run the same command again"
    assert not (batch.folder / "runs" / "carl").exists()


@pytest.fixture
def videos(tmp_path: Path) -> Path:
    """A folder with one video file, which is never read."""
    (tmp_path / "videos").mkdir()
    (tmp_path / "videos" / "ann.mp4").touch()
    return tmp_path / "videos"


def test_table_option_runs_nothing(videos: Path, tmp_path: Path) -> None:
    with pytest.raises(UserError, match=r"1 of 1 videos have no avatar \(ann\)"):
        main([str(videos), "--runs", str(tmp_path / "runs"), "--table"])
    with (tmp_path / "runs" / "batch.csv").open(newline="") as file:
        assert [row["status"] for row in csv.DictReader(file)] == ["unfinished"]
    assert not (tmp_path / "runs" / "ann").exists()


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (("none",), "none is not a folder"),
        (("empty",), "contains no video"),
        (("videos", "--preset", "instnt"), "instant"),
        (("videos", "--set", "fild.steps=3"), r"did you mean field\?"),
        (("videos", "--jobs", "0"), "choose at least 1"),
    ],
)
def test_user_errors_are_reported_before_any_run(
    videos: Path, tmp_path: Path, arguments: tuple[str, ...], message: str
) -> None:
    (tmp_path / "empty").mkdir()
    with pytest.raises(UserError, match=message):
        main([str(tmp_path / arguments[0]), "--runs", str(tmp_path / "runs"), *arguments[1:]])
    assert not (tmp_path / "runs").exists()


def test_videos_are_files_by_suffix_and_folders(tmp_path: Path) -> None:
    for folder in ("walk", "made/video", ".hidden"):
        (tmp_path / folder).mkdir(parents=True)
    for file in ("me.MP4", "me.txt", ".dark.mp4"):
        (tmp_path / file).touch()
    found = find_videos(tmp_path)
    assert found == {"made": tmp_path / "made" / "video", "me": tmp_path / "me.MP4", "walk": tmp_path / "walk"}
    (tmp_path / "me.mov").touch()
    with pytest.raises(UserError, match=r"me\.MP4 and me\.mov"):
        find_videos(tmp_path)


def test_modification_time_of_a_folder(tmp_path: Path) -> None:
    for name, time_s in (("a", 100), ("b", 300), ("c", 200)):
        (tmp_path / name).touch()
        os.utime(tmp_path / name, (time_s, time_s))
    assert newest_mtime_ns(tmp_path) == 300 * 10**9
    assert newest_mtime_ns(tmp_path / "c") == 200 * 10**9


def test_table_escapes_html(tmp_path: Path) -> None:
    broken = RunState(dict.fromkeys(STAGES, "missing"), {}, {"mesh_psnr_full_db": 28.25}, "<b> is no video")
    row = table_row("a&b", broken)
    assert row["mesh_psnr_full_db"] == "28.250"
    assert text_table([row]).splitlines()[-1] == "a&b: <b> is no video"
    write_table(tmp_path, [row])
    page = (tmp_path / "batch.html").read_text()
    assert "&lt;b&gt; is no video" in page
    assert "a&amp;b" in page


@pytest.mark.parametrize("cluster", ["", "local"])
def test_make_without_a_folder_is_an_error(cluster: str, tmp_path: Path) -> None:
    """An empty name would select the current folder."""
    for name in ("requirements.lock", "pyproject.toml", ".venv/.stamp"):
        (tmp_path / name).parent.mkdir(exist_ok=True)
        (tmp_path / name).touch()
    command = ["make", "-f", str(REPOSITORY_DIR / "Makefile"), "batch", f"CLUSTER={cluster}"]
    done = subprocess.run(
        command, cwd=tmp_path, env=user_environment(), capture_output=True, text=True, timeout=60, check=False
    )
    assert done.returncode == 2
    assert "error: no folder of videos: make batch VIDEOS=folder" in done.stderr


def snakemake(toy: Toy, videos: str = "videos", **variables: str) -> subprocess.Popen[str]:
    """Start the workflow on the videos of the toy pipeline; skip if snakemake is not installed."""
    path = os.pathsep.join((str(Path(sys.executable).parent), os.environ.get("PATH", "")))
    program = shutil.which("snakemake", path=path)
    if program is None:
        pytest.skip("snakemake is not installed: make venv EXTRA=cluster")
    folder = REPOSITORY_DIR / "configs" / "cluster"
    command = [program, "--snakefile", str(folder / "Snakefile"), "--profile", str(folder / "local"), "--config"]
    command += [f"videos={videos}", "runs=runs", "options=--preset quick"]
    command += [f"project={toy.folder}", f"python={sys.executable}"]
    environment = user_environment() | {"PYTHONPATH": str(REPOSITORY_DIR), **variables}
    return subprocess.Popen(
        command, cwd=toy.folder, env=environment, stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True
    )


@pytest.mark.slow
def test_workflow_without_a_folder_is_an_error(batch: Toy) -> None:
    process = snakemake(batch, videos="")
    text, _ = process.communicate(timeout=60)
    assert process.returncode == 1
    assert "no folder of videos" in text


@pytest.mark.slow
def test_workflow_with_a_broken_video_and_a_kill(batch: Toy) -> None:
    killed = snakemake(batch, TOY_SLEEP_S="60")
    parts = [batch.folder / "runs" / name / "learn.part" / "checkpoint.json" for name in GOOD]
    deadline = time.monotonic() + 300.0
    while not any(part.exists() for part in parts):
        assert killed.poll() is None, killed.communicate()[0]
        assert time.monotonic() < deadline, f"none of {parts} appeared"
        time.sleep(0.02)
    killed.kill()
    killed.communicate()
    again = snakemake(batch)
    text, _ = again.communicate(timeout=60)
    assert again.returncode == 1, text
    stamps = {path.name for path in (batch.folder / "runs").glob("*.done")}
    assert stamps == {"ann.done", "carl.done"}
    assert {name: row["status"] for name, row in rows(batch).items()} == OUTCOME
    resumed = [read_manifest(batch.folder / "runs" / name / "learn") for name in GOOD]
    assert any(manifest and manifest.resumed for manifest in resumed)
    (batch.folder / "videos" / "bob.mp4").write_text("1 2")
    mended = snakemake(batch)
    text, _ = mended.communicate(timeout=60)
    assert mended.returncode == 0, text
    assert {row["status"] for row in rows(batch).values()} == {"done"}


@pytest.mark.slow
def test_three_real_captures_with_a_broken_one(smoke_run: Path, tmp_path: Path) -> None:
    """A video, an invalid file and a folder of images with the real stages; the batch is killed once."""
    videos, runs = tmp_path / "videos", tmp_path / "runs"
    videos.mkdir()
    shutil.copy(smoke_run.parent / "capture" / "video" / "video.mp4", videos / "ann.mp4")
    (videos / "bob.mp4").write_bytes(b"no video at all" * 100)
    shutil.copytree(smoke_run / "frames" / "images", videos / "carl")
    command = [sys.executable, "-m", "data_tools.sweep.batch", str(videos), "--runs", str(runs), "--preset", "smoke"]
    command += ["--set", "field.steps=20", "--set", "mesh.steps=2"]
    killed = subprocess.Popen(command, cwd=REPOSITORY_DIR, env=user_environment())
    wait_for(runs / "ann" / "body.part", killed)
    killed.kill()
    killed.wait()
    done = subprocess.run(
        command, cwd=REPOSITORY_DIR, env=user_environment(), capture_output=True, text=True, check=False
    )
    assert done.returncode == 2
    with (runs / "batch.csv").open(newline="") as file:
        table = {row["video"]: row for row in csv.DictReader(file)}
    assert {name: row["status"] for name, row in table.items()} == OUTCOME, done.stdout
    assert "bob.mp4" in table[BROKEN]["message"]
    for name in GOOD:
        assert (runs / name / "export" / "avatar.glb").is_file()
        assert float(table[name]["mesh_psnr_full_db"]) > 10
