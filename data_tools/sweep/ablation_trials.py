"""One row of the ablation on one capture with one seed: its run folder, its stages and its scores.

The stages before the mesh are made once for each capture and seed, in the run folder of a `Trial`. The folder of a row
has links to them, and the stages from the mesh on.
"""

import json
import os
import shutil
import subprocess
import sys
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

from data_tools.evaluate.files import load_comparison_scores
from data_tools.folder import atomic_folder
from data_tools.sweep.ablation_mesh import MESH, plan_run_stage, save_settings
from data_tools.sweep.ablation_rows import REFERENCE, ROWS, Row, row_settings
from data_tools.sweep.chart_trials import (
    STAGES_UNTIL_FIELD,
    Trial,
    compare_with_truth,
    copy_shared_stages,
    describe_machine,
    needs_comparison,
)
from data_tools.sweep.runs import last_error_message, log_path, pick_numbers, reusable_stages
from pipeline.core.errors import UserError
from pipeline.core.manifest import Manifest, read_manifest
from pipeline.core.parent import die_with_parent_environment
from pipeline.core.record import write_record

STAGES_FROM_MESH = (MESH, "texture", "export", "report")
REPORT, TRUTH, MANIFEST = "report", "truth", "manifest"

# Column of ablation.csv, document, and path of the figure in the document.
FIGURE_PATHS = {
    "psnr_full_db": (REPORT, "heldout", "mesh", "psnr_full"),
    "psnr_body_db": (REPORT, "heldout", "mesh", "psnr_body"),
    "chamfer_mm": (TRUTH, "mesh_matched", "chamfer_mm"),
    "normal_angle_deg": (TRUTH, "mesh_matched", "normal_angle_deg"),
    "novel_view_psnr_body_db": (TRUTH, "images", "novel_views", "psnr_body"),
    "faces": (REPORT, "mesh", "faces"),
    "faces_before_reduction": (MANIFEST, "metrics", "faces_before_reduction"),
    "texture_px": (REPORT, "export", "texture_px"),
    "glb_bytes": (REPORT, "export", "glb_bytes"),
    "rounds_kept": (MANIFEST, "metrics", "accepted_rounds"),
    "mesh_seconds": (MANIFEST, "seconds"),
}


@dataclass(frozen=True)
class AblationTrial:
    """A row of the ablation on the field of a trial."""

    base: Trial
    row: Row

    @property
    def run_dir(self) -> Path:
        """The run folder of the row."""
        return self.base.run_dir.with_name(f"{self.base.run_dir.name}-{self.row.name}")


@dataclass(frozen=True)
class AblationResult:
    """State and figures of a trial.

    Attributes:
        status: done, failed (see `failure`), or unfinished.
        figures: by column of `FIGURE_PATHS`; a capture without ground truth has no distances. Empty unless done.
        commit, machine: of the mesh stage.
    """

    status: str
    figures: dict[str, float]
    failure: str = ""
    commit: str = ""
    machine: str = ""


def run_row(trial: AblationTrial, other_bases: Iterable[Trial]) -> AblationResult:
    """Run what a trial lacks, compare it with the truth, and read its figures.

    other_bases: trials whose equal stages are copied instead of run.
    """
    try:
        make_shared_stages(trial.base, other_bases)
        prepare_row(trial)
        for name in STAGES_FROM_MESH:
            make_stage(trial.run_dir, name)
    except UserError as error:
        return AblationResult("failed", {}, str(error))
    compare_with_truth(trial.base.capture, trial.run_dir)
    return read_row(trial)


def read_row(trial: AblationTrial) -> AblationResult:
    """Read the figures of a trial without running anything."""
    try:
        is_done = all(plan_run_stage(trial.run_dir, name).is_fresh() for name in STAGES_FROM_MESH)
    except UserError:
        is_done = False  # an input is missing
    manifest = read_manifest(trial.run_dir / MESH)
    if not is_done or manifest is None:
        failure = last_error_message(log_path(trial.run_dir))
        return AblationResult("failed" if failure else "unfinished", {}, failure)
    if needs_comparison(trial.base.capture, trial.run_dir):
        return AblationResult("failed", {}, "not compared with the ground truth")
    environment = manifest.environment
    commit, machine = str(environment.get("commit") or ""), describe_machine(environment)
    return AblationResult("done", read_figures(trial.run_dir, manifest), commit=commit, machine=machine)


