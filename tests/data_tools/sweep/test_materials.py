"""The table of materials: its cells are those of the figures, trials are stored and read again."""

import json
from pathlib import Path
from typing import Any

import pytest

import stages
from data_tools.sweep.chart_trials import Trial
from data_tools.sweep.figures import END, insert_tables
from data_tools.sweep.material_trials import MaterialTrial, read_figures
from data_tools.sweep.materials import DOCUMENT, TABLE_HEAD, finish_run, main, material_rows, trials_of
from data_tools.sweep.runs import RunState
from pipeline.core.errors import UserError
from stages.texture import STAGE as TEXTURE

FIGURES = {
    "albedo_error_kept": 10.0,
    "albedo_error_auto": 4.0,
    "relit_left_db_kept": 20.0,
    "relit_left_db_auto": 23.0,
    "relit_top_db_kept": 20.0,
    "relit_top_db_auto": 25.0,
    "heldout_psnr_body_db_kept": 25.5,
    "heldout_psnr_body_db_auto": 26.0,
    "specular_regions": 3.0,
    "normal_map_angle_deg": 1.25,
    "seconds_added": 8.4,
}
SHINY = {"specular_correlation_auto": 0.625, "lamp_error_deg_auto": 4.4, "gain_error_largest": 0.012}


def trial(seed: int = 0, true_mesh: bool = False, out: Path = Path("runs/materials")) -> MaterialTrial:
    return MaterialTrial(Trial(Path("captures/ann"), "instant", seed, out), true_mesh)


def measured(figures: dict[str, float], commit: str = "a" * 40) -> dict[str, Any]:
    return {"texture_version": TEXTURE.version, "commit": commit, "environment": {"cpu": "Xeon"}, "figures": figures}


def test_a_row_has_mean_and_range_over_the_seeds_and_its_commits() -> None:
    other = FIGURES | {"albedo_error_auto": 6.0, "heldout_psnr_body_db_auto": 27.5}
    trials = {trial(0): FIGURES, trial(1): other, trial(0, true_mesh=True): FIGURES | SHINY}
    commits = ["a" * 40, "b" * 40, "a" * 40]
    rows = material_rows({key: measured(*each) for key, *each in zip(trials, trials.values(), commits, strict=True)})
    runs, true = rows["ann", "run"], rows["ann", "true"]
    cells = "| ann | run | 0 1 | 10.0 | 50 (40 to 60) | 4.0 | 1.2 (0.5 to 2.0) |  |  | 3 |  | 1.2 | 8 |"
    assert runs == f"{cells} {'a' * 10}; {'b' * 10} |"
    assert true == f"| ann | true | 0 | 10.0 | 40 | 4.0 | 0.5 | 0.62 | 4 | 3 | 1.2 | 1.2 | 8 | {'a' * 10} |"


def test_the_true_mesh_is_measured_once_and_runs_once_a_seed() -> None:
    trials = trials_of([Path("captures/ann")], ["true", "run"], [5, 6], "instant", Path("out"))
    assert [each.name for each in trials] == ["ann-true-5", "ann-instant-5", "ann-instant-6"]
    assert trials[1].base.run_dir == Path("out/ann-instant-5")


def test_figures_of_another_version_of_the_stage_are_measured_again(tmp_path: Path) -> None:
    stored = trial(out=tmp_path)
    assert read_figures(stored) is None
    stored.path.parent.mkdir(parents=True)
    for version, expected in ((TEXTURE.version, FIGURES), (TEXTURE.version - 1, None)):
        inputs = {"inputs": stored.inputs_digest()}
        stored.path.write_text(json.dumps({"texture_version": version, "figures": FIGURES, **inputs}))
        found = read_figures(stored)
        assert (None if found is None else found["figures"]) == expected
    stored.path.write_text("{")
    with pytest.raises(UserError, match="damaged"):
        read_figures(stored)


