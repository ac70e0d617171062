"""The sweep of the field stage: its rows, its resumption, and its tables, on trainings whose scores are known."""

import json
from dataclasses import fields, replace
from pathlib import Path

import pytest

from data_tools.sweep import ablate_field, field_trials
from data_tools.sweep.field_rows import ATTENTION, GROUPS, REFERENCE, ROWS, rows_of_group
from data_tools.sweep.field_tables import COLUMNS, format_difference, paired_scores, write_tables
from data_tools.sweep.field_trials import FieldTrial, TrialScores, begin_folder, read_trial, run_trial
from data_tools.synthetic.scene.capture import CAPTURE_VERSION
from pipeline.core.errors import UserError
from pipeline.core.manifest import MANIFEST_FILE, Manifest, write_manifest
from pipeline.field.checkpoint import CHECKPOINT_FILE
from pipeline.field.config import FieldConfig


def trial(out: Path, row: str, run: str = "one", seed: int = 0, steps: int = 400) -> FieldTrial:
    base = FieldConfig(seed=seed, steps=steps)
    return FieldTrial(Path(run), ROWS[row], seed, ROWS[row].config(base), None, out)


def scores(psnr_db: float) -> TrialScores:
    return TrialScores("", {"validation_psnr_db": psnr_db, "parameters": 1e6, "cpu_seconds": 30.0}, "abc", "two cores")


def test_rows_change_what_they_name_and_keep_the_rest():
    base = FieldConfig(seed=3, steps=400)
    for name, row in ROWS.items():
        config = row.config(base)
        options = {key for key in FieldConfig.model_fields if getattr(config, key) != getattr(base, key)} - {"settings"}
        changed = {each.name for each in fields(base.settings)} & {
            each.name
            for each in fields(base.settings)
            if getattr(config.settings, each.name) != getattr(base.settings, each.name)
        }
        assert options == set(row.factors) | set(row.options), name
        assert changed == set(row.settings), name
        assert row.compared_with in ROWS
    assert ROWS["steps-half"].config(base).steps == 200
    assert ROWS["levels-more"].config(base).settings.levels == base.settings.levels + 1
    assert ROWS["rows-half"].config(base).log2_hashmap_size == base.log2_hashmap_size - 1
    assert ROWS["frames-quarter"].config(base).max_frames == base.max_frames // 4
    assert rows_of_group(ATTENTION) == [REFERENCE, "attention"]
    groups = [set(rows_of_group(group)) - {REFERENCE} for group in GROUPS]
    assert set.union(*groups) | {REFERENCE} == set(ROWS)
    assert sum(map(len, groups)) == len(ROWS) - 1


def test_a_finished_training_is_read_and_one_with_other_options_runs_again(tmp_path: Path, monkeypatch):
    made = []

    def run(inputs, out, config):
        made.append(config.steps)
        return {"validation_psnr_db": 30.0, "parameters": 10, "occupied_cells": 5}

    monkeypatch.setattr(field_trials.field, "run", run)
    first = run_trial(trial(tmp_path, REFERENCE))
    assert first.scores["validation_psnr_db"] == 30.0
    assert first.scores["cpu_seconds"] >= 0.0
    assert run_trial(trial(tmp_path, REFERENCE)) == first
    assert made == [400]
    assert read_trial(trial(tmp_path, REFERENCE, steps=500)) is None
    run_trial(trial(tmp_path, REFERENCE, steps=500))
    assert made == [400, 500]
    assert json.loads((tmp_path / "one-reference-0" / "scores.json").read_text())["scores"]["parameters"] == 10


def test_scores_and_checkpoints_of_other_frames_are_not_used(tmp_path: Path, monkeypatch):
    """Runs of two people may have the same name, and a run may be made again."""
    monkeypatch.setattr(field_trials.field, "run", lambda inputs, out, config: {"validation_psnr_db": 30.0})
    of_person = {name: trial(tmp_path / "out", REFERENCE, str(tmp_path / name / "me")) for name in ("ann", "bob")}
    for name, each in of_person.items():
        for stage in ("frames", "body"):
            folder = each.run / stage
            folder.mkdir(parents=True)
            write_manifest(Manifest(stage, 1, "", {}, {}, {"a.npz": name}, {}, 0.0, 0.0), folder / MANIFEST_FILE)
    run_trial(of_person["ann"])
    assert read_trial(of_person["ann"]) is not None
    assert read_trial(of_person["bob"]) is None
    (of_person["ann"].folder / CHECKPOINT_FILE).touch()
    assert "cpu_seconds" in run_trial(of_person["bob"]).scores  # not resumed
    assert not (of_person["bob"].folder / CHECKPOINT_FILE).exists()


