"""Run the mesh stage of a run folder with the settings that the folder names; `data_tools.sweep.ablate` starts it.

python -m data_tools.sweep.ablation_mesh RUN

`RUN/mesh_settings.json` holds the fields of `MeshSettings` that differ from the defaults. The command of the stage
itself uses the defaults and would replace the result.
"""

import json
import sys
from collections.abc import Mapping, Sequence
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any

import stages
from data_tools.command import run_command
from pipeline.core.atomic import atomic_path
from pipeline.core.lock import run_lock
from pipeline.core.manifest import digest_json
from pipeline.core.parent import die_with_parent
from pipeline.core.record import read_record
from pipeline.core.stage import StagePlan, plan_stage, run_stage
from pipeline.mesh.settings import MeshSettings
from stages import mesh

MESH = "mesh"
SETTINGS_FILE = "mesh_settings.json"


def main(argv: Sequence[str]) -> None:
    """Run the mesh stage of the run folder unless its result is fresh."""
    (run_dir,) = map(Path, argv)
    with run_lock(run_dir):
        run_stage(plan_run_stage(run_dir, MESH))


def plan_run_stage(run_dir: Path, name: str) -> StagePlan:
    """Plan a stage of a run folder by its record; the mesh stage with the settings of the folder.

    Raises:
        UserError: an input is missing, or the record is damaged.
    """
    record = read_record(run_dir)
    stage, config = stages.load_stage(name), stages.PIPELINE.build_configs(record)[name]
    if name != MESH:
        return plan_stage(stage, config, run_dir, record.video_path)
    settings = load_settings(run_dir)
    stage = replace(stage, run=partial(mesh.run, settings=MeshSettings(**settings)))
    plan = plan_stage(stage, config, run_dir, record.video_path)
    return replace(plan, fingerprint=digest_json({"stage": plan.fingerprint, "settings": settings}))


def save_settings(run_dir: Path, settings: Mapping[str, Any]) -> None:
    """Write the settings of the mesh stage."""
    with atomic_path(run_dir / SETTINGS_FILE) as path:
        path.write_text(json.dumps(settings, indent=2, sort_keys=True) + "\n", encoding="utf-8")


def load_settings(run_dir: Path) -> dict[str, Any]:
    """Read the settings of the mesh stage that differ from the defaults; none if there is no file."""
    path = run_dir / SETTINGS_FILE
    settings: dict[str, Any] = json.loads(path.read_text(encoding="utf-8")) if path.is_file() else {}
    return settings


if __name__ == "__main__":
    die_with_parent()
    raise SystemExit(run_command(main, sys.argv[1:]))
