"""A stage: a named function from input folders to an output folder, which exists complete or not at all.

The work happens in `<stage>.part/`. After a kill, only `checkpoint*` files remain valid there, and only for a run with
the same fingerprint. A finished folder gets its manifest, is flushed to disk, and is renamed to `<stage>/`.
"""

import math
import os
import shutil
import time
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from pipeline.core.atomic import atomic_path, fsync_path
from pipeline.core.command import format_command
from pipeline.core.config import FILE_OPTION_SUFFIX, Config
from pipeline.core.errors import UserError
from pipeline.core.manifest import (
    MANIFEST_FILE,
    Manifest,
    digest_file,
    digest_files,
    digest_video,
    fingerprint,
    list_files,
    read_manifest,
    write_manifest,
)
from pipeline.core.measure import describe_environment, peak_rss_mib
from pipeline.core.progress import take_warnings

VIDEO = "video"
FINGERPRINT = ".fingerprint"
CHECKPOINT_PREFIX = "checkpoint"
MARKS = (MANIFEST_FILE, FINGERPRINT)
"""Files of which a folder that a stage made has at least one."""


@dataclass(frozen=True)
class Stage:
    """One step of the pipeline.

    name: name of the module, the config section, the folder and the command.
    version: raised when the meaning of the outputs changes.
    needs: names of the stages that it reads, or "video" for the user's file or folder.
    makes: files and folders on which later stages rely; not empty after a run. Other outputs are allowed.
    config: its options; the content of a file that an option in `_file` names counts as an input.
    run: `run(inputs, out, config) -> metrics`; `inputs` maps each need to its path, `out` is the folder to fill.
    shows: the file of `makes` that a user waits for; the command names it as soon as the stage is done.
    """

    name: str
    version: int
    needs: tuple[str, ...]
    makes: tuple[str, ...]
    config: type[Config]
    run: Callable[[Mapping[str, Path], Path, Any], Mapping[str, float]]
    shows: str | None = None


@dataclass(frozen=True)
class StagePlan:
    """A stage in one run folder: its inputs with their digests, and the fingerprint of the result."""

    stage: Stage
    config: Config
    run_dir: Path
    inputs: Mapping[str, Path]
    input_digests: Mapping[str, str]
    fingerprint: str

    @property
    def folder(self) -> Path:
        """Folder of the finished artifacts."""
        return self.run_dir / self.stage.name

    @property
    def work_dir(self) -> Path:
        """Folder of unfinished work."""
        return self.run_dir / f"{self.stage.name}.part"

    @property
    def previous(self) -> Path:
        """Folder of the artifacts that are being replaced."""
        return self.run_dir / f"{self.stage.name}.old"

    def is_fresh(self) -> bool:
        """Return True if the folder holds the result of this fingerprint and no file is missing."""
        manifest = read_manifest(self.folder)
        return (
            manifest is not None
            and manifest.fingerprint == self.fingerprint
            and all((self.folder / name).is_file() for name in manifest.outputs)
        )


def plan_stage(stage: Stage, config: Config, run_dir: Path, video: Path | None) -> StagePlan:
    """Find the inputs of a stage and compute the fingerprint of its result.

    Args:
        video: the user's file or folder; None if it is not known yet.

    Raises:
        UserError: an input is missing; the message names the command that makes it.
    """
    inputs, digests = {}, {}
    for need in stage.needs:
        if need == VIDEO:
            if video is None:
                command = format_command("--run", run_dir, "--video", "FILE_OR_FOLDER")
                raise UserError(f"{run_dir} has no video yet: {command}")
            inputs[need], digests[need] = video, digest_video(video)
            continue
        manifest = read_manifest(run_dir / need)
        if manifest is None:
            raise UserError(f"{stage.name} needs {run_dir / need}, which is missing: {format_command(need, run_dir)}")
        inputs[need], digests[need] = run_dir / need, manifest.outputs_digest
    digests |= _digests_of_named_files(config)
    key = fingerprint(stage.name, stage.version, config.model_dump(mode="json"), digests)
    return StagePlan(stage, config, run_dir, inputs, digests, key)


def _digests_of_named_files(config: Config) -> dict[str, str]:
    """Return the digests of the files that options ending in `_file` name; the stage reports one that is missing."""
    paths = {name: Path(value) for name, value in config if name.endswith(FILE_OPTION_SUFFIX) and value is not None}
    return {name: digest_file(path) for name, path in paths.items() if path.is_file()}


def run_stage(plan: StagePlan, force: bool = False) -> bool:
    """Run a stage unless its result is fresh; return whether it ran.

    Bad input, a full disk or too little memory removes the unfinished folder. A kill or Ctrl-C keeps its checkpoints,
    from which the next call resumes.

    Args:
        force: run even if the result is fresh, from the beginning.

    Raises:
        UserError, OSError, MemoryError: from the stage; UserError if a folder of its name was not made by a stage.
        RuntimeError: the stage did not make a declared output (a fault of its code).
    """
    for folder in (plan.folder, plan.previous, plan.work_dir):
        _require_made(folder)
    _retire_previous(plan)
    if plan.is_fresh() and not force:
        discard_work_dir(plan)
        return False
    try:
        _execute(plan, force)
        _publish(plan)
    except (UserError, OSError, MemoryError):
        discard_work_dir(plan)
        raise
    return True


