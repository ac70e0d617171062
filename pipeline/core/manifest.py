"""Manifests: what a finished stage read, wrote and cost. Only `fingerprint` decides whether it is still fresh."""

import hashlib
import json
from collections.abc import Mapping
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any

from pipeline.core.errors import UserError

MANIFEST_FILE = "manifest.json"
PROGRESS_FILE = "progress.csv"
"""How a stage's work went, second by second: a result like others, but never the same twice."""


@dataclass(frozen=True)
class Manifest:
    """The record beside a stage's artifacts; `outputs` maps each file's relative path to its SHA-256."""

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
        """One digest for all outputs but the record of progress: what a downstream stage's fingerprint depends on."""
        return digest_json({name: digest for name, digest in self.outputs.items() if name != PROGRESS_FILE})


def write_manifest(manifest: Manifest, path: Path) -> None:
    """Write the manifest to the file `path`."""
    path.write_text(json.dumps(asdict(manifest), indent=2, allow_nan=False) + "\n", encoding="utf-8")


def read_manifest(folder: Path) -> Manifest | None:
    """Read `folder/manifest.json`: None where there is none, UserError where it is damaged."""
    path = folder / MANIFEST_FILE
    try:
        return Manifest(**json.loads(path.read_text(encoding="utf-8")))
    except (FileNotFoundError, NotADirectoryError):
        return None
    except (ValueError, TypeError):
        raise UserError(f"{path} is damaged or of another version: delete {folder} and run the stage again") from None


def fingerprint(stage: str, version: int, config: Mapping[str, Any], inputs: Mapping[str, str]) -> str:
    """Digest of everything that decides a stage's result: name, version, its own config, what it reads."""
    return digest_json({"stage": stage, "version": version, "config": config, "inputs": inputs})


def digest_json(value: Any) -> str:
    """SHA-256 of the canonical JSON text of `value`."""
    return hashlib.sha256(json.dumps(value, sort_keys=True, separators=(",", ":")).encode()).hexdigest()


def digest_file(path: Path) -> str:
    """SHA-256 of a file's content."""
    with path.open("rb") as file:
        return hashlib.file_digest(file, "sha256").hexdigest()


def digest_video(path: Path) -> str:
    """Digest of the user's video: a file's content, or names and contents of a folder (hidden files left out)."""
    if path.is_file():
        return digest_file(path)
    if not path.is_dir():
        raise UserError(f"{path} is no file and no folder: give the video with --video")
    return digest_json({name: digest_file(path / name) for name in list_files(path) if not _is_hidden(name)})


def digest_files(folder: Path) -> dict[str, str]:
    """SHA-256 of every file under `folder`, its manifest left out, by sorted relative path."""
    return {name: digest_file(folder / name) for name in list_files(folder) if name != MANIFEST_FILE}


def list_files(folder: Path) -> list[str]:
    """Relative POSIX paths of all files under `folder`, sorted."""
    return sorted(path.relative_to(folder).as_posix() for path in folder.rglob("*") if path.is_file())


def find_damaged_files(folder: Path) -> list[str]:
    """Names of the outputs that are missing, changed or strange, against the manifest; empty when all is whole."""
    manifest = read_manifest(folder)
    if manifest is None:
        return [MANIFEST_FILE]
    found = digest_files(folder)
    return sorted(name for name in found.keys() | manifest.outputs if found.get(name) != manifest.outputs.get(name))


def _is_hidden(name: str) -> bool:
    return any(part.startswith(".") for part in name.split("/"))
