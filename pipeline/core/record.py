"""What a run remembers in `run.json`: its video, preset and overrides, so that any command can go on with it."""

import json
from collections.abc import Sequence
from dataclasses import asdict, dataclass, field, replace
from pathlib import Path
from typing import Any

from pipeline.core.atomic import atomic_path
from pipeline.core.config import PRESET_SUFFIXES, parse_overrides
from pipeline.core.errors import UserError
from pipeline.core.manifest import digest_video

RUN_FILE = "run.json"


@dataclass(frozen=True)
class RunRecord:
    """The inputs of a run: an absolute video path (None until given), a preset, dotted overrides."""

    video: str | None = None
    preset: str = "default"
    overrides: dict[str, Any] = field(default_factory=dict)

    @property
    def video_path(self) -> Path | None:
        """The video as a path."""
        return Path(self.video) if self.video else None


def read_record(run_dir: Path) -> RunRecord:
    """Read the run's record; an empty one where there is none."""
    path = run_dir / RUN_FILE
    if not path.exists():
        return RunRecord()
    try:
        return RunRecord(**json.loads(path.read_text(encoding="utf-8")))
    except (ValueError, TypeError):
        raise UserError(f"{path} is damaged: delete it and give --video again") from None


def write_record(record: RunRecord, run_dir: Path) -> None:
    """Write the run's record, whole or not at all."""
    with atomic_path(run_dir / RUN_FILE) as path:
        path.write_text(json.dumps(asdict(record), indent=2) + "\n", encoding="utf-8")


def update_record(
    record: RunRecord,
    run_dir: Path,
    video: Path | None,
    preset: str | None,
    assignments: Sequence[str],
    replace_video: bool,
) -> RunRecord:
    """The record after a command's options: a preset starts its overrides anew, `--set` adds to them.

    UserError when the run belongs to another video and `replace_video` is False, or when the video holds the run.
    """
    if video is not None:
        record = replace(record, video=str(_checked_video(record, run_dir, video, replace_video)))
    if preset is not None:
        is_file = preset.endswith(PRESET_SUFFIXES)
        record = replace(record, preset=str(Path(preset).resolve()) if is_file else preset, overrides={})
    return replace(record, overrides={**record.overrides, **parse_overrides(assignments)})


def _checked_video(record: RunRecord, run_dir: Path, video: Path, replace_video: bool) -> Path:
    if not video.exists():
        raise UserError(f"video {video} does not exist: give a video file or a folder of images")
    video = video.resolve()
    if video.is_dir() and run_dir.resolve().is_relative_to(video):
        raise UserError(f"run {run_dir} lies inside the video folder, which stays untouched: choose another --run")
    known = record.video_path
    if known is None or known == video or replace_video:
        return video
    if known.exists() and digest_video(known) == digest_video(video):
        return video
    raise UserError(f"{run_dir} was made from {known}, not {video}: choose another --run, or replace it with --force")
