"""State, error message and scores of run folders."""

import json
from pathlib import Path

import pytest

from data_tools.evaluate import files
from data_tools.evaluate.files import load_comparison_scores
from data_tools.sweep.runs import (
    RunState,
    find_video,
    last_error_message,
    read_run,
    read_scores,
    validate_run_options,
)
from pipeline.core.errors import UserError
from pipeline.core.manifest import MANIFEST_FILE
from stages import STAGES
from tests.data_tools.ground_truth_run import write_fake_comparison, write_fake_report

TRACEBACK_HEADER = "Traceback (most recent call last):\n  File\nValueError: too small\n"


def test_failure_is_the_last_error_or_the_end_of_a_traceback(tmp_path: Path) -> None:
    log = tmp_path / "a.log"
    assert last_error_message(log) == ""
    for text, message in (
        ("[1/7] frames\nfield: 3/10\n", ""),
        ("warning: dark\nerror: no person in frame 3: film again\n", "no person in frame 3: film again"),
        (TRACEBACK_HEADER, "ValueError: too small"),
        (TRACEBACK_HEADER + "error: the disk is full\n", "the disk is full"),
        ("error: 1 of 2 frames\nerror: the disk is full\n", "the disk is full"),
    ):
        log.write_text(text)
        assert last_error_message(log) == message


def test_absent_and_null_scores_are_left_out(tmp_path: Path) -> None:
    assert read_scores(tmp_path) == {}
    heldout = {"field": {"psnr_full": 30.5, "psnr_body": None}, "mesh": {"psnr_full": 28}}
    (tmp_path / "report").mkdir()
    (tmp_path / "report" / "report.json").write_text(json.dumps({"heldout": heldout}))
    assert read_scores(tmp_path) == {"field_psnr_full_db": 30.5, "mesh_psnr_full_db": 28.0}


def test_damaged_documents_have_no_scores(tmp_path: Path) -> None:
    write_fake_comparison(tmp_path)
    for text in ('{"mesh": {"chamf', "", "\udcff"):
        for path in (tmp_path / "compare" / "truth.json", tmp_path / "report" / "report.json"):
            path.write_bytes(text.encode("utf-8", "surrogateescape"))
        assert read_scores(tmp_path) == {}


def test_only_a_complete_comparison_of_this_version_and_report_is_current(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    assert load_comparison_scores(tmp_path) is None
    write_fake_comparison(tmp_path)
    assert read_scores(tmp_path) == {"chamfer_mm": 6.5}
    write_fake_report(tmp_path, fingerprint="another")
    assert load_comparison_scores(tmp_path) is None
    write_fake_comparison(tmp_path)
    (tmp_path / "compare" / "truth.json").write_text('{"mesh": {}}')  # edited by hand
    assert load_comparison_scores(tmp_path) is None
    for name in ("truth.html", "truth.json", MANIFEST_FILE):
        write_fake_comparison(tmp_path)
        (tmp_path / "compare" / name).unlink()
        assert load_comparison_scores(tmp_path) is None
    for text in ("{", "[]", '{"version": 3}'):
        write_fake_comparison(tmp_path)
        (tmp_path / "compare" / MANIFEST_FILE).write_text(text)
        assert load_comparison_scores(tmp_path) is None
    write_fake_comparison(tmp_path)
    monkeypatch.setattr(files, "TRUTH_VERSION", files.TRUTH_VERSION + 1)
    assert load_comparison_scores(tmp_path) is None


def test_an_empty_run_is_unfinished_unless_its_log_has_a_failure(tmp_path: Path) -> None:
    run = read_run(tmp_path / "me")
    assert list(run.states) == list(STAGES)
    assert (run.status, run.seconds(STAGES), run.scores) == ("unfinished", 0.0, {})
    (tmp_path / "me.log").write_text("error: me.mp4 cannot be read: convert it\n")
    assert read_run(tmp_path / "me").status == "failed"


def test_a_run_is_done_when_its_last_stage_is() -> None:
    states = dict.fromkeys(STAGES, "fresh")
    assert RunState(states, {}, {}, "").status == "done"
    assert RunState(states | {STAGES[-1]: "missing"}, {}, {}, "").status == "unfinished"
    assert RunState(states | {STAGES[-1]: "missing"}, {}, {}, "dark").status == "failed"


def test_an_unfinished_run_has_no_scores(tmp_path: Path) -> None:
    write_fake_comparison(tmp_path / "me")
    assert read_scores(tmp_path / "me") == {"chamfer_mm": 6.5}
    assert read_run(tmp_path / "me").scores == {}


def test_a_damaged_record_is_a_failure_of_its_run(tmp_path: Path) -> None:
    (tmp_path / "me").mkdir()
    (tmp_path / "me" / "run.json").write_text("{")
    run = read_run(tmp_path / "me")
    assert run.status == "failed"
    assert "run.json is damaged" in run.failure


def test_video_of_a_capture(tmp_path: Path) -> None:
    (tmp_path / "capture" / "video").mkdir(parents=True)
    assert find_video(tmp_path / "capture") == tmp_path / "capture" / "video"
    assert find_video(tmp_path / "me.mp4") == tmp_path / "me.mp4"


def test_unknown_options_are_errors() -> None:
    validate_run_options("instant", ["mesh.edge_px=2"])
    with pytest.raises(UserError, match="instant"):
        validate_run_options("instnt", [])
    with pytest.raises(UserError, match="edge_px"):
        validate_run_options("instant", ["mesh.edge_pz=2"])