def test_figures_of_another_truth_are_measured_again(stored_capture: Path, tmp_path: Path) -> None:
    stored = MaterialTrial(Trial(stored_capture, "instant", 0, tmp_path / "out"), true_mesh=True)
    assert read_figures(stored) is not None
    (stored_capture / "truth" / "texture.png").write_bytes(b"another")
    assert read_figures(stored) is None


@pytest.mark.parametrize(("stale", "is_run"), [("texture", False), ("mesh", True)])
def test_a_run_that_is_finished_up_to_the_mesh_is_measured_as_it_is(
    monkeypatch: pytest.MonkeyPatch, stale: str, is_run: bool
) -> None:
    started = []
    states = {name: "stale" if name == stale else "fresh" for name in stages.STAGES}
    monkeypatch.setattr("data_tools.sweep.materials.read_trial", lambda _: RunState(states, {}, {}, "it broke"))
    monkeypatch.setattr("data_tools.sweep.materials.run_trial", lambda *_: started.append(True))
    if is_run:
        with pytest.raises(UserError, match="ann-instant-0 is failed"):
            finish_run(trial(), [trial()])
    else:
        finish_run(trial(), [trial()])
    finish_run(trial(true_mesh=True), [])
    assert bool(started) == is_run


@pytest.fixture
def stored_capture(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A capture with stored figures of the true mesh in `out`, beside a docs folder."""
    monkeypatch.chdir(tmp_path)
    capture = tmp_path / "ann"
    (capture / "truth").mkdir(parents=True)
    stored = MaterialTrial(Trial(capture, "instant", 0, tmp_path / "out"), true_mesh=True)
    stored.path.parent.mkdir(parents=True)
    stored.path.write_text(json.dumps(measured(FIGURES) | {"inputs": stored.inputs_digest()}))
    DOCUMENT.parent.mkdir()
    return capture


def write_table(capture: Path, table: str) -> str:
    """Write stored figures into a document with a table, and return the document."""
    DOCUMENT.write_text(f"<!-- figures: presets -->\nold\n{END}\n<!-- figures: materials -->\n{table}\n{END}\n")
    main([str(capture), "--out", "out", "--write-only"])
    return DOCUMENT.read_text()


def test_stored_figures_are_written_into_the_document(stored_capture: Path) -> None:
    """Other tables stay; nothing is measured."""
    text = write_table(stored_capture, "")
    assert text.startswith(f"<!-- figures: presets -->\nold\n{END}\n")
    assert "| ann | true | 0 | 10.0 | 40 |" in text
    assert "Last measured on Xeon" in text
    with pytest.raises(UserError, match="no figures"):
        main([str(stored_capture), "--out", "elsewhere", "--write-only"])


def test_rows_that_are_not_measured_stay_and_others_are_replaced_in_place(stored_capture: Path) -> None:
    rest = f"{'| 1.0 ' * (len(TABLE_HEAD[0].split('|')) - 5)}|"
    kept = [f"| ann | run | 0 1 {rest}", f"| bob | true | 0 {rest}"]
    old = [*TABLE_HEAD, kept[0], f"| ann | true | 0 {rest}", kept[1]]
    rows = [line for line in write_table(stored_capture, "\n".join(old)).splitlines() if line.startswith("|")]
    assert rows[:2] == list(TABLE_HEAD)
    assert rows[2].startswith("| ann | true | 0 | 10.0 | 40 |")
    assert rows[3:] == kept


def test_a_table_with_other_columns_is_not_overwritten(stored_capture: Path) -> None:
    with pytest.raises(UserError, match="other columns"):
        write_table(stored_capture, "| capture | mesh |\n|---|---|\n| ann | run |")


def test_a_video_without_truth_is_refused(tmp_path: Path) -> None:
    with pytest.raises(UserError, match="no synthetic capture"):
        main([str(tmp_path / "me.mp4")])


def test_tables_of_other_commands_stay() -> None:
    text = f"<!-- figures: materials -->\nold\n{END}"
    assert insert_tables(text, {"presets": ""}, Path("README.md"), ("materials",)) == text