def test_scores_against_another_truth_are_not_used(tmp_path: Path, monkeypatch):
    """A capture may be made again with other options."""
    monkeypatch.setattr(field_trials.field, "run", lambda inputs, out, config: {"validation_psnr_db": 30.0})
    monkeypatch.setattr(field_trials, "score_field", lambda run, folder, capture: {"haze": 0.1})
    settings = tmp_path / "one-capture" / "truth" / "capture_settings.json"
    settings.parent.mkdir(parents=True)
    settings.write_text('{"seed": 0}')
    judged = replace(trial(tmp_path / "out", REFERENCE), truth=tmp_path / "one-capture")
    assert run_trial(judged) == read_trial(judged)
    settings.write_text('{"seed": 1}')
    assert read_trial(judged) is None


def test_a_capture_of_another_video_is_refused(tmp_path: Path, monkeypatch):
    run, capture = tmp_path / "one", tmp_path / "one-capture"
    for folder in (run / "frames", run / "body", capture / "truth", capture / "video"):
        folder.mkdir(parents=True)
    (capture / "video" / "video.mp4").write_text("the video of someone else")
    settings = capture / "truth" / "capture_settings.json"
    settings.write_text(json.dumps({"version": CAPTURE_VERSION}))
    manifest = Manifest("frames", 1, "", {}, {"video": "the digest of mine"}, {}, {}, 0.0, 0.0)
    write_manifest(manifest, run / "frames" / MANIFEST_FILE)
    monkeypatch.setattr(ablate_field, "run_trial", lambda trial: pytest.fail("a field was trained"))
    command = [str(run), "--rows", REFERENCE, "--truth", "--out", str(tmp_path / "out")]
    with pytest.raises(UserError, match=r"one was not made from .*video\.mp4 as it is now"):
        ablate_field.main(command)
    settings.write_text(json.dumps({"version": 1}))
    with pytest.raises(UserError, match="one-capture is a capture of version 1"):
        ablate_field.main(command)
    settings.unlink()
    with pytest.raises(UserError, match="holds no ground truth"):
        ablate_field.main(command)


def test_an_interrupted_training_has_no_seconds(tmp_path: Path, monkeypatch):
    monkeypatch.setattr(field_trials.field, "run", lambda inputs, out, config: {"validation_psnr_db": 30.0})
    interrupted = trial(tmp_path, "rows-half")
    begin_folder(interrupted)
    (interrupted.folder / CHECKPOINT_FILE).touch()
    assert set(run_trial(interrupted).scores) == {"validation_psnr_db"}


def test_differences_are_paired_by_run_and_seed(tmp_path: Path):
    results = {
        trial(tmp_path, REFERENCE, "one"): scores(30.0),
        trial(tmp_path, REFERENCE, "two"): scores(20.0),
        trial(tmp_path, "rows-half", "one"): scores(29.9),
        trial(tmp_path, "rows-half", "two"): scores(20.3),
        trial(tmp_path, "rows-half", "two", seed=1): scores(0.0),
    }
    pairs = paired_scores(results, "rows-half")
    assert [(a["validation_psnr_db"], b["validation_psnr_db"]) for a, b in pairs] == [(29.9, 30.0), (20.3, 20.0)]
    # Mean of -0.1 and 0.3; standard error |0.4| / 2.
    assert format_difference(pairs, COLUMNS[0]) == "+0.10 ± 0.20"
    assert format_difference(pairs[:1], COLUMNS[0]) == "-0.10"
    assert format_difference([({}, pairs[0][1])], COLUMNS[0]) == "–"
    assert format_difference([*pairs, ({}, pairs[0][1])], COLUMNS[0]) == "+0.10 ± 0.20"
    write_tables(tmp_path, results, "the command")
    text = (tmp_path / "field.md").read_text(encoding="utf-8")
    assert "| `rows-half` - `reference` | 2 | +0.10 ± 0.20 |" in text
    assert "| difference | one, dB | two, dB |" in text
    assert "| `rows-half` - `reference` | -0.10 / – | +0.30 / – |" in text
    assert "| `reference` | the stage as it is | 2 | 25.00 |" in text
    assert "novel views" not in text
    assert "`the command`" in text
    lines = (tmp_path / "field.csv").read_text(encoding="utf-8").splitlines()
    assert len(lines) == 6
    assert lines[1].startswith("one,reference,0,400,30.0")


def test_a_run_without_a_body_is_named(tmp_path: Path):
    (tmp_path / "frames").mkdir()
    with pytest.raises(UserError, match="body does not exist"):
        ablate_field.main([str(tmp_path), "--out", str(tmp_path / "out")])


def test_half_of_the_frames_is_half_of_those_of_the_run(tmp_path: Path, monkeypatch):
    for name in ("frames", "body"):
        (tmp_path / name).mkdir()
    monkeypatch.setattr(ablate_field, "load_capture", lambda folder: folder)
    monkeypatch.setattr(ablate_field, "usable_positions", lambda capture, body: range(72))
    used = []

    def run_trial(trial: FieldTrial) -> TrialScores:
        used.append(trial.config.max_frames)
        return scores(30.0)

    monkeypatch.setattr(ablate_field, "run_trial", run_trial)
    rows = [REFERENCE, "frames-half", "frames-quarter"]
    ablate_field.main([str(tmp_path), "--rows", *rows, "--out", str(tmp_path / "out")])
    assert used == [72, 36, 18]
