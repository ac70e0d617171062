"""Run all stages in order, each in a process of its own: memory is measured per stage, a crash stays in one."""

import subprocess
import sys
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path

from pipeline.core.config import Config, build_config, check_sections, load_layers
from pipeline.core.errors import UserError
from pipeline.core.lock import child_environment
from pipeline.core.manifest import find_damaged_files, read_manifest
from pipeline.core.record import RunRecord
from pipeline.core.stage import Stage, discard_work_dir, plan_stage

EXIT_INTERRUPTED = 130
FRESH = "fresh"


@dataclass(frozen=True)
class StageOutcome:
    """One line of the summary: `state` is cached or run; seconds and peak memory come from the manifest."""

    stage: str
    state: str
    seconds: float
    peak_rss_mib: float


class StageFailedError(Exception):
    """A stage's process ended with `code` after it said why."""

    def __init__(self, code: int) -> None:
        super().__init__(f"exit status {code}")
        self.code = code


def build_configs(stages: Sequence[Stage], record: RunRecord, config_dir: Path) -> dict[str, Config]:
    """Check the whole configuration before any work: every section known, every value allowed."""
    layers = load_layers(record.preset, record.overrides, config_dir)
    check_sections(layers, [stage.name for stage in stages])
    return {stage.name: build_config(stage.name, stage.config, layers) for stage in stages}


def run_all(
    stages: Sequence[Stage],
    configs: dict[str, Config],
    run_dir: Path,
    record: RunRecord,
    lock_fd: int,
    is_forced: Callable[[str], bool],
) -> list[StageOutcome]:
    """Bring every stage up to date, in order; what is fresh already is left alone."""
    outcomes = []
    for number, stage in enumerate(stages, start=1):
        plan = plan_stage(stage, configs[stage.name], run_dir, record.video_path)
        fresh = plan.is_fresh() and not is_forced(stage.name)
        print(f"[{number}/{len(stages)}] {stage.name}{': cached' if fresh else ''}", file=sys.stderr, flush=True)
        if fresh:
            discard_work_dir(plan)
        else:
            _run_in_child(stage.name, run_dir, lock_fd, is_forced(stage.name))
        manifest = read_manifest(plan.folder)
        if manifest is None:
            raise UserError(f"{plan.folder} disappeared while the run went on: run the same command again")
        outcomes.append(StageOutcome(stage.name, "cached" if fresh else "run", manifest.seconds, manifest.peak_rss_mib))
    return outcomes


def _run_in_child(name: str, run_dir: Path, lock_fd: int, force: bool) -> None:
    command = [sys.executable, "-m", f"stages.{name}", str(run_dir), *(["--force"] if force else [])]
    child = subprocess.Popen(command, env=child_environment(lock_fd), pass_fds=(lock_fd,))
    try:
        code = child.wait()
    except KeyboardInterrupt:
        child.wait()
        raise
    if code < 0:
        raise UserError(
            f"stage {name} was killed by signal {-code} (9 is often the system out of memory): "
            f"the same command goes on from here"
        )
    if code == EXIT_INTERRUPTED:
        raise KeyboardInterrupt
    if code:
        raise StageFailedError(code)


def summary(outcomes: Sequence[StageOutcome], wall_s: float) -> str:
    """The table at the end of a run; cached stages show what they cost when they ran."""
    lines = [f"{'stage':<10} {'state':<7} {'seconds':>9} {'peak MiB':>9}"]
    lines += [f"{o.stage:<10} {o.state:<7} {o.seconds:>9.1f} {o.peak_rss_mib:>9.0f}" for o in outcomes]
    seconds, peak_mib = sum(o.seconds for o in outcomes), max((o.peak_rss_mib for o in outcomes), default=0.0)
    lines += [f"{'total':<10} {'':<7} {seconds:>9.1f} {peak_mib:>9.0f}", f"this command took {wall_s:.1f} s"]
    return "\n".join(lines)


def status(stages: Sequence[Stage], configs: dict[str, Config], run_dir: Path, record: RunRecord) -> str:
    """A table of what is there: the state of every stage and what it cost."""
    lines = []
    for name, state in stage_states(stages, configs, run_dir, record).items():
        manifest = read_manifest(run_dir / name)
        cost = f"{manifest.seconds:>9.1f} s {manifest.peak_rss_mib:>7.0f} MiB" if manifest else ""
        lines.append(f"{name:<10} {state:<18} {cost}".rstrip())
    return "\n".join(lines)


def stage_states(
    stages: Sequence[Stage], configs: dict[str, Config], run_dir: Path, record: RunRecord
) -> dict[str, str]:
    """Of every stage, in order: fresh, stale, unfinished, missing, or waiting for a stage before it."""
    states: dict[str, str] = {}
    for stage in stages:
        states[stage.name] = _state(stage, configs[stage.name], run_dir, record, states)
    return states


def _state(stage: Stage, config: Config, run_dir: Path, record: RunRecord, states: dict[str, str]) -> str:
    blocking_stage = next((need for need in stage.needs if states.get(need, FRESH) != FRESH), None)
    folder_exists = (run_dir / stage.name).exists()
    if folder_exists and not blocking_stage and plan_stage(stage, config, run_dir, record.video_path).is_fresh():
        return FRESH
    if (run_dir / f"{stage.name}.part").exists():
        return "unfinished"
    if blocking_stage:
        return f"waits for {blocking_stage}"
    return "stale" if folder_exists else "missing"


def verify(stages: Sequence[Stage], run_dir: Path) -> str:
    """Digest every finished artifact again; a table when all are whole, else UserError naming the damage."""
    finished = [stage.name for stage in stages if (run_dir / stage.name).exists()]
    for name in finished:
        damage = find_damaged_files(run_dir / name)
        if damage:
            raise UserError(
                f"{run_dir / name} is damaged ({', '.join(damage[:5])}): python -m stages --run {run_dir} --from {name}"
            )
    return "\n".join(f"{name:<10} whole" for name in finished) or f"{run_dir} holds no finished stage"
