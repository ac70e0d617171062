"""The document of report.json: the promised keys, sums and means, and nothing that JSON cannot hold."""

import json
import math

import pytest

from pipeline.core.errors import UserError
from pipeline.core.manifest import Manifest
from pipeline.report.report_json import replace_nonfinite, report_to_json
from tests.report import report_sample
from tests.report.report_sample import SCORES, STAGES, sample_manifests, sample_report


def test_contract_keys_are_present():
    report = json.loads(report_to_json(sample_report()))
    assert list(report["seconds"]) == [*STAGES, "report", "total"]
    assert list(report["peak_rss_mib"]) == [*STAGES, "report", "total"]
    for render in ("field", "mesh"):
        assert {"psnr_full", "psnr_body", "ssim_full"} <= report["heldout"][render].keys()
    assert {"vertices", "faces", "watertight", "manifold", "components"} <= report["mesh"].keys()
    assert {"glb_bytes", "texture_px"} <= report["export"].keys()
    assert report["masks"] == {"count": 9}
    assert report["body"] == {"landmark_error_px": 4.5, "silhouette_iou": 0.93}
    assert "every eighth frame" in report["heldout"]["protocol"]
    assert report["heldout"]["split"].startswith("interleaved")
    assert "fitted to landmarks and silhouettes, never to colours" in report["heldout"]["protocol"]


def test_totals_are_the_sum_of_seconds_and_the_highest_peak():
    report = sample_report()
    assert report["seconds"]["total"] == 1 + 2 + 3 + 4 + 5 + 6 + 7
    assert report["peak_rss_mib"]["total"] == 700.0


def test_scores_are_means_over_frames():
    heldout = sample_report()["heldout"]
    assert heldout["field"]["psnr_full"] == 25.0
    assert heldout["mesh"]["ssim_box"] == 24.0
    assert [row["index"] for row in heldout["frames"]] == [0, 8]


def test_the_psnr_of_equal_images_becomes_null():
    report = sample_report(math.inf)
    assert report["heldout"]["field"]["psnr_full"] is None
    assert json.loads(report_to_json(report))["heldout"]["frames"][0]["mesh"]["psnr_body"] is None
    assert replace_nonfinite({"a": [math.nan, 1.0, (2, -math.inf)]}) == {"a": [None, 1.0, [2, None]]}


def test_lpips_note_states_protocol_or_reason_for_absence(monkeypatch):
    assert sample_report()["heldout"]["lpips"].startswith("not computed")
    monkeypatch.setattr(report_sample, "SCORES", (*SCORES, "lpips_full"))
    assert "do not compare" in sample_report()["heldout"]["lpips"]


def test_warnings_name_their_stage():
    manifests = sample_manifests()
    manifests["frames"] = Manifest("frames", 1, "", {}, {}, {}, {}, 1.0, 1.0, warnings=["3 frames without a person"])
    assert sample_report(manifests=manifests)["warnings"] == ["frames: 3 frames without a person"]


def test_a_figure_that_the_body_stage_did_not_leave_is_named():
    manifests = sample_manifests()
    manifests["body"] = Manifest("body", 1, "", {}, {}, {}, {}, 1.0, 1.0)
    with pytest.raises(UserError, match="landmark_error_px.*stages.body"):
        sample_report(manifests=manifests)


def test_how_the_template_fits_is_said_in_words():
    assert sample_report()["template"] is None
    manifests = sample_manifests()
    shares = {"close_share": 0.7, "cloth_share": 0.2, "loose_share": 0.06, "hair_share": 0.04}
    distances = {"template_distance_median_mm": 0.21, "template_distance_p95_mm": 4.7, "template_flipped_faces": 0.0}
    manifests["texture"] = Manifest("texture", 1, "", {}, {}, {}, shares | distances, 1.0, 1.0)
    sentence = sample_report(manifests=manifests)["template"]
    for words in (
        "0.2 mm",
        "within 4.7 mm",
        "with 0 faces turned over",
        "70% lie close",
        "6% stand off",
        "4% are hair",
    ):
        assert words in sentence
