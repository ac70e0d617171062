"""The document and the page of a comparison, and their place beside the report."""

import json
from dataclasses import replace
from html.parser import HTMLParser
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from data_tools.evaluate import compare_page
from data_tools.evaluate.compare_avatar import ImagePair
from data_tools.evaluate.compare_page import comparison_page, write_comparison
from data_tools.sweep.runs import has_current_comparison
from pipeline.core.errors import UserError
from pipeline.core.manifest import (
    MANIFEST_FILE,
    Manifest,
    digest_files,
    find_damaged_files,
    read_manifest,
    write_manifest,
)

SCORES = {"psnr_full": 30.0, "psnr_body": 20.0}
SURFACE = {"chamfer_mm": 4.25, "f_score": 0.5, "normal_angle_deg": 12.0}


def sections() -> tuple[dict[str, Any], dict[str, list[ImagePair]]]:
    """What a comparison finds: a grey square that the avatar makes black."""
    truth = np.zeros((40, 30, 4), dtype=np.uint8)
    truth[5:35, 8:22] = [128, 128, 128, 255]
    avatar = (truth / 255.0).astype(np.float32)
    avatar[..., :3] = 0.0
    images = {"upper_bound": SCORES, "novel_views": {"psnr_full": float("inf"), "psnr_body": 10.0}}
    return {"mesh": SURFACE, "texture": {"coverage": 0.75}, "images": images}, {
        "novel_views": [ImagePair(truth, avatar)]
    }


@pytest.fixture
def run(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A run with a finished report; what the comparison measures is made up."""
    report = tmp_path / "a <run>" / "report"
    report.mkdir(parents=True)
    heldout = dict.fromkeys(("field", "mesh", "mesh_unrefined"), SCORES)
    (report / "report.json").write_text(json.dumps({"heldout": heldout}))
    manifest = Manifest("report", 1, "print", {}, {}, digest_files(report), {}, 1.0, 1.0)
    write_manifest(manifest, report / MANIFEST_FILE)
    monkeypatch.setattr(compare_page, "load_comparison", lambda out, run: None)
    monkeypatch.setattr(compare_page, "avatar_sections", lambda comparison: sections())
    return report.parent


def test_the_document_holds_all_sections_and_the_report_stays_whole(run: Path, tmp_path: Path):
    write_comparison(tmp_path, run, {"masks": {"mask_iou_worst": 0.9}})
    document = json.loads((run / "report" / "truth.json").read_text())
    assert document["mesh"]["chamfer_mm"] == 4.25
    assert document["masks"] == {"mask_iou_worst": 0.9}
    assert list(document["images"]) == ["field", "mesh", "upper_bound", "novel_views"]
    assert document["images"]["novel_views"]["psnr_full"] is None
    assert "iterated closest points" in document["protocol"]
    assert "rows named true_mask" in document["protocol"]
    assert find_damaged_files(run / "report") == []
    manifest = read_manifest(run / "report")
    assert manifest is not None
    assert manifest.fingerprint == "print"  # still fresh
    write_comparison(tmp_path, run, {})  # again, over itself
    assert find_damaged_files(run / "report") == []


def test_a_kill_leaves_no_torn_document_and_is_seen(run: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    """Killed while the second comparison is written: the first one's document is whole, and counts no more."""
    report = run / "report"
    write_comparison(tmp_path, run, {})
    assert has_current_comparison(report)
    first = (report / "truth.json").read_bytes()

    def killed(path: Path) -> None:
        if path.name.endswith("truth.json"):
            path.write_text(path.read_text()[:20])
            raise KeyboardInterrupt

    monkeypatch.setattr("pipeline.core.atomic.flush", killed)
    with pytest.raises(KeyboardInterrupt):
        write_comparison(tmp_path, run, {"masks": {"mask_iou_worst": 0.9}})
    assert (report / "truth.json").read_bytes() == first
    assert not has_current_comparison(report)


def test_without_a_report_the_command_is_named(run: Path, tmp_path: Path):
    (run / "report" / MANIFEST_FILE).unlink()
    with pytest.raises(UserError, match="python -m stages --run"):
        write_comparison(tmp_path, run, {})


def test_the_page_shows_figures_and_pictures_and_fetches_nothing(run: Path, tmp_path: Path):
    write_comparison(tmp_path, run, {"body": {"joint_error_mm": 17.5}})
    page = (run / "report" / "truth.html").read_text()
    found: list[tuple[str, dict[str, str | None]]] = []
    parser = HTMLParser()
    parser.handle_starttag = lambda tag, attrs: found.append((tag, dict(attrs)))  # type: ignore[method-assign]
    parser.feed(page)
    pictures = [attributes for tag, attributes in found if tag == "img"]
    assert [picture["alt"] for picture in pictures] == [
        f"novel views 0, {name}" for name in ("truth", "avatar", "error")
    ]
    links = [attributes.get(key) for _, attributes in found for key in ("src", "href")]
    assert all(link.startswith("data:") or link == "index.html" for link in links if link)
    assert "a &lt;run&gt; against its truth" in page
    for text in ("4.25", "17.5", "0.75", "joint_error_mm", "true mesh in the fitted poses"):
        assert text in page


def test_a_picture_pair_is_scored_on_white():
    (image_pair,) = sections()[1]["novel_views"]
    expected_db = 20 * np.log10(255 / 128)
    assert image_pair.scores()["psnr_body"] == pytest.approx(expected_db)
    same = replace(image_pair, avatar=(image_pair.truth / np.float32(255.0)))
    assert same.scores()["psnr_full"] == np.inf


def test_a_capture_without_novel_poses_has_no_such_column():
    document, pictures = sections()
    document |= {"protocol": "", "images": {"mesh": SCORES} | document["images"]}
    page = comparison_page("title", document, pictures)
    assert "novel poses" not in page
    assert "novel views" in page
