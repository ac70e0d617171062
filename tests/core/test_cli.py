"""Commands of the toy pipeline: what is cached, what runs, what is recorded, and how errors are reported."""

import json
import os
import signal
import subprocess
import sys
import time
from collections.abc import Sequence
from pathlib import Path

import pytest

from pipeline.core.cli import main_pipeline
from pipeline.core.command import COMMAND_VARIABLE
from pipeline.core.measure import REPOSITORY_DIR
from tests.core.toy.stages import PIPELINE
from tests.core.toy_pipeline import Toy, user_environment


def states(table: str) -> list[str]:
    """The second column of the summary or status table."""
    return [line.split()[1] for line in table.splitlines() if line.split()[0] in ("read", "learn", "summarise")]


def test_all_stages_run_and_then_are_cached(toy: Toy) -> None:
    first = toy.call_all("--video", "numbers.txt")
    assert first.returncode == 0, first.stderr
    assert states(first.stdout) == ["run"] * 3
    assert {"stage", "state", "seconds", "peak", "total"} <= set(first.stdout.split())
    assert (toy.run_dir / "summarise" / "summary.txt").read_text().startswith("3 numbers, state ")
    assert states(toy.all().stdout) == ["cached"] * 3
    assert states(toy.all("--status").stdout) == ["fresh"] * 3


def test_what_a_user_waits_for_is_named_before_the_next_stage_begins(toy: Toy) -> None:
    told = toy.call_all("--video", "numbers.txt").stderr
    assert told.index("[2/3] learn") < told.index(str(Path("learn") / "trail")) < told.index("[3/3] summarise")


def test_the_video_is_never_written(toy: Toy) -> None:
    before = toy.video.stat()
    toy.all("--video", "numbers.txt")
    after = toy.video.stat()
    assert (before.st_mtime_ns, before.st_ino, before.st_size) == (after.st_mtime_ns, after.st_ino, after.st_size)


def test_a_change_reruns_what_reads_it(toy: Toy) -> None:
    toy.all("--video", "numbers.txt")
    assert states(toy.all("--set", "summarise.word=value").stdout) == ["cached", "cached", "run"]
    assert states(toy.all("--set", "learn.steps=21").stdout) == ["cached", "run", "run"]


def test_equal_outputs_keep_what_follows_cached(toy: Toy) -> None:
    toy.all("--video", "numbers.txt")
    toy.video.write_text("1 2 0\n")
    assert states(toy.all().stdout) == ["run", "cached", "cached"]


def test_from_and_force_run_again(toy: Toy) -> None:
    toy.all("--video", "numbers.txt")
    assert states(toy.all("--from", "learn").stdout) == ["cached", "run", "run"]
    assert states(toy.all("--force").stdout) == ["run"] * 3


def test_one_stage_uses_the_recorded_options(toy: Toy) -> None:
    toy.all("--video", "numbers.txt", "--preset", "quick", "--set", "summarise.word=value")
    record = json.loads((toy.run_dir / "run.json").read_text())
    assert record == {"video": str(toy.video), "preset": "quick", "overrides": {"summarise.word": "value"}}
    for name in ("read", "learn", "summarise"):
        assert toy.stages(name, "runs/a").stdout == f"runs/a/{name}: cached\n"
    assert toy.stages("learn", "runs/a", "--set", "learn.steps=7").stdout == "runs/a/learn: done\n"
    assert states(toy.all("--status").stdout) == ["fresh", "fresh", "stale"]
    toy.all("--preset", "default")
    assert json.loads((toy.run_dir / "run.json").read_text())["overrides"] == {}


def test_stages_run_one_by_one_make_the_same(toy: Toy) -> None:
    toy.all("--video", "numbers.txt")
    toy.call("stages.read", "runs/b", "--video", "numbers.txt")
    toy.call("stages", "learn", "runs/b")
    toy.stages("summarise", "runs/b")
    summaries = [(toy.folder / "runs" / name / "summarise" / "summary.txt").read_bytes() for name in "ab"]
    assert summaries[0] == summaries[1]


