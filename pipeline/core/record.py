"""Record of a run in `run.json`: its video, preset and overrides, which later commands reuse."""

import json
import os
from collections.abc import Mapping
from dataclasses import asdict, dataclass, field, replace
from pathlib import Path
from typing import Any

from pipeline.core.atomic import atomic_path
from pipeline.core.command import format_command
from pipeline.core.config import FILE_OPTION_SUFFIX, PRESET_SUFFIXES
from pipeline.core.errors import UserError
from pipeline.core.json_file import load_json
from pipeline.core.manifest import digest_video, finished_stages

RUN_FILE = "run.json"


@dataclass(frozen=True)
class RunRecord:
    """Inputs of a run: absolute path of the video (None until it is known), preset, overrides by `section.key`."""

    video: str | None = None
    preset: str = "default"
    overrides: dict[str, Any] = field(default_factory=dict)

    @property
    def video_path(self) -> Path | None:
        """Path of the video, or None."""
        return Path(self.video) if self.video else None


def read_record(run_dir: Path) -> RunRecord:
    """Read the record of a run; return an empty record if there is none.

    Raises:
        UserError: `run.json` is damaged.
    """
    path = run_dir / RUN_FILE
    if not path.exists():
        return RunRecord()
    try:
        return RunRecord(**load_json(path))
    except (ValueError, TypeError):
        raise UserError(f"{path} is damaged: delete it and name the video again with --video") from None


def write_record(record: RunRecord, run_dir: Path) -> None:
    """Write the record of a run atomically."""
    with atomic_path(run_dir / RUN_FILE) as path:
        path.write_text(json.dumps(asdict(record), indent=2) + "\n", encoding="utf-8")


def update_record(
    record: RunRecord,
    run_dir: Path,
    video: Path | None,
    preset: str | None,
    overrides: Mapping[str, Any],
    replace_video: bool,
) -> RunRecord:
    """Apply the options of a command to a record: a new preset clears the earlier overrides, overrides accumulate.

    Args:
        video, preset: None keeps the recorded value.
        overrides: values by `section.key`.
        replace_video: whether a run may change to a video with other content.

    Raises:
        UserError: the video does not exist, contains the run folder, or differs from the recorded one.
    """
    if video is not None:
        record = replace(record, video=str(_checked_video(record, run_dir, video, replace_video)))
    if preset is not None:
        is_file = preset.endswith(PRESET_SUFFIXES)
        record = replace(record, preset=str(Path(preset).resolve()) if is_file else preset, overrides={})
    given = {key: _recorded_value(key, value) for key, value in overrides.items()}
    return replace(record, overrides={**record.overrides, **given})


def _recorded_value(key: str, value: Any) -> Any:
    """Return the value of an option as JSON can hold it; the path of a file (`..._file`) is made absolute."""
    if hasattr(value, "tolist"):  # a number or an array of NumPy
        value = value.tolist()
    if isinstance(value, os.PathLike):
        value = os.fspath(value)
    return str(Path(value).resolve()) if key.endswith(FILE_OPTION_SUFFIX) and isinstance(value, str) else value


def _checked_video(record: RunRecord, run_dir: Path, video: Path, replace_video: bool) -> Path:
    if not video.exists():
        raise UserError(f"video {video} does not exist: name a video file or a folder of images")
    video = video.resolve()
    if (video / RUN_FILE).is_file():
        raise UserError(f"{video} is the folder of a run, not a video: {format_command('--run', video)}")
    if video.is_dir() and run_dir.resolve().is_relative_to(video):
        raise UserError(f"run {run_dir} is inside the video folder, which is never written: choose another run folder")
    known = record.video_path
    if known is None or known == video or replace_video:
        return video
    digest = digest_video(video)
    if digest in _digests_of_video(run_dir) or (known.exists() and digest_video(known) == digest):
        return video
    raise UserError(f"{run_dir} belongs to the video {known}, not {video}: choose another run folder, or use --force")


def _digests_of_video(run_dir: Path) -> set[str]:
    """Return the digests of the videos that the finished stages of a run have read: of one that moved since, too."""
    inputs = [manifest.inputs for manifest in finished_stages(run_dir).values()]
    return {digests["video"] for digests in inputs if "video" in digests}
