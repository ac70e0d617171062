"""Read and write `compare/`, the folder of a run with its comparison against the ground truth.

RUN/compare/truth.json       all scores, see `data_tools.evaluate.page.PROTOCOL`
RUN/compare/truth.html       the same as a page, with images
RUN/compare/manifest.json    what was compared, and a digest of both files

Stages never read this folder, and a comparison never writes into the folder of a stage.
"""

import json
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

from data_tools.folder import replaced_folder
from pipeline.core.manifest import MANIFEST_FILE, digest_file, read_manifest

COMPARE_FOLDER = "compare"
SCORES_FILE, PAGE_FILE = "truth.json", "truth.html"
TRUTH_VERSION = 6
"""Increased whenever the content or the meaning of a comparison changes, so that it is computed again."""


@dataclass(frozen=True)
class ComparisonManifest:
    """Identity of a comparison.

    Attributes:
        version: `TRUTH_VERSION` of the program that wrote it.
        report_fingerprint: of the report stage; it depends on the outputs of all other stages.
        outputs: SHA-256 by file name.
    """

    version: int
    report_fingerprint: str
    outputs: dict[str, str]


def save_comparison(run_dir: Path, document: dict[str, Any], page: str, report_fingerprint: str) -> None:
    """Write the folder atomically; a previous comparison is replaced.

    Args:
        document: content of `truth.json`; must not contain NaN or infinity.
        page: HTML text.
        report_fingerprint: of the report that was compared.
    """
    with replaced_folder(run_dir / COMPARE_FOLDER) as part:
        (part / SCORES_FILE).write_text(json.dumps(document, indent=2, allow_nan=False) + "\n", encoding="utf-8")
        (part / PAGE_FILE).write_text(page, encoding="utf-8")
        outputs = {name: digest_file(part / name) for name in (PAGE_FILE, SCORES_FILE)}
        manifest = ComparisonManifest(TRUTH_VERSION, report_fingerprint, outputs)
        (part / MANIFEST_FILE).write_text(json.dumps(asdict(manifest), indent=2) + "\n", encoding="utf-8")


def load_comparison_scores(run_dir: Path) -> dict[str, Any] | None:
    """Return the content of `truth.json`; None unless it is complete, of this version and of the current report."""
    folder, report = run_dir / COMPARE_FOLDER, read_manifest(run_dir / "report")
    manifest = _read_comparison_manifest(folder)
    if manifest is None or report is None or manifest.version != TRUTH_VERSION:
        return None
    if manifest.report_fingerprint != report.fingerprint:
        return None
    for name in (PAGE_FILE, SCORES_FILE):
        if not (folder / name).is_file() or digest_file(folder / name) != manifest.outputs.get(name):
            return None
    document: dict[str, Any] = json.loads((folder / SCORES_FILE).read_text(encoding="utf-8"))
    return document


def _read_comparison_manifest(folder: Path) -> ComparisonManifest | None:
    """Return the manifest; None if it is absent, damaged or of a format with other fields."""
    path = folder / MANIFEST_FILE
    if not path.is_file():
        return None
    try:
        return ComparisonManifest(**json.loads(path.read_text(encoding="utf-8")))
    except (ValueError, TypeError):
        return None