def make_shared_stages(base: Trial, others: Iterable[Trial]) -> None:
    """Make frames, body and field of a trial, unless they are fresh; equal stages of other trials are copied.

    Raises:
        UserError: a stage failed.
    """
    base.run_dir.mkdir(parents=True, exist_ok=True)
    write_record(base.record, base.run_dir)
    copy_shared_stages(base, others)
    if not set(STAGES_UNTIL_FIELD) <= set(reusable_stages(base.run_dir, base.record)):
        for name in STAGES_UNTIL_FIELD:
            make_stage(base.run_dir, name)


def prepare_row(trial: AblationTrial) -> None:
    """Write record and settings of a row into its folder, and link the stages before the mesh.

    Raises:
        UserError: the mesh stage of `REFERENCE`, whose result is needed, failed.
    """
    metrics: dict[str, float | None] = {}
    reference = AblationTrial(trial.base, ROWS[REFERENCE])
    if trial.row.from_reference or trial.row.has_mesh_of_reference:
        prepare_row(reference)
        make_stage(reference.run_dir, MESH)
        manifest = read_manifest(reference.run_dir / MESH)
        metrics = manifest.metrics if manifest else {}
    trial.run_dir.mkdir(parents=True, exist_ok=True)
    record = trial.base.record
    write_record(replace(record, overrides={**record.overrides, **trial.row.options}), trial.run_dir)
    save_settings(trial.run_dir, row_settings(trial.row, trial.base.seed, metrics))
    for name in STAGES_UNTIL_FIELD:
        link_folder(trial.base.run_dir / name, trial.run_dir / name)
    if trial.row.has_mesh_of_reference:
        link_folder(reference.run_dir / MESH, trial.run_dir / MESH)


def link_folder(source: Path, link: Path) -> None:
    """Make `link` a relative link to a folder, or a copy where links are not possible; an existing one stays."""
    if link.exists():
        return
    try:
        link.symlink_to(os.path.relpath(source, link.parent), target_is_directory=True)
    except OSError:
        with atomic_folder(link) as part:
            shutil.copytree(source, part, dirs_exist_ok=True)


def make_stage(run_dir: Path, name: str) -> None:
    """Run a stage in a process of its own, unless its result is fresh; its output replaces the log of the run.

    Raises:
        UserError: the stage failed; the message is that of the stage.
    """
    if plan_run_stage(run_dir, name).is_fresh():
        return
    module = ["data_tools.sweep.ablation_mesh"] if name == MESH else ["stages", name]
    command: Sequence[str] = [sys.executable, "-m", *module, str(run_dir)]
    log = log_path(run_dir)
    with log.open("w", encoding="utf-8") as file:
        done = subprocess.run(
            command, env=die_with_parent_environment(), stdout=file, stderr=subprocess.STDOUT, check=False
        )
    if done.returncode != 0:
        message = last_error_message(log) or f"the stage ended with exit status {done.returncode}"
        raise UserError(f"{run_dir.name}, {name}: {message}; see {log}")


def read_figures(run_dir: Path, mesh_manifest: Manifest) -> dict[str, float]:
    """Read the figures of `FIGURE_PATHS` of a finished run; absent and null figures are left out."""
    documents: dict[str, Any] = {
        REPORT: json.loads((run_dir / "report" / "report.json").read_text(encoding="utf-8")),
        TRUTH: load_comparison_scores(run_dir) or {},
        MANIFEST: {"metrics": mesh_manifest.metrics, "seconds": mesh_manifest.seconds},
    }
    return pick_numbers(documents, FIGURE_PATHS)
