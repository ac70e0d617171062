"""Verdicts: what passes, what crosses, what a refusal counts, and that every row of the project is well formed."""

import pytest

from data_tools.stress.measures import MEASURES
from data_tools.stress.procedures import PROCEDURES
from data_tools.stress.row import DONE, FAILED, MISSING, REFUSED, Row, Trial, TrialResult, bounded, bounded_change
from data_tools.stress.rows import ROWS
from data_tools.stress.rows.light import gains_are_found, matte_stays_matte
from data_tools.stress.rows.motion import focal_is_found_or_named, posed_close_to_views, recovers_half
from data_tools.stress.rows.robustness import right_videos_are_refused
from data_tools.stress.rows.shape import more_is_never_worse, weak_is_body_like


def make_row(may_refuse: bool = False) -> Row:
    trials = (Trial("low", 0), Trial("high", 1))
    return Row("row", "failure", "at most 2", trials, bounded("error", high=2.0), "error", "mm", may_refuse=may_refuse)


def done(**scores: float) -> TrialResult:
    return TrialResult(DONE, scores)


def test_a_row_passes_only_when_all_trials_are_done() -> None:
    row = make_row()
    assert row.verdict({"low": TrialResult(MISSING), "high": TrialResult(MISSING)}) == ("not run", [])
    assert row.verdict({"low": done(error=1.0), "high": TrialResult(MISSING)}) == ("incomplete", [])
    assert row.verdict({"low": done(error=1.0), "high": done(error=2.0)}) == ("pass", [])


def test_a_crossed_line_is_known_before_all_trials_are_done() -> None:
    verdict, sentences = make_row().verdict({"low": done(error=2.5), "high": TrialResult(MISSING)})
    assert verdict == "crossed"
    assert sentences == ["low: error 2.5"]


@pytest.mark.parametrize(("may_refuse", "verdict"), [(True, "pass"), (False, "crossed")])
def test_a_refusal_passes_only_where_the_row_says_so(may_refuse: bool, verdict: str) -> None:
    results = {"low": done(error=1.0), "high": TrialResult(REFUSED, message="no person")}
    assert make_row(may_refuse).verdict(results)[0] == verdict


def test_a_fault_of_the_program_never_passes() -> None:
    results = {"low": done(error=1.0), "high": TrialResult(FAILED, message="IndexError")}
    assert make_row(may_refuse=True).verdict(results) == ("crossed", ["high: failed, IndexError"])


@pytest.mark.parametrize("value", [float("nan"), float("inf")])
def test_a_score_that_is_not_finite_crosses(value: float) -> None:
    assert bounded("error", high=2.0)({"low": done(error=value)})
    assert bounded("error", high=2.0)({"low": done()})


def test_changes_are_from_the_reference_trial() -> None:
    line = bounded_change("clean", {"db": (-1.0, None), "mm": (None, 1.0)})
    clean = done(db=25.0, mm=3.0)
    assert line({"clean": clean, "box": done(db=24.1, mm=3.9)}) == []
    assert line({"clean": clean, "box": done(db=23.0, mm=5.0)}) == ["box: db -2 from clean", "box: mm +2 from clean"]
    assert line({"box": done(db=0.0, mm=9.0)}) == []


def test_pose_noise_must_be_halved() -> None:
    clean = done(fitted_joint_error_mm=10.0, refined_joint_error_mm=8.0)
    for refined_mm, count in ((13.0, 0), (16.0, 1)):
        noisy = done(fitted_joint_error_mm=20.0, refined_joint_error_mm=refined_mm)
        assert len(recovers_half({"0°, 0 mm": clean, "2°, 6 mm": noisy})) == count


def test_a_wrong_focal_length_is_found_or_named() -> None:
    warned = TrialResult(DONE, {"focal_ratio": 0.5}, warnings=("the supplied focal length contradicts the turn",))
    assert focal_is_found_or_named({"× 0.5": warned, "× 2": done(focal_ratio=1.05)}) == []
    assert len(focal_is_found_or_named({"× 0.5": done(focal_ratio=0.5)})) == 1
    assert len(focal_is_found_or_named({"× 1.05": warned})) == 1


def test_unseen_poses_may_be_three_decibels_below() -> None:
    assert posed_close_to_views({"a": done(psnr_body_db=24.0, posed_psnr_body_db=21.5)}) == []
    assert posed_close_to_views({"a": done(psnr_body_db=24.0, posed_psnr_body_db=20.0)})


def test_more_frames_are_never_worse() -> None:
    def results(db: dict[int, float]) -> dict[str, TrialResult]:
        return {f"{n} frames, seed {s}": done(psnr_body_db=value) for n, value in db.items() for s in range(3)}

    assert more_is_never_worse(results({8: 15.0, 19: 20.0, 114: 19.85})) == []
    assert more_is_never_worse(results({8: 15.0, 19: 20.0, 114: 19.7})) == ["114 frames: -0.30 dB from 19"]


def test_few_frames_must_give_a_body() -> None:
    results = {"8 frames, seed 0": done(far_area_share=0.02), "114 frames, seed 0": done(far_area_share=0.02)}
    assert weak_is_body_like(results) == ["8 frames, seed 0: far_area_share 0.02"]


def test_gains_and_highlights() -> None:
    assert gains_are_found({"clean": done(), "flicker": done(gain_error=0.04)}) == []
    assert gains_are_found({"flicker": done(gain_error=0.06)})
    assert gains_are_found({"flicker": done(gain_error=float("nan"))})
    assert matte_stays_matte({"0": done(specular_mean=0.0)}) == []
    assert matte_stays_matte({"0": done(specular_mean=0.01)})


def test_bad_videos_are_refused_and_good_ones_are_not() -> None:
    good, bad = done(files_with_nan=0.0), TrialResult(REFUSED, message="no feet")
    assert right_videos_are_refused({"real turn": good, "no feet": bad}) == []
    assert right_videos_are_refused({"real turn": bad, "no feet": good}) == ["real turn: refused", "no feet: done"]


@pytest.mark.parametrize("name", list(ROWS))
def test_rows_are_well_formed(name: str) -> None:
    row = ROWS[name]
    labels = [trial.label for trial in row.trials]
    assert len(set(labels)) == len(labels) > 1
    assert all(trial.procedure in PROCEDURES for trial in row.trials)
    assert all(trial.settings.get("measure", "avatar") in MEASURES for trial in row.trials)
    assert row.line
    assert row.failure
    missing = {label: TrialResult(MISSING) for label in labels}
    assert row.verdict(missing) == ("not run", [])
