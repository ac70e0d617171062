"""The document, the page and the folder of a comparison with the ground truth."""

import json
from dataclasses import replace
from html.parser import HTMLParser
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from data_tools.evaluate import files, page
from data_tools.evaluate.comparison import ImagePair
from data_tools.evaluate.files import load_comparison_scores
from data_tools.evaluate.page import comparison_page, write_comparison
from pipeline.core.errors import UserError
from pipeline.core.manifest import (
    MANIFEST_FILE,
    Manifest,
    digest_files,
    write_manifest,
)

SCORES = {"psnr_full": 30.0, "psnr_body": 20.0}
SURFACE = {"chamfer_mm": 4.25, "f_score": 0.5, "normal_angle_deg": 12.0}


def sections() -> tuple[dict[str, Any], dict[str, list[ImagePair]]]:
    """Scores and images of a comparison: a grey square that is black in the avatar."""
    truth = np.zeros((40, 30, 4), dtype=np.uint8)
    truth[5:35, 8:22] = [128, 128, 128, 255]
    avatar = (truth / 255.0).astype(np.float32)
    avatar[..., :3] = 0.0
    images = {"upper_bound": SCORES, "novel_views": {"psnr_full": float("inf"), "psnr_body": 10.0}}
    return {"mesh": SURFACE, "light": "flat", "texture": {"coverage": 0.75}, "images": images}, {
        "novel_views": [ImagePair(truth, avatar)]
    }


@pytest.fixture
def run(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A run with a finished report; the measured sections are replaced by constants."""
    report = tmp_path / "a <run>" / "report"
    report.mkdir(parents=True)
    heldout = dict.fromkeys(("field", "mesh", "mesh_unrefined"), SCORES)
    (report / "report.json").write_text(json.dumps({"heldout": heldout}))
    manifest = Manifest("report", 1, "print", {}, {}, digest_files(report), {}, 1.0, 1.0)
    write_manifest(manifest, report / MANIFEST_FILE)
    monkeypatch.setattr(page, "load_comparison", lambda out, run: None)
    monkeypatch.setattr(page, "avatar_sections", lambda comparison: sections())
    return report.parent


def test_document_has_all_sections_and_the_report_is_unchanged(run: Path, tmp_path: Path):
    before = {path.name: path.read_bytes() for path in (run / "report").iterdir()}
    write_comparison(tmp_path, run, {"masks": {"mask_iou_worst": 0.9}})
    document = load_comparison_scores(run)
    assert document is not None
    assert document["mesh"]["chamfer_mm"] == 4.25
    assert document["masks"] == {"mask_iou_worst": 0.9}
    assert list(document["images"]) == ["field", "mesh", "upper_bound", "novel_views"]
    assert document["images"]["novel_views"]["psnr_full"] is None
    assert "iterated closest points" in document["protocol"]
    assert "the columns true_mask" in document["protocol"]
    assert {path.name: path.read_bytes() for path in (run / "report").iterdir()} == before
    write_comparison(tmp_path, run, {})  # replaces the first comparison
    document = load_comparison_scores(run)
    assert document is not None
    assert "masks" not in document


def test_interrupted_comparison_keeps_the_previous_one(run: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    write_comparison(tmp_path, run, {})
    first = load_comparison_scores(run)

    def interrupt(path: Path) -> str:
        raise KeyboardInterrupt

    monkeypatch.setattr(files, "digest_file", interrupt)
    with pytest.raises(KeyboardInterrupt):
        write_comparison(tmp_path, run, {"masks": {"mask_iou_worst": 0.9}})
    monkeypatch.undo()
    assert load_comparison_scores(run) == first


def test_missing_report_names_the_command(run: Path, tmp_path: Path):
    (run / "report" / MANIFEST_FILE).unlink()
    with pytest.raises(UserError, match="python -m stages --run"):
        write_comparison(tmp_path, run, {})


def test_page_shows_scores_and_images_and_is_self_contained(run: Path, tmp_path: Path):
    write_comparison(tmp_path, run, {"body": {"joint_error_mm": 17.5}})
    text = (run / "compare" / "truth.html").read_text()
    found: list[tuple[str, dict[str, str | None]]] = []
    parser = HTMLParser()
    parser.handle_starttag = lambda tag, attrs: found.append((tag, dict(attrs)))  # type: ignore[method-assign]
    parser.feed(text)
    images = [attributes for tag, attributes in found if tag == "img"]
    assert [image["alt"] for image in images] == [f"novel views 0, {name}" for name in ("truth", "avatar", "error")]
    links = [attributes.get(key) for _, attributes in found for key in ("src", "href")]
    assert all(link.startswith("data:") or link == "../report/index.html" for link in links if link)
    assert "a &lt;run&gt;: comparison with ground truth" in text
    for expected in ("4.25", "17.5", "0.75", "joint_error_mm", "true mesh in the estimated poses"):
        assert expected in text


def test_image_pairs_are_scored_on_white():
    (image_pair,) = sections()[1]["novel_views"]
    expected_db = 20 * np.log10(255 / 128)
    assert image_pair.scores()["psnr_body"] == pytest.approx(expected_db)
    same = replace(image_pair, avatar=(image_pair.truth / np.float32(255.0)))
    assert same.scores()["psnr_full"] == np.inf


def test_capture_without_novel_poses_has_no_such_column():
    document, image_pairs = sections()
    document |= {"protocol": "", "images": {"mesh": SCORES} | document["images"]}
    text = comparison_page("title", document, image_pairs)
    assert "novel poses" not in text
    assert "novel views" in text
