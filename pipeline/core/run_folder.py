"""Run folders: their default name, and exclusive access for one command."""

from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from pipeline.core.command import format_command
from pipeline.core.errors import UserError
from pipeline.core.lock import LOCK_FILE, RunLock, run_lock
from pipeline.core.record import RUN_FILE, RunRecord, read_record, update_record

RUNS_DIR = Path("runs")


class StageFailedError(Exception):
    """The process of a stage ended with exit status `code`, after it printed its error message."""

    def __init__(self, stage: str, code: int) -> None:
        super().__init__(f"stage {stage} ended with exit status {code}; its messages are on standard error")
        self.code = code


@dataclass(frozen=True)
class RunRequest:
    """What a command changes in a run folder before it runs.

    video, preset: None keeps the recorded value.
    overrides: values by `section.key`; they add to the recorded ones.
    replace_video: whether the run may change to a video with other content.
    """

    run_dir: Path
    video: Path | None = None
    preset: str | None = None
    overrides: Mapping[str, Any] = field(default_factory=dict)
    replace_video: bool = False

    def apply(self, record: RunRecord) -> RunRecord:
        """Return the record that this command gives the run. UserError if the two contradict each other."""
        return update_record(record, self.run_dir, self.video, self.preset, self.overrides, self.replace_video)


def default_run_dir(video: Path | None) -> Path:
    """Return runs/NAME for a video; NAME is that of its folder if the file is just called `video`.

    Raises:
        UserError: there is no video.
    """
    if video is None:
        raise UserError(f"no video and no run were named: {format_command('VIDEO')}")
    video = video.resolve()
    name = video.stem if video.is_file() else video.name
    return RUNS_DIR / (video.parent.name if name == "video" else name)


def require_run(run_dir: Path) -> None:
    """Raise UserError if a path is not the folder of a run that was started."""
    _require_no_file(run_dir)
    if not run_dir.exists():
        raise UserError(f"{run_dir} does not exist: name the folder of a run with --run, runs/NAME")
    if not (run_dir / RUN_FILE).is_file():
        command = format_command("--run", run_dir, "--video", "FILE_OR_FOLDER")
        raise UserError(f"{run_dir} is not the folder of a run, it has no {RUN_FILE}: name one, or start it: {command}")


@contextmanager
def open_run(request: RunRequest) -> Iterator[tuple[RunRecord, RunLock]]:
    """Lock a run folder; yield its record, updated by the request but not written yet, and the lock.

    A new folder is removed again if the block fails before any stage has finished.

    Raises:
        UserError: the folder is a file or is in use, or the request contradicts the record.
    """
    run_dir = request.run_dir
    _require_no_file(run_dir)
    is_new = not run_dir.exists()
    record = request.apply(read_record(run_dir))
    _make_folder(run_dir)
    is_ours = False
    try:
        with run_lock(run_dir) as lock:
            is_ours = is_new
            yield record, lock
    except (UserError, StageFailedError, OSError, MemoryError):
        if is_ours:
            _remove_unused(run_dir)
        raise


def _require_no_file(run_dir: Path) -> None:
    if run_dir.is_file():
        raise UserError(f"{run_dir} is a file, but a run is a folder: choose another run folder")
    if run_dir.is_symlink() and not run_dir.exists():
        raise _dangling_link_error(run_dir)


def _make_folder(run_dir: Path) -> None:
    try:
        run_dir.mkdir(parents=True, exist_ok=True)
    except FileExistsError as error:
        raise _dangling_link_error(error.filename) from None
    except FileNotFoundError as error:  # a file system without new folders, such as /proc
        raise UserError(f"no folder can be made at {error.filename}: choose another run folder") from None


def _dangling_link_error(link: Path | str) -> UserError:
    return UserError(f"{link} is a link to a missing folder: make that folder, or remove the link")


def _remove_unused(run_dir: Path) -> None:
    """Remove a run folder without any work in it."""
    if {path.name for path in run_dir.iterdir()} <= {RUN_FILE, LOCK_FILE}:
        for path in list(run_dir.iterdir()):
            path.unlink()
        run_dir.rmdir()