def test_verify_finds_a_changed_file(toy: Toy) -> None:
    toy.all("--video", "numbers.txt")
    (toy.run_dir / "learn" / "scene.blend").write_text("of the user")
    assert toy.all("--verify").stdout.count("intact") == 3
    (toy.run_dir / "learn" / "trail" / "state.json").write_text("{}")
    sentence = toy.expect_user_error("stages", "--run", "runs/a", "--verify")
    assert "trail/state.json" in sentence
    assert sentence.endswith("python -m stages --run runs/a --from learn")
    assert toy.all("--from", "learn").returncode == 0
    assert toy.all("--verify").returncode == 0


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        (("--set", "learn.steps=0"), ("learn.steps = 0", "at least 1")),
        (("--set", "learn.stepz=3"), ("did you mean steps?", "known keys of learn: steps")),
        (("--set", "lern.steps=3"), ("did you mean learn?", "read, learn, summarise")),
        (("--set", "steps=3"), ("--set section.key=value",)),
        (("--preset", "quik"), ("default, quick",)),
        (("--from", "lern"), ("lern", "'learn'")),
        (("--bla",), ("--bla", "--help")),
        (("--vid", "numbers.txt"), ("--vid", "--help")),
        (("--video", "none.txt"), ("none.txt does not exist",)),
        (("--video", "."), ("inside the video folder",)),
        (("numbers.txt", "--video", "numbers.txt"), ("two videos",)),
        ((), ("has no video yet", "--video")),
    ],
)
def test_a_mistake_is_one_sentence_and_leaves_nothing(toy: Toy, arguments: Sequence[str], words: Sequence[str]) -> None:
    sentence = toy.expect_user_error("stages", "--run", "runs/a", *arguments)
    assert all(word in sentence for word in words), sentence
    assert not toy.run_dir.exists()


def test_a_stage_refuses_options_of_others(toy: Toy) -> None:
    assert "learn.key=value" in toy.expect_user_error("stages", "learn", "runs/a", "--set", "summarise.word=x")
    assert "python -m stages read runs/a" in toy.expect_user_error("stages", "learn", "runs/a")
    assert "python -m stages learn --help" in toy.expect_user_error("stages.learn")


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        (("lern", "runs/a"), ("lern", "did you mean learn?", "read, learn, summarise")),
        (("lern",), ("did you mean learn?",)),
        (("export", "runs/a"), ("export is neither a stage nor a video", "read, learn, summarise")),
        (("runs/a", "learn"), ("python -m stages learn runs/a",)),
        (("--preset", "quick", "learn", "runs/a"), ("python -m stages learn runs/a",)),
        (("--preset", "quick", "learn"), ("python -m stages learn RUN",)),
        (("numbers.txt", "other.txt"), ("other.txt is a second", "quote")),
    ],
)
def test_a_misspelt_or_misplaced_stage_is_named(toy: Toy, arguments: Sequence[str], words: Sequence[str]) -> None:
    sentence = toy.expect_user_error("stages", *arguments)
    assert all(word in sentence for word in words), sentence


def test_a_video_may_have_the_name_of_a_stage(toy: Toy) -> None:
    toy.video.rename(toy.folder / "learn")
    assert toy.stages("--run", "runs/a", "learn").returncode == 0


def test_the_status_is_that_under_the_options_of_the_command(toy: Toy) -> None:
    toy.all("--video", "numbers.txt")
    before = (toy.run_dir / "run.json").read_bytes()
    assert states(toy.all("--status", "--set", "summarise.word=value").stdout) == ["fresh", "fresh", "stale"]
    assert states(toy.all("--status", "--preset", "quick").stdout) == ["fresh", "stale", "waits"]
    assert "known keys of learn: steps" in toy.expect_user_error(
        "stages", "--run", "runs/a", "--status", "--set", "learn.stepz=3"
    )
    (toy.folder / "other.txt").write_text("4 5 6")
    assert "--force" in toy.expect_user_error("stages", "--run", "runs/a", "--status", "--video", "other.txt")
    assert (toy.run_dir / "run.json").read_bytes() == before


