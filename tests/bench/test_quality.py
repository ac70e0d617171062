"""Speedup and PSNR gain of synthetic runs with known values, and unknown values with their reasons."""

import json
from dataclasses import replace
from pathlib import Path

import pytest

from pipeline.core.errors import UserError
from pipeline.core.manifest import Manifest, write_manifest
from tests.bench.quality import compare_quality, speedup

SLOW = [(100.0, 25.0, 18.0), (400.0, 29.0, 21.0), (1000.0, 30.0, 22.0)]
QUICK = [(10.0, 24.0, 17.0), (20.0, 29.89, 21.9), (25.0, 29.9, 21.9), (40.0, 31.0, 23.0)]


def finished_run(
    folder: Path, curve: list[tuple[float, float, float]], held_out_db: float | None, video: str, seconds: float = 45.5
) -> Path:
    manifest = Manifest("", 1, "", {}, {"video": video}, {}, {}, seconds, 100.0)
    for stage in ("frames", "field", "report"):
        (folder / stage).mkdir(parents=True)
        write_manifest(replace(manifest, stage=stage), folder / stage / "manifest.json")
    lines = ["step,seconds,validation_psnr_db,validation_psnr_body_db"]
    lines += [f"{step},{seconds},{full},{body}" for step, (seconds, full, body) in enumerate(curve)]
    (folder / "field" / "progress.csv").write_text("\n".join(lines) + "\n")
    (folder / "report" / "report.json").write_text(json.dumps({"heldout": {"field": {"psnr_full": held_out_db}}}))
    return folder


def test_speedup_tolerance_is_a_tenth_of_a_decibel() -> None:
    """30.0 dB - 0.1 dB is reached after 25 s, not after 20 s: 1000 / 25."""
    assert speedup(QUICK, SLOW) == (40.0, "")


def test_speedup_counts_the_first_crossing() -> None:
    assert speedup([(5.0, 30.5, 20.0), (50.0, 20.0, 10.0)], SLOW) == (200.0, "")


def test_unreached_quality_gives_a_reason() -> None:
    factor, reason = speedup(SLOW, QUICK)
    assert factor is None
    assert "never reaches the baseline's 31.00 dB - 0.1 dB: 30.00 dB at best" in reason
    assert speedup([], SLOW)[0] is None


def test_two_runs(tmp_path: Path) -> None:
    run, baseline = finished_run(tmp_path / "a", QUICK, 30.75, "x"), finished_run(tmp_path / "b", SLOW, 30.5, "x")
    metrics, reasons = compare_quality([run], [baseline])
    assert metrics == {"field_seconds": 45.5, "speedup_to_quality": 40.0, "psnr_gain_db": 0.25}
    assert reasons == []


def test_several_seeds_and_videos_are_summarised_by_medians(tmp_path: Path) -> None:
    """Two runs of video x with one baseline, one of video y with two; speedups of the pairs: 40, 20, 8, 16."""

    def slower(factor: float) -> list[tuple[float, float, float]]:
        return [(factor * seconds, full, body) for seconds, full, body in QUICK]

    runs = [
        finished_run(tmp_path / "x0", QUICK, 30.5, "x"),
        finished_run(tmp_path / "x1", slower(2), 30.6, "x"),
        finished_run(tmp_path / "y0", slower(5), 31.0, "y"),
    ]
    longer = [(2 * seconds, full, body) for seconds, full, body in SLOW]
    baselines = [
        finished_run(tmp_path / "bx", SLOW, 30.5, "x"),
        finished_run(tmp_path / "by0", SLOW, 30.5, "y"),
        finished_run(tmp_path / "by1", longer, 30.8, "y"),
    ]
    metrics, reasons = compare_quality(runs, baselines)
    assert reasons == []
    assert metrics["speedup_to_quality"] == pytest.approx((20 + 16) / 2)
    assert metrics["psnr_gain_db"] == pytest.approx((0.1 + 0.2) / 2)


def test_unknown_pair_makes_the_median_unknown(tmp_path: Path) -> None:
    runs = [finished_run(tmp_path / "a", QUICK, 30.5, "x"), finished_run(tmp_path / "b", SLOW[:1], None, "x")]
    metrics, reasons = compare_quality(runs, [finished_run(tmp_path / "c", SLOW, 30.5, "x")])
    assert (metrics["speedup_to_quality"], metrics["psnr_gain_db"]) == (None, None)
    assert any("b and" in reason and "never reaches" in reason for reason in reasons)


def test_missing_inputs_give_null_with_a_reason(tmp_path: Path) -> None:
    run = finished_run(tmp_path / "a", QUICK, None, "x")
    assert compare_quality([], []) == (
        dict.fromkeys(("field_seconds", "speedup_to_quality", "psnr_gain_db")),
        ["no RUN: field seconds, speedup and PSNR gain are unknown"],
    )
    metrics, (reason,) = compare_quality([run], [])
    assert (metrics["field_seconds"], metrics["speedup_to_quality"], metrics["psnr_gain_db"]) == (45.5, None, None)
    assert "no BASELINE" in reason
    unscored, (reason,) = compare_quality([run], [finished_run(tmp_path / "b", SLOW, 30.5, "x")])
    assert unscored["psnr_gain_db"] is None
    assert "report stage is not finished" in reason


def test_seconds_are_the_median_of_the_runs(tmp_path: Path) -> None:
    runs = [
        finished_run(tmp_path / name, QUICK, None, "x", seconds) for name, seconds in (("a", 9), ("b", 5), ("c", 6))
    ]
    assert compare_quality(runs, [])[0]["field_seconds"] == 6


def test_runs_of_different_videos_are_rejected(tmp_path: Path) -> None:
    run, other = finished_run(tmp_path / "a", QUICK, 30.0, "x"), finished_run(tmp_path / "b", SLOW, 30.0, "y")
    with pytest.raises(UserError, match="not of the same video"):
        compare_quality([run], [other])
    with pytest.raises(UserError, match="has no finished field"):
        compare_quality([tmp_path], [])