def discard_work_dir(plan: StagePlan) -> None:
    """Remove unfinished work, if it exists. UserError if no stage made the folder."""
    _require_made(plan.work_dir)
    _remove_made(plan.work_dir)


def _execute(plan: StagePlan, force: bool) -> None:
    """Fill the work folder and write its manifest, unless a run that was killed just before the rename did so."""
    if not force and _manifest_fingerprint(plan.work_dir) == plan.fingerprint:
        return
    resumed = _prepare_work_dir(plan, force)
    take_warnings()
    start = time.monotonic()
    metrics = plan.stage.run(plan.inputs, plan.work_dir, plan.config)
    seconds = time.monotonic() - start
    _check_outputs(plan)
    manifest = Manifest(
        stage=plan.stage.name,
        version=plan.stage.version,
        fingerprint=plan.fingerprint,
        config=plan.config.model_dump(mode="json"),
        inputs=dict(plan.input_digests),
        outputs={name: digest for name, digest in digest_files(plan.work_dir).items() if not _is_working_file(name)},
        metrics={name: float(value) if math.isfinite(value) else None for name, value in metrics.items()},
        seconds=round(seconds, 3),
        peak_rss_mib=round(peak_rss_mib(), 1),
        resumed=resumed,
        warnings=take_warnings(),
        environment=describe_environment(),
    )
    _fsync_tree(plan.work_dir)
    with atomic_path(plan.work_dir / MANIFEST_FILE) as path:
        write_manifest(manifest, path)


def _prepare_work_dir(plan: StagePlan, force: bool) -> bool:
    """Prepare the work folder; return True if it holds checkpoints of a run with the same fingerprint."""
    fingerprint_path = plan.work_dir / FINGERPRINT
    is_same_fingerprint = not force and fingerprint_path.is_file() and fingerprint_path.read_text() == plan.fingerprint
    if not is_same_fingerprint:
        _remove_made(plan.work_dir)
        plan.work_dir.mkdir(parents=True)
        fingerprint_path.write_text(plan.fingerprint)
    kept = False
    for path in plan.work_dir.iterdir():
        if path.name.startswith(CHECKPOINT_PREFIX):
            kept = True
        elif path != fingerprint_path:
            _remove(path)
    return kept


def _check_outputs(plan: StagePlan) -> None:
    """Raise RuntimeError if a declared output is missing or empty."""
    for declared in plan.stage.makes:
        path = plan.work_dir / declared
        if not (any(path.iterdir()) if path.is_dir() else path.is_file() and path.stat().st_size > 0):
            raise RuntimeError(f"stage {plan.stage.name} did not make {declared}")


def _publish(plan: StagePlan) -> None:
    """Remove the working files and rename the work folder; the result that it replaces is removed last."""
    for path in list(plan.work_dir.iterdir()):
        if _is_working_file(path.name):
            _remove(path)
    if plan.folder.exists():
        plan.folder.rename(plan.previous)
    plan.work_dir.rename(plan.folder)
    fsync_path(plan.run_dir)
    _retire_previous(plan)


def _retire_previous(plan: StagePlan) -> None:
    """Remove the result that was replaced; the user's files in it, such as a scene made of it, move to the new one."""
    manifest = read_manifest(plan.previous)
    if manifest is not None and plan.folder.is_dir():
        for name in list_files(plan.previous):
            if name not in manifest.outputs and name != MANIFEST_FILE and not (plan.folder / name).exists():
                (plan.folder / name).parent.mkdir(parents=True, exist_ok=True)
                (plan.previous / name).rename(plan.folder / name)
    _remove_made(plan.previous)


def _require_made(folder: Path) -> None:
    """Raise UserError if something that no stage made is where a stage would replace it."""
    if not folder.exists() or any((folder / mark).is_file() for mark in MARKS):
        return
    if not folder.is_dir() or any(folder.iterdir()):
        raise UserError(f"{folder} was not made by this program and would be replaced: move it, or choose another run")


def _remove_made(folder: Path) -> None:
    """Delete a folder that a stage made, if it exists; what tells that a stage made it goes last, in case of a kill."""
    if folder.is_dir() and not folder.is_symlink():
        for path in list(folder.iterdir()):
            if path.name not in MARKS:
                _remove(path)
    _remove(folder)


def _is_working_file(name: str) -> bool:
    return name == FINGERPRINT or name.startswith(CHECKPOINT_PREFIX)


def _manifest_fingerprint(folder: Path) -> str | None:
    manifest = read_manifest(folder)
    return manifest.fingerprint if manifest else None


def _remove(path: Path) -> None:
    """Delete a file or a folder, if it exists."""
    if path.is_dir() and not path.is_symlink():
        shutil.rmtree(path)
    else:
        path.unlink(missing_ok=True)


def _fsync_tree(folder: Path) -> None:
    for directory, _, names in os.walk(folder):
        for name in names:
            fsync_path(Path(directory, name))
        fsync_path(Path(directory))