@pytest.mark.parametrize(
    ("arguments", "unused"),
    [
        (("--status", "--force"), "--force"),
        (("--status", "--from", "learn"), "--from"),
        (("--verify", "--set", "learn.steps=3"), "--set"),
        (("--verify", "--preset", "quick"), "--preset"),
        (("--verify", "--status"), "--status"),
        (("--defaults",), "--run"),
    ],
)
def test_options_without_effect_are_refused(toy: Toy, arguments: Sequence[str], unused: str) -> None:
    toy.all("--video", "numbers.txt")
    assert unused in toy.expect_user_error("stages", "--run", "runs/a", *arguments)


@pytest.mark.parametrize("mode", ["--status", "--verify"])
def test_the_state_of_what_is_no_run_is_an_error(toy: Toy, mode: str) -> None:
    (toy.folder / "photos").mkdir()
    for run, words in (
        ("runs/none", "runs/none does not exist: name the folder of a run"),
        ("numbers.txt", "numbers.txt is a file, but a run is a folder"),
        ("photos", "photos is not the folder of a run, it has no run.json"),
    ):
        assert words in toy.expect_user_error("stages", "--run", run, mode)
    assert "runs/numbers does not exist" in toy.expect_user_error("stages", "numbers.txt", mode)


@pytest.mark.parametrize("command", [("stages", "--run"), ("stages", "read")])
def test_a_folder_that_cannot_be_made_is_one_sentence(toy: Toy, command: Sequence[str]) -> None:
    (toy.folder / "link").symlink_to("nowhere")
    (toy.folder / "loop").symlink_to("loop")
    for run, words in (
        ("link", "link is a link to a missing folder: make that folder, or remove the link"),
        ("link/a", "link is a link to a missing folder"),
        ("loop", "loop is a link to a missing folder"),
        ("x" * 300, "the name is too long: choose a shorter name"),
        ("/proc/new", "no folder can be made at /proc/new"),
    ):
        sentence = toy.expect_user_error(*command, run, "--video", "numbers.txt")
        assert words in sentence
        assert command[1] == "--run" or "--run" not in sentence
    assert "name is too long" in toy.expect_user_error("stages", "x" * 300)


def test_a_file_is_no_run(toy: Toy) -> None:
    (toy.folder / "notes").write_text("in the way")
    assert "notes is a file, but a run is a folder" in toy.expect_user_error(
        "stages", "--run", "notes", "--video", "numbers.txt"
    )
    below = toy.expect_user_error("stages", "--run", "notes/a", "--video", "numbers.txt")
    assert "notes/a cannot be read or written, a part of this path is a file" in below
    assert (toy.folder / "notes").read_text() == "in the way"


def test_bad_input_leaves_no_folder(toy: Toy) -> None:
    toy.video.write_text("1 two 3")
    assert "holds two" in toy.expect_user_error("stages", "--run", "runs/a", "--video", "numbers.txt")
    assert not toy.run_dir.exists()
    assert "holds two" in toy.expect_user_error("stages", "read", "runs/a", "--video", "numbers.txt")
    assert not toy.run_dir.exists()


def test_bad_input_leaves_earlier_results(toy: Toy) -> None:
    toy.all("--video", "numbers.txt")
    toy.video.write_text("1 two 3")
    toy.expect_user_error("stages", "--run", "runs/a")
    assert {path.name for path in toy.run_dir.iterdir()} == {"read", "learn", "summarise", "run.json", ".lock"}


def read_overrides(run_dir: Path) -> dict[str, object]:
    overrides: dict[str, object] = json.loads((run_dir / "run.json").read_text())["overrides"]
    return overrides


@pytest.mark.parametrize("isolated", [False, True])
def test_what_a_stage_refuses_is_not_recorded(toy: Toy, isolated: bool) -> None:
    call = toy.call_all if isolated else toy.all
    toy.all("--video", "numbers.txt", "--set", "summarise.word=value")
    refused = call("--set", "summarise.word=w1", "--set", "learn.steps=7", "--preset", "quick")
    assert refused.returncode == 2
    assert refused.stderr.splitlines()[-1] == "error: summarise.word = w1 is not a word: choose letters"
    record = json.loads((toy.run_dir / "run.json").read_text())
    assert record == {"video": str(toy.video), "preset": "quick", "overrides": {"learn.steps": "7"}}
    assert call().returncode == 0


