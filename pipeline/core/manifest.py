"""Manifests: inputs, outputs and cost of a finished stage. Only `fingerprint` decides whether the stage is fresh."""

import hashlib
import json
from collections.abc import Iterable, Iterator, Mapping
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any

from pipeline.core.command import format_command
from pipeline.core.errors import UserError
from pipeline.core.json_file import load_json

MANIFEST_FILE = "manifest.json"
PROGRESS_FILE = "progress.csv"
"""Output with the progress of a stage over time. It differs between equal runs, so no fingerprint depends on it."""


@dataclass(frozen=True)
class Manifest:
    """Record of one finished stage, stored in its folder.

    config: values of the stage's own options.
    inputs: digest of each input, by name.
    outputs: SHA-256 of each file, by relative POSIX path.
    metrics: what the stage measured; None for a value that is not finite.
    seconds, peak_rss_mib: cost of the run that made it (of its last part if `resumed` from a checkpoint).
    environment: see `pipeline.core.measure.describe_environment`.
    """

    stage: str
    version: int
    fingerprint: str
    config: dict[str, Any]
    inputs: dict[str, str]
    outputs: dict[str, str]
    metrics: dict[str, float | None]
    seconds: float
    peak_rss_mib: float
    resumed: bool = False
    warnings: list[str] = field(default_factory=list)
    environment: dict[str, Any] = field(default_factory=dict)

    @property
    def outputs_digest(self) -> str:
        """Digest of all outputs except `PROGRESS_FILE`; the fingerprints of later stages depend on it."""
        return digest_json({name: digest for name, digest in self.outputs.items() if name != PROGRESS_FILE})


def write_manifest(manifest: Manifest, path: Path) -> None:
    """Write the manifest to the file `path`."""
    path.write_text(json.dumps(asdict(manifest), indent=2, allow_nan=False) + "\n", encoding="utf-8")


def read_manifest(folder: Path) -> Manifest | None:
    """Read `folder/manifest.json`; return None if it does not exist.

    Raises:
        UserError: the file is damaged or has the fields of another version.
    """
    path = folder / MANIFEST_FILE
    try:
        return Manifest(**load_json(path))
    except (FileNotFoundError, NotADirectoryError):
        return None
    except (ValueError, TypeError):
        raise UserError(f"{path} is damaged or from another version: delete {folder} and run the stage again") from None


def read_manifests(run_dir: Path, stages: Iterable[str]) -> dict[str, Manifest]:
    """Return the manifests of the finished ones of these stages of a run, by name. UserError if one is damaged."""
    found = {name: read_manifest(run_dir / name) for name in stages}
    return {name: manifest for name, manifest in found.items() if manifest}


def finished_stages(run_dir: Path) -> dict[str, Manifest]:
    """Return the manifests of a run's finished stages by name: of the folders whose manifest names them as a stage.

    Other folders may hold a manifest of another format, as that of a comparison with the ground truth does.

    Raises:
        UserError: a manifest is damaged.
    """
    names = sorted(path.name for path in run_dir.iterdir() if _holds_stage(path)) if run_dir.is_dir() else []
    return read_manifests(run_dir, names)


def outputs_digests(run_dir: Path, stages: Iterable[str]) -> dict[str, str | None]:
    """Return `Manifest.outputs_digest` of each of these stages of a run; None for one that is not finished."""
    manifests = {name: read_manifest(run_dir / name) for name in stages}
    return {name: found.outputs_digest if found else None for name, found in manifests.items()}


def require_matching_stages(run_dir: Path, stages: Iterable[str]) -> None:
    """Check that the finished ones of these stages belong together; others are left out.

    Fingerprints do not count, as options and files may have changed since: what a stage has read does.

    Raises:
        UserError: one was made from another result of one of the others than the run holds now.
    """
    manifests = read_manifests(run_dir, stages)
    for name, manifest in manifests.items():
        for need, digest in manifest.inputs.items():
            if need in manifests and manifests[need].outputs_digest != digest:
                raise UserError(
                    f"{run_dir / name} was made from another result of {need} than {run_dir / need} holds now; "
                    f"make the stages that follow anew: {format_command('--run', run_dir)}"
                )


def fingerprint(stage: str, version: int, config: Mapping[str, Any], inputs: Mapping[str, str]) -> str:
    """Digest everything that determines the result of a stage: name, version, own options, digests of the inputs."""
    return digest_json({"stage": stage, "version": version, "config": config, "inputs": inputs})


def digest_json(value: Any) -> str:
    """Return the SHA-256 of the canonical JSON text of `value`, in hexadecimal."""
    return hashlib.sha256(json.dumps(value, sort_keys=True, separators=(",", ":")).encode()).hexdigest()


def digest_file(path: Path) -> str:
    """Return the SHA-256 of the content of a file, in hexadecimal."""
    with path.open("rb") as file:
        return hashlib.file_digest(file, "sha256").hexdigest()


def digest_video(path: Path) -> str:
    """Digest the user's video: the content of a file, or names and contents of a folder's files except hidden ones.

    Raises:
        UserError: the path is neither a file nor a folder.
    """
    if path.is_file():
        return digest_file(path)
    if not path.is_dir():
        raise UserError(f"{path} is neither a file nor a folder: name the video with --video")
    return digest_json({name: digest_file(path / name) for name in list_files(path) if not _is_hidden(name)})


def digest_files(folder: Path) -> dict[str, str]:
    """Return the SHA-256 of every file under `folder` except its manifest, by relative POSIX path, sorted."""
    return {name: digest_file(folder / name) for name in list_files(folder) if name != MANIFEST_FILE}


def list_files(folder: Path) -> list[str]:
    """Return the relative POSIX paths of all files under `folder`, also in linked folders, sorted."""
    return sorted(path.relative_to(folder).as_posix() for path in _walk(folder, frozenset()))


def _holds_stage(folder: Path) -> bool:
    """Return whether the manifest in a folder is that of the stage of this name, or is damaged."""
    path = folder / MANIFEST_FILE
    try:
        document = load_json(path) if path.is_file() else None
    except ValueError:
        return True
    return isinstance(document, dict) and document.get("stage") == folder.name


def _walk(folder: Path, above: frozenset[Path]) -> Iterator[Path]:
    """Yield the files under a folder; a link to one of the folders `above` it is not followed."""
    real = folder.resolve()
    if real in above:
        return
    for path in folder.iterdir():
        if path.is_dir():
            yield from _walk(path, above | {real})
        elif path.is_file():
            yield path


def find_damaged_files(folder: Path) -> list[str]:
    """Compare a folder with its manifest: return the paths of missing and changed outputs, sorted.

    Other files, such as a user's scene, are no damage.
    """
    manifest = read_manifest(folder)
    if manifest is None:
        return [MANIFEST_FILE]
    return sorted(
        name
        for name, digest in manifest.outputs.items()
        if not (folder / name).is_file() or digest_file(folder / name) != digest
    )


def _is_hidden(name: str) -> bool:
    return any(part.startswith(".") for part in name.split("/"))
