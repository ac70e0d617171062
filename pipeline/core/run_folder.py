"""Run folders: their default name, and exclusive access for one command."""

from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from pipeline.core.command import format_command
from pipeline.core.errors import EXIT_USER_ERROR, UserError
from pipeline.core.lock import LOCK_FILE, RunLock, run_lock
from pipeline.core.record import RUN_FILE, RunRecord, read_record, update_record, write_record
from pipeline.core.stage import VIDEO, Stage

RUNS_DIR = Path("runs")


class StageFailedError(Exception):
    """The process of a stage ended with exit status `code`, after it printed its error message."""

    def __init__(self, stage: str, code: int) -> None:
        super().__init__(f"stage {stage} ended with exit status {code}; its messages are on standard error")
        self.code = code


class StageKilledError(UserError):
    """The process of a stage was killed, with nothing refused: the same command resumes."""


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


@dataclass(frozen=True)
class OpenRun:
    """A run folder that this process has locked.

    earlier: its record before the request.
    record: its record with the request, which `recorded_for` writes.
    """

    request: RunRequest
    earlier: RunRecord
    record: RunRecord
    lock: RunLock

    @contextmanager
    def recorded_for(self, stage: Stage) -> Iterator[None]:
        """Record the request while a stage runs, so that a run which is killed resumes with its options.

        If the stage refuses its input, what the request has set for this stage is forgotten: its options and, if it
        reads the video, the video. The preset and the options of other stages stay.
        """
        write_record(self.record, self.request.run_dir)
        try:
            yield
        except StageKilledError:
            raise
        except (UserError, StageFailedError) as error:
            if isinstance(error, UserError) or error.code == EXIT_USER_ERROR:
                write_record(self._record_without(stage), self.request.run_dir)
            raise

    def _record_without(self, stage: Stage) -> RunRecord:
        kept = self.earlier.overrides if self.request.preset is None else {}
        accepted = {key: value for key, value in self.request.overrides.items() if key.split(".")[0] != stage.name}
        video = self.earlier.video if VIDEO in stage.needs else self.record.video
        return RunRecord(video, self.record.preset, {**kept, **accepted})


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
def open_run(request: RunRequest) -> Iterator[OpenRun]:
    """Lock a run folder.

    A new folder is removed again if the block fails before any stage has finished.

    Raises:
        UserError: the folder is a file or is in use, or the request contradicts the record.
    """
    run_dir = request.run_dir
    _require_no_file(run_dir)
    is_new = not run_dir.exists()
    earlier = read_record(run_dir)
    record = request.apply(earlier)
    _make_folder(run_dir)
    is_ours = False
    try:
        with run_lock(run_dir) as lock:
            is_ours = is_new
            yield OpenRun(request, earlier, record, lock)
    except (UserError, StageFailedError, OSError, MemoryError, KeyboardInterrupt):
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