def test_a_refusal_keeps_the_earlier_options(toy: Toy) -> None:
    toy.all("--video", "numbers.txt", "--set", "summarise.word=value")
    toy.expect_user_error("stages", "summarise", "runs/a", "--set", "summarise.word=w1")
    assert read_overrides(toy.run_dir) == {"summarise.word": "value"}
    assert states(toy.all("--status").stdout) == ["fresh"] * 3


def test_a_new_run_keeps_its_video_if_a_later_stage_refuses(toy: Toy) -> None:
    toy.expect_user_error("stages", "--run", "runs/a", "--video", "numbers.txt", "--set", "summarise.word=w1")
    assert states(toy.all().stdout) == ["cached", "cached", "run"]


def test_a_video_that_is_refused_is_not_recorded(toy: Toy) -> None:
    toy.all("--video", "numbers.txt")
    (toy.folder / "words.txt").write_text("1 two 3")
    toy.expect_user_error("stages", "--run", "runs/a", "--video", "words.txt", "--force")
    assert states(toy.all().stdout) == ["cached"] * 3


def test_options_of_a_killed_run_stay_recorded(toy: Toy) -> None:
    killed = toy.call_all("--video", "numbers.txt", "--set", "learn.steps=30", TOY_KILL_STEP="25")
    assert "killed by signal 9" in killed.stderr
    assert read_overrides(toy.run_dir) == {"learn.steps": "30"}


def test_another_video_needs_force(toy: Toy) -> None:
    toy.all("--video", "numbers.txt")
    copy, other = toy.folder / "copy.txt", toy.folder / "other.txt"
    copy.write_bytes(toy.video.read_bytes())
    other.write_text("4 5 6")
    assert states(toy.all("--video", "copy.txt").stdout) == ["cached"] * 3
    assert "--force" in toy.expect_user_error("stages", "--run", "runs/a", "--video", "other.txt")
    assert states(toy.all("--video", "other.txt", "--force").stdout) == ["run"] * 3


def test_a_video_that_was_moved_is_known_by_its_content(toy: Toy) -> None:
    toy.all("--video", "numbers.txt")
    toy.video.rename(toy.folder / "moved.txt")
    assert "name the video with --video" in toy.expect_user_error("stages", "--run", "runs/a", "--status")
    assert states(toy.all("--status", "--video", "moved.txt").stdout) == ["fresh"] * 3
    assert states(toy.all("--video", "moved.txt").stdout) == ["cached"] * 3
    assert states(toy.all().stdout) == ["cached"] * 3


def test_a_run_folder_is_no_video(toy: Toy) -> None:
    toy.all("--video", "numbers.txt")
    sentence = toy.expect_user_error("stages", "runs/a")
    assert sentence.endswith(f"python -m stages --run {toy.run_dir}")
    assert "is the folder of a run, not a video" in sentence


@pytest.mark.parametrize("arguments", [("",), ("--run", ""), ("--video", ""), ("read", "")])
def test_an_empty_path_is_not_the_working_directory(toy: Toy, arguments: Sequence[str]) -> None:
    before = sorted(toy.folder.rglob("*"))
    assert "the path is empty" in toy.expect_user_error("stages", *arguments)
    assert sorted(toy.folder.rglob("*")) == before


def test_ctrl_c_before_any_work_leaves_no_folder(toy: Toy, monkeypatch: pytest.MonkeyPatch) -> None:
    def interrupt(_: object) -> None:
        raise KeyboardInterrupt

    monkeypatch.setattr("pipeline.core.pipeline.Pipeline.load_stages", interrupt)
    assert toy.all("--video", "numbers.txt").returncode == 130
    assert not toy.run_dir.exists()


def test_a_video_needs_no_option(toy: Toy) -> None:
    done = toy.stages("numbers.txt")
    assert done.returncode == 0, done.stderr
    assert (toy.folder / "runs" / "numbers" / "summarise" / "summary.txt").is_file()


