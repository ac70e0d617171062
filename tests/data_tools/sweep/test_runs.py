"""What a run folder and its log tell to a program of many runs."""

import json
from pathlib import Path

import pytest

from data_tools.evaluate.files import TRUTH_VERSION
from data_tools.sweep.runs import (
    RunState,
    find_video,
    has_current_comparison,
    last_error_message,
    read_run,
    read_scores,
    validate_run_options,
)
from pipeline.core.errors import UserError
from pipeline.core.manifest import MANIFEST_FILE
from stages import STAGES
from tests.data_tools.ground_truth_run import write_fake_comparison

TRACEBACK_HEADER = "Traceback (most recent call last):\n  File\nValueError: too small\n"


def test_a_failure_is_the_last_error_or_the_end_of_a_traceback(tmp_path: Path) -> None:
    log = tmp_path / "a.log"
    assert last_error_message(log) == ""
    for text, sentence in (
        ("[1/7] frames\nfield: 3/10\n", ""),
        ("warning: dark\nerror: no person in frame 3: film again\n", "no person in frame 3: film again"),
        (TRACEBACK_HEADER, "ValueError: too small"),
        (TRACEBACK_HEADER + "error: the disk is full\n", "the disk is full"),
        ("error: 1 of 2 frames\nerror: the disk is full\n", "the disk is full"),
    ):
        log.write_text(text)
        assert last_error_message(log) == sentence


def test_scores_that_are_absent_or_null_are_left_out(tmp_path: Path) -> None:
    assert read_scores(tmp_path) == {}
    heldout = {"field": {"psnr_full": 30.5, "psnr_body": None}, "mesh": {"psnr_full": 28}}
    (tmp_path / "report.json").write_text(json.dumps({"heldout": heldout}))
    assert read_scores(tmp_path) == {"field_psnr_full_db": 30.5, "mesh_psnr_full_db": 28.0}


def test_a_damaged_document_counts_as_absent(tmp_path: Path) -> None:
    for torn in ('{"mesh": {"chamf', "", "\udcff"):
        (tmp_path / "truth.json").write_bytes(torn.encode("utf-8", "surrogateescape"))
        assert read_scores(tmp_path) == {}


def test_a_comparison_counts_whole_and_of_this_version(tmp_path: Path) -> None:
    assert not has_current_comparison(tmp_path)
    write_fake_comparison(tmp_path)
    assert has_current_comparison(tmp_path)
    (tmp_path / "truth.json").write_text('{"version": 2, "me')  # a kill in the middle
    assert not has_current_comparison(tmp_path)
    for name in ("truth.html", MANIFEST_FILE):
        write_fake_comparison(tmp_path)
        (tmp_path / name).unlink()
        assert not has_current_comparison(tmp_path)
    write_fake_comparison(tmp_path, TRUTH_VERSION - 1)
    assert not has_current_comparison(tmp_path)


def test_an_empty_run_is_unfinished_until_its_log_tells_of_a_failure(tmp_path: Path) -> None:
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


def test_scores_of_an_outdated_report_are_not_told(tmp_path: Path) -> None:
    (tmp_path / "me" / "report").mkdir(parents=True)
    (tmp_path / "me" / "report" / "truth.json").write_text('{"mesh": {"chamfer_mm": 6.5}}')
    assert read_scores(tmp_path / "me" / "report") == {"chamfer_mm": 6.5}
    assert read_run(tmp_path / "me").scores == {}


def test_a_damaged_record_is_told_not_thrown(tmp_path: Path) -> None:
    (tmp_path / "me").mkdir()
    (tmp_path / "me" / "run.json").write_text("{")
    run = read_run(tmp_path / "me")
    assert run.status == "failed"
    assert "run.json is damaged" in run.failure


def test_a_captures_video_lies_beside_its_truth(tmp_path: Path) -> None:
    (tmp_path / "capture" / "video").mkdir(parents=True)
    assert find_video(tmp_path / "capture") == tmp_path / "capture" / "video"
    assert find_video(tmp_path / "me.mp4") == tmp_path / "me.mp4"


def test_unknown_options_are_refused_before_any_run() -> None:
    validate_run_options("instant", ["mesh.edge_px=2"])
    with pytest.raises(UserError, match="instant"):
        validate_run_options("instnt", [])
    with pytest.raises(UserError, match="edge_px"):
        validate_run_options("instant", ["mesh.edge_pz=2"])
