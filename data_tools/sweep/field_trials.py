"""One row of the sweep of the field stage on one finished run with one seed: its folder and its scores."""

import json
import resource
import shutil
import time
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

from data_tools.evaluate.field_truth import score_field
from data_tools.sweep.chart_trials import describe_machine
from data_tools.sweep.field_rows import FieldRow
from pipeline.core.atomic import atomic_path
from pipeline.core.manifest import digest_json, digest_video, outputs_digests
from pipeline.core.measure import describe_environment
from pipeline.field.checkpoint import CHECKPOINT_FILE
from pipeline.field.config import FieldConfig
from stages import field

INPUTS = ("frames", "body")
SCORES_FILE, IDENTITY_FILE = "scores.json", "identity"
STAGE_SCORES = (
    "validation_psnr_db",
    "validation_psnr_body_db",
    "samples_per_step",
    "occupied_cells",
    "parameters",
    "train_frames",
)


@dataclass(frozen=True, eq=False)
class FieldTrial:
    """A row on the frames and the body of a finished run.

    Attributes:
        run: folder of the run; nothing is written there.
        truth: folder of the synthetic capture; None leaves out the scores against the truth.
        out: folder of the sweep.
    """

    run: Path
    row: FieldRow
    seed: int
    config: FieldConfig
    truth: Path | None
    out: Path

    @property
    def folder(self) -> Path:
        """Artifacts of the field stage and the scores."""
        return self.out / f"{self.run.name}-{self.row.name}-{self.seed}"

    @property
    def identity(self) -> str:
        """Digest of what the scores depend on, besides the code: options, frames, body and truth."""
        config, inputs = self.config.model_dump(mode="json"), outputs_digests(self.run, INPUTS)
        truth = None if self.truth is None else digest_video(self.truth / "truth")
        return digest_json({"config": config, "truth": truth, "inputs": inputs})


@dataclass(frozen=True)
class TrialScores:
    """Scores of a trial by name, and where they were measured."""

    identity: str
    scores: dict[str, float]
    commit: str
    machine: str


def run_trial(trial: FieldTrial) -> TrialScores:
    """Train the field of a trial and score it, unless it has its scores already; an interrupted training goes on, and
    has no seconds then.

    Raises:
        UserError: a file of the run or of the truth is missing, or the training diverged.
    """
    finished = read_trial(trial)
    if finished is not None:
        return finished
    begin_folder(trial)
    inputs = {name: trial.run / name for name in INPUTS}
    resumed = (trial.folder / CHECKPOINT_FILE).exists()
    start_s, start_cpu_s = time.monotonic(), _cpu_seconds()
    metrics: dict[str, Any] = dict(field.run(inputs, trial.folder, trial.config))
    scores = {name: float(metrics[name]) for name in STAGE_SCORES if metrics.get(name) is not None}
    if not resumed:
        scores |= {"seconds": time.monotonic() - start_s, "cpu_seconds": _cpu_seconds() - start_cpu_s}
    if trial.truth is not None:
        scores |= score_field(trial.run, trial.folder, trial.truth)
    environment = describe_environment()
    result = TrialScores(trial.identity, scores, str(environment.get("commit") or ""), describe_machine(environment))
    with atomic_path(trial.folder / SCORES_FILE) as path:
        path.write_text(json.dumps(asdict(result), indent=2, allow_nan=False) + "\n", encoding="utf-8")
    return result


def begin_folder(trial: FieldTrial) -> None:
    """Make the folder of a trial; what was made there of another identity is removed."""
    mark = trial.folder / IDENTITY_FILE
    if trial.folder.exists() and not (mark.is_file() and mark.read_text(encoding="utf-8") == trial.identity):
        shutil.rmtree(trial.folder)
    trial.folder.mkdir(parents=True, exist_ok=True)
    mark.write_text(trial.identity, encoding="utf-8")


def read_trial(trial: FieldTrial) -> TrialScores | None:
    """Return the scores of a trial; None if it is not finished, or was made of another identity."""
    path = trial.folder / SCORES_FILE
    if not path.is_file():
        return None
    result = TrialScores(**json.loads(path.read_text(encoding="utf-8")))
    return result if result.identity == trial.identity else None


def _cpu_seconds() -> float:
    usage = resource.getrusage(resource.RUSAGE_SELF)
    return usage.ru_utime + usage.ru_stime
