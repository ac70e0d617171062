"""Quality of finished runs: seconds of the field stage, speedup and PSNR gain over baselines on the same videos."""

from collections.abc import Sequence
from pathlib import Path
from statistics import median

from data_tools.sweep.chart_trials import FIELD, read_progress
from data_tools.sweep.runs import read_scores
from pipeline.core.command import format_command
from pipeline.core.errors import UserError
from pipeline.core.manifest import Manifest, read_manifest

TOLERANCE_DB = 0.1
"""A run reaches the quality of a baseline if its validation PSNR (whole image) is at most this much lower."""

METRICS = ("field_seconds", "speedup_to_quality", "psnr_gain_db")
_HELD_OUT = "field_psnr_full_db"

Curve = Sequence[tuple[float, float, float]]
"""Rows of `field/progress.csv`: seconds of training, validation PSNR (dB) of the whole image and of the body."""


def compare_quality(runs: Sequence[Path], baselines: Sequence[Path]) -> tuple[dict[str, float | None], list[str]]:
    """Return `METRICS`, None where unknown, and the reasons why they are unknown.

    With several runs (seeds or videos) each metric is a median: field_seconds over the runs, the others over all pairs
    of a run and a baseline of the same video. A metric that is unknown for one pair is unknown.

    field_seconds: duration of the run's field stage. speedup_to_quality: see `speedup`. psnr_gain_db: PSNR of the field
    on held-out frames, whole image, run minus baseline, from the reports.

    Raises UserError if a field stage is not finished, or a run has no baseline of its video.
    """
    metrics: dict[str, float | None] = dict.fromkeys(METRICS)
    if not runs:
        return metrics, ["no RUN: field seconds, speedup and PSNR gain are unknown"]
    metrics["field_seconds"] = median(_finished(run, FIELD).seconds for run in runs)
    if not baselines:
        return metrics, ["no BASELINE: speedup and PSNR gain are unknown"]
    pairs = _pairs(runs, baselines)
    speedups = [speedup(*(read_progress(run / FIELD) for run in pair)) for pair in pairs]
    reasons = [
        f"{run} and {other}: {reason}" for (run, other), (_, reason) in zip(pairs, speedups, strict=True) if reason
    ]
    metrics["speedup_to_quality"] = _median_of_all([factor for factor, _ in speedups])
    metrics["psnr_gain_db"] = _median_of_all([_gain_db(*pair) for pair in pairs])
    if metrics["psnr_gain_db"] is None:
        reasons.append("a report stage is not finished: the PSNR gain on held-out frames is unknown")
    return metrics, reasons


def speedup(curve: Curve, baseline: Curve) -> tuple[float | None, str]:
    """Return training seconds of the baseline divided by those of the run until it reaches the baseline's last PSNR.

    None and the reason if the run never reaches it.
    """
    if not curve or not baseline:
        return None, "field/progress.csv is missing: the speedup is unknown"
    seconds, final_db, _ = baseline[-1]
    reached = [row[0] for row in curve if row[1] >= final_db - TOLERANCE_DB]
    if not reached:
        best_db = max(row[1] for row in curve)
        return (
            None,
            f"the run never reaches the baseline's {final_db:.2f} dB - {TOLERANCE_DB} dB: {best_db:.2f} dB at best",
        )
    return seconds / reached[0], ""


def _finished(run: Path, stage: str) -> Manifest:
    manifest = read_manifest(run / stage)
    if manifest is None:
        raise UserError(f"{run} has no finished {stage}: run {format_command('--run', run)}")
    return manifest


def _pairs(runs: Sequence[Path], baselines: Sequence[Path]) -> list[tuple[Path, Path]]:
    """Return each run with each baseline of its video."""
    for baseline in baselines:
        _finished(baseline, FIELD)
    videos = {baseline: _finished(baseline, "frames").inputs for baseline in baselines}
    pairs = []
    for run in runs:
        mine = [(run, baseline) for baseline in baselines if videos[baseline] == _finished(run, "frames").inputs]
        if not mine:
            names = ", ".join(map(str, baselines))
            raise UserError(f"{run} and {names} are not of the same video: pass a BASELINE of each RUN's video")
        pairs += mine
    return pairs


def _gain_db(run: Path, baseline: Path) -> float | None:
    ours, theirs = read_scores(run), read_scores(baseline)
    return ours[_HELD_OUT] - theirs[_HELD_OUT] if _HELD_OUT in ours and _HELD_OUT in theirs else None


def _median_of_all(values: Sequence[float | None]) -> float | None:
    """Return the median, or None if a value is unknown: dropping it would bias the result."""
    known = [value for value in values if value is not None]
    return median(known) if len(known) == len(values) else None
