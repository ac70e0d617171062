"""What the report says could be wrong with a capture, from manifests with known figures."""

from dataclasses import replace

import pytest

import stages
from data_tools.stress.rows import ROWS
from pipeline.core.manifest import Manifest
from pipeline.report.page import render_page
from pipeline.report.risks import _CHECKS, HIGH, LOW, SOME, Risk, capture_risks
from tests.report.report_sample import sample_manifests, sample_page

GOOD = {
    "frames": {"unseen_arc_deg": 9.7, "person_px": 610.0, "scene_change_share": 0.0, "cut_feet_share": 0.0},
    "body": {
        "focal_relative_std": 0.09,
        "hidden_leg_share": 0.0,
        "frames_with_foreign_objects": 0.0,
        "silhouette_iou": 0.93,
    },
    "field": {"train_frames": 120.0},
    "mesh": {"stretch_p999": 1.4},
    "texture": {"loose_share": 0.0, "gain_log_std": 0.02, "specular_regions": 0.0},
}


def manifests(stage: str = "", **changed: float | None) -> dict[str, Manifest]:
    """A good capture, except these metrics of one stage."""
    metrics = {name: {**values, **(changed if name == stage else {})} for name, values in GOOD.items()}
    return {name: Manifest(name, 1, "", {}, {}, {}, values, 1.0, 1.0) for name, values in metrics.items()}


def risks(found: list[Risk]) -> dict[str, Risk]:
    return {risk.name: risk for risk in found}


def test_a_good_capture_runs_no_risk() -> None:
    found = capture_risks(manifests())
    assert len(found) == len(_CHECKS)
    assert {risk.level for risk in found} == {LOW}
    assert not any(risk.advice for risk in found)


@pytest.mark.parametrize(
    ("stage", "metric", "value", "level", "text"),
    [
        ("frames", "unseen_arc_deg", 181.0, HIGH, "181° of the turn"),
        ("frames", "unseen_arc_deg", 60.0, SOME, "60° of the turn"),
        ("field", "train_frames", 40.0, SOME, "40 pictures"),
        ("field", "train_frames", 12.0, HIGH, "12 pictures"),
        ("frames", "person_px", 235.0, HIGH, "235 px"),
        ("body", "hidden_leg_share", 0.25, SOME, "25 % of the pictures"),
        ("body", "silhouette_iou", 0.84, SOME, "84 % of the masks"),
        ("texture", "loose_share", 0.2, HIGH, "20 % of the surface"),
    ],
)
def test_one_bad_figure_raises_its_risk_alone(stage: str, metric: str, value: float, level: str, text: str) -> None:
    found = capture_risks(manifests(stage, **{metric: value}))
    assert [risk.level for risk in found] == [level] + [LOW] * (len(_CHECKS) - 1)
    assert text in found[0].finding
    assert found[0].advice


def test_every_risk_has_a_row_of_the_stress_test_and_a_stage() -> None:
    for check in _CHECKS:
        assert check.row in ROWS
        assert check.stage in stages.STAGES
        assert check.some != check.high


def test_missing_figures_leave_their_lines_out() -> None:
    names = risks(capture_risks(manifests("frames", person_px=None)))
    assert "A small person" not in names
    assert len(names) == len(_CHECKS) - 1
    assert list(risks(capture_risks(sample_manifests()))) == ["Body and outline differ"]


def test_the_page_shows_the_risks_escaped() -> None:
    content = sample_page()
    row = {
        "name": "Few <b>",
        "level": "high",
        "finding": "12 pictures",
        "advice": "film longer",
        "row": "weak-evidence",
    }
    page = render_page(replace(content, report={**content.report, "risks": [row]}))
    assert "What could be wrong with this capture" in page
    assert "Few &lt;b&gt;" in page
    assert "What could be wrong" not in render_page(replace(content, report={**content.report, "risks": []}))
