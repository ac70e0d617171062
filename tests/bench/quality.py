"""What finished runs say of quality: seconds of the field, and what it gains over baselines on the same videos."""

from collections.abc import Sequence
from pathlib import Path
from statistics import median

from data_tools.sweep.chart_trials import FIELD, read_progress
from data_tools.sweep.runs import read_scores
from pipeline.core.errors import UserError
from pipeline.core.manifest import Manifest, read_manifest

TOLERANCE_DB = 0.1
"""A run is as good as a baseline when its validation PSNR (whole image) lies no more than this below it."""

FIGURES = ("field_seconds", "speedup_to_quality", "psnr_gain_db")
_HELD_OUT = "field_psnr_full_db"

Curve = Sequence[tuple[float, float, float]]
"""Rows of `field/progress.csv`: seconds of learning, validation PSNR (dB) of whole image and body."""


def quality(runs: Sequence[Path], baselines: Sequence[Path]) -> tuple[dict[str, float | None], list[str]]:
    """`FIGURES`, None where they cannot be told, and why they cannot.

    Several runs, of several seeds or videos, count by their medians: field_seconds over the runs, the others over all
    pairs of a run and a baseline of the same video. field_seconds: of the run's stage. speedup_to_quality: see
    `speedup`, of the two `field/progress.csv`. psnr_gain_db: of the field on held-out frames, whole image, run minus
    baseline, as the two reports have it. What a single pair does not tell is not told.

    Raises:
        UserError: a field is not finished, or a run has no baseline of its video.
    """
    figures: dict[str, float | None] = dict.fromkeys(FIGURES)
    if not runs:
        return figures, ["no RUN is given: its field's seconds, speedup and gain are unknown"]
    figures["field_seconds"] = median(_finished(run, FIELD).seconds for run in runs)
    if not baselines:
        return figures, ["no BASELINE is given: speedup and gain are unknown"]
    pairs = _pairs(runs, baselines)
    found = [speedup(*(read_progress(run / FIELD) for run in pair)) for pair in pairs]
    reasons = [f"{run} and {other}: {reason}" for (run, other), (_, reason) in zip(pairs, found, strict=True) if reason]
    figures["speedup_to_quality"] = _median_of_all([factor for factor, _ in found])
    figures["psnr_gain_db"] = _median_of_all([_gain_db(*pair) for pair in pairs])
    if figures["psnr_gain_db"] is None:
        reasons.append("a report is not finished: the gain on held-out frames is unknown")
    return figures, reasons


def speedup(curve: Curve, baseline: Curve) -> tuple[float | None, str]:
    """Seconds of learning of the whole baseline over those until the run's first row that is as good as its last.

    None with the reason when there is no such row.
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
        raise UserError(f"{run} has no finished {stage}: run python -m stages --run {run}")
    return manifest


def _pairs(runs: Sequence[Path], baselines: Sequence[Path]) -> list[tuple[Path, Path]]:
    """Each run with each baseline of its video."""
    for baseline in baselines:
        _finished(baseline, FIELD)
    videos = {baseline: _finished(baseline, "frames").inputs for baseline in baselines}
    pairs = []
    for run in runs:
        mine = [(run, baseline) for baseline in baselines if videos[baseline] == _finished(run, "frames").inputs]
        if not mine:
            given = ", ".join(map(str, baselines))
            raise UserError(f"{run} and {given} are not of the same video: give a BASELINE of each RUN's video")
        pairs += mine
    return pairs


def _gain_db(run: Path, baseline: Path) -> float | None:
    ours, theirs = read_scores(run), read_scores(baseline)
    return ours[_HELD_OUT] - theirs[_HELD_OUT] if _HELD_OUT in ours and _HELD_OUT in theirs else None


def _median_of_all(values: Sequence[float | None]) -> float | None:
    """The median, or None if one is not known: leaving it out would flatter the rest."""
    known = [value for value in values if value is not None]
    return median(known) if len(known) == len(values) else None
