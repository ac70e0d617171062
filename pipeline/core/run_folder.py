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


@contextmanager
def open_run(request: RunRequest) -> Iterator[tuple[RunRecord, RunLock]]:
    """Lock a run folder; yield its record, updated by the request but not written yet, and the lock.

    A new folder is removed again if the block fails before any stage has finished.

    Raises:
        UserError: the folder is a file or is in use, or the request contradicts the record.
    """
    run_dir = request.run_dir
    if run_dir.is_file():
        raise UserError(f"{run_dir} is a file, but a run is a folder: choose another name with --run")
    is_new = not run_dir.exists()
    record = update_record(
        read_record(run_dir), run_dir, request.video, request.preset, request.overrides, request.replace_video
    )
    run_dir.mkdir(parents=True, exist_ok=True)
    is_ours = False
    try:
        with run_lock(run_dir) as lock:
            is_ours = is_new
            yield record, lock
    except (UserError, StageFailedError, OSError, MemoryError):
        if is_ours:
            _remove_unused(run_dir)
        raise


def _remove_unused(run_dir: Path) -> None:
    """Remove a run folder without any work in it."""
    if {path.name for path in run_dir.iterdir()} <= {RUN_FILE, LOCK_FILE}:
        for path in list(run_dir.iterdir()):
            path.unlink()
        run_dir.rmdir()
