"""What finished runs say of quality: seconds of the field, and what it gains over a baseline on the same video."""

from collections.abc import Sequence
from pathlib import Path

from data_tools.chart_trials import FIELD, read_progress
from data_tools.runs import read_scores
from pipeline.core.errors import UserError
from pipeline.core.manifest import Manifest, read_manifest

TOLERANCE_DB = 0.1
"""A run is as good as a baseline when its validation PSNR (whole image) lies no more than this below it."""

FIGURES = ("field_seconds", "speedup_to_quality", "psnr_gain_db")
_HELD_OUT = "field_psnr_full_db"

Curve = Sequence[tuple[float, float, float]]
"""Rows of `field/progress.csv`: seconds of learning, validation PSNR (dB) of whole image and body."""


def quality(run: Path | None, baseline: Path | None) -> tuple[dict[str, float | None], list[str]]:
    """`FIGURES`, None where they cannot be told, and why they cannot.

    field_seconds: of the run's stage. speedup_to_quality: see `speedup`, of the two `field/progress.csv`. psnr_gain_db:
    of the field on held-out frames, whole image, run minus baseline, as the two reports have it.

    Raises:
        UserError: a field is not finished, or the two runs are not of the same video.
    """
    if run is None:
        return dict.fromkeys(FIGURES), ["no RUN is given: its field's seconds, speedup and gain are unknown"]
    figures: dict[str, float | None] = dict.fromkeys(FIGURES)
    figures["field_seconds"] = _finished(run, FIELD).seconds
    if baseline is None:
        return figures, ["no BASELINE is given: speedup and gain are unknown"]
    _finished(baseline, FIELD)
    if _finished(run, "frames").inputs != _finished(baseline, "frames").inputs:
        raise UserError(f"{run} and {baseline} are not of the same video: give a BASELINE of the video of RUN")
    reasons = []
    figures["speedup_to_quality"], reason = speedup(read_progress(run / FIELD), read_progress(baseline / FIELD))
    reasons += [reason] if reason else []
    scores, others = read_scores(run / "report"), read_scores(baseline / "report")
    if _HELD_OUT in scores and _HELD_OUT in others:
        figures["psnr_gain_db"] = scores[_HELD_OUT] - others[_HELD_OUT]
    else:
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