def test_messages_name_the_command_in_use(toy: Toy, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv(COMMAND_VARIABLE, "instant-human-mesh")
    assert "instant-human-mesh read runs/a" in toy.expect_user_error("stages", "learn", "runs/a")
    assert "see instant-human-mesh --help" in toy.expect_user_error("stages", "--bla")


def test_help_and_version_are_printed(toy: Toy, capsys: pytest.CaptureFixture[str]) -> None:
    assert toy.stages("--version").stdout == "toy\n"
    with pytest.raises(SystemExit, match="0"):
        main_pipeline(PIPELINE, ["--help"])
    assert "read, learn, summarise" in " ".join(capsys.readouterr().out.split())


def test_a_folder_of_the_user_does_not_hide_the_stages(toy: Toy) -> None:
    """The runner imports the stages in its children from where it imported them itself."""
    elsewhere = toy.folder / "elsewhere"
    for name in ("pipeline.py", "stages.py"):
        elsewhere.mkdir(exist_ok=True)
        (elsewhere / name).write_text("raise ImportError('a file of the user')")
    code = "import sys; sys.path.remove(''); from stages.__main__ import main_pipeline, PIPELINE\n"
    code += "raise SystemExit(main_pipeline(PIPELINE, ['../numbers.txt']))"
    environment = user_environment() | {"PYTHONPATH": os.pathsep.join([str(toy.folder), str(REPOSITORY_DIR)])}
    done = subprocess.run(
        [sys.executable, "-c", code], cwd=elsewhere, env=environment, capture_output=True, text=True, check=False
    )
    assert done.returncode == 0, done.stderr


def test_an_interrupted_force_is_not_said_to_resume(toy: Toy) -> None:
    toy.all("--video", "numbers.txt")
    process = toy.start("stages", "--run", "runs/a", "--from=learn", TOY_SLEEP_S="30")
    wait_for(toy.run_dir / "learn.part" / "checkpoint.json")
    os.killpg(process.pid, signal.SIGINT)
    _, err = process.communicate(timeout=30)
    assert err.splitlines()[-1].startswith("interrupted: the same command starts over, because of --force or --from")


def test_ctrl_c_prints_one_line(toy: Toy) -> None:
    process = toy.start("stages", "--run", "runs/a", "--video", "numbers.txt", TOY_SLEEP_S="30")
    wait_for(toy.run_dir / "learn.part" / "checkpoint.json")
    os.killpg(process.pid, signal.SIGINT)
    _, err = process.communicate(timeout=30)
    assert process.returncode == 130
    assert err.splitlines()[-1] == "interrupted: run the same command again to resume"
    assert "Traceback" not in err
    assert states(toy.all().stdout) == ["cached", "run", "run"]


def test_the_defaults_print_as_yaml(toy: Toy) -> None:
    text = toy.stages("--defaults").stdout
    assert "learn:\n  # steps of the chain\n  steps: 20\n" in text


def test_a_stage_module_is_not_imported_twice(toy: Toy) -> None:
    done = toy.call("stages.read", "runs/a", "--video", "numbers.txt")
    assert "RuntimeWarning" not in done.stderr


def wait_for(path: Path, timeout_s: float = 30.0) -> None:
    """Wait until a file exists."""
    deadline = time.monotonic() + timeout_s
    while not path.exists():
        assert time.monotonic() < deadline, f"{path} did not appear"
        time.sleep(0.02)


def test_a_full_disk_is_one_sentence_and_leaves_nothing(toy: Toy) -> None:
    full = "import errno, pathlib, stages.read as read; from stages import CONFIG_DIR\n"
    full += "def write(*arguments, **options): raise OSError(errno.ENOSPC, 'full')\n"
    full += "pathlib.Path.write_text = write\n"
    full += "raise SystemExit(read.main(read.STAGE, ['runs/a', '--video', 'numbers.txt'], CONFIG_DIR))"
    (toy.folder / "full.py").write_text(full)
    assert "the disk is full: free some space" in toy.expect_user_error("full")
    assert not toy.run_dir.exists()
