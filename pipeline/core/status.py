"""State of the stages in a run folder, without running anything."""

from pathlib import Path

from pipeline.core.command import format_command
from pipeline.core.config import Config
from pipeline.core.errors import UserError
from pipeline.core.manifest import find_damaged_files, read_manifest
from pipeline.core.pipeline import Pipeline
from pipeline.core.record import RunRecord
from pipeline.core.stage import Stage, plan_stage

FRESH = "fresh"
_MAX_NAMED_FILES = 5


def stage_states(pipeline: Pipeline, run_dir: Path, record: RunRecord) -> dict[str, str]:
    """Return the state of every stage, in order: fresh, stale, unfinished, missing, or "waits for" an earlier stage.

    Args:
        record: video and options with which the results are compared.
    """
    configs = pipeline.build_configs(record)
    states: dict[str, str] = {}
    for stage in pipeline.load_stages():
        states[stage.name] = _stage_state(stage, configs[stage.name], run_dir, record, states)
    return states


def format_status(pipeline: Pipeline, run_dir: Path, record: RunRecord) -> str:
    """Format a table with the state of every stage and the cost of its last run."""
    lines = []
    for name, state in stage_states(pipeline, run_dir, record).items():
        manifest = read_manifest(run_dir / name)
        cost = f"{manifest.seconds:>9.1f} s {manifest.peak_rss_mib:>7.0f} MiB" if manifest else ""
        lines.append(f"{name:<10} {state:<18} {cost}".rstrip())
    return "\n".join(lines)


def verify_artifacts(pipeline: Pipeline, run_dir: Path) -> str:
    """Digest every finished artifact again and return a table of the complete ones.

    Raises:
        UserError: outputs are missing or changed; the message names the command that makes the stage again.
    """
    finished = [name for name in pipeline.names if (run_dir / name).exists()]
    for name in finished:
        damaged = find_damaged_files(run_dir / name)
        if damaged:
            named = ", ".join(damaged[:_MAX_NAMED_FILES])
            command = format_command("--run", run_dir, "--from", name)
            raise UserError(f"{run_dir / name} is damaged ({named}): {command}")
    return "\n".join(f"{name:<10} intact" for name in finished) or f"{run_dir} has no finished stage"


def _stage_state(stage: Stage, config: Config, run_dir: Path, record: RunRecord, states: dict[str, str]) -> str:
    blocking_stage = next((need for need in stage.needs if states.get(need, FRESH) != FRESH), None)
    folder_exists = (run_dir / stage.name).exists()
    if folder_exists and not blocking_stage and plan_stage(stage, config, run_dir, record.video_path).is_fresh():
        return FRESH
    if (run_dir / f"{stage.name}.part").exists():
        return "unfinished"
    if blocking_stage:
        return f"waits for {blocking_stage}"
    return "stale" if folder_exists else "missing"
