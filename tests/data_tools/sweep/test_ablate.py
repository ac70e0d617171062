"""Ablation of stage two: settings of the rows, links to the shared stages, resuming, tables and errors."""

import csv
import json
from dataclasses import replace
from pathlib import Path

import pytest

from data_tools.sweep import ablate, ablation_trials
from data_tools.sweep.ablation_mesh import load_settings, plan_run_stage, save_settings
from data_tools.sweep.ablation_rows import REFERENCE, ROWS, row_settings
from data_tools.sweep.ablation_tables import (
    COLUMNS,
    capture_tables,
    difference_tables,
    format_differences,
    format_spread,
    markdown_table,
    write_tables,
)
from data_tools.sweep.ablation_trials import AblationResult, AblationTrial, link_folder, prepare_row, read_figures
from data_tools.sweep.chart_trials import Trial
from pipeline.core.errors import UserError
from pipeline.core.manifest import MANIFEST_FILE, Manifest, digest_files, read_manifest, write_manifest
from pipeline.core.record import read_record
from pipeline.mesh.settings import MeshSettings

CHAMFER = next(column for column in COLUMNS if column.figure == "chamfer_mm")
FACES = next(column for column in COLUMNS if column.figure == "faces")
BYTES = next(column for column in COLUMNS if column.figure == "glb_bytes")


def write_stage(run_dir: Path, name: str, metrics: dict[str, float | None], fingerprint: str = "print") -> None:
    folder = run_dir / name
    folder.mkdir(parents=True)
    (folder / "content").write_text(name)
    write_manifest(
        Manifest(name, 1, fingerprint, {}, {}, digest_files(folder), metrics, 7.5, 1.0), folder / MANIFEST_FILE
    )


@pytest.fixture
def base(tmp_path: Path) -> Trial:
    """A trial on a capture, with finished stages until the field."""
    (tmp_path / "ann").mkdir()
    trial = Trial(tmp_path / "ann", "default", 2, tmp_path / "out")
    for name in ("frames", "body", "field"):
        write_stage(trial.run_dir, name, {})
    return trial


def results(base: Trial, figures: dict[str, list[dict[str, float]]]) -> dict[AblationTrial, AblationResult]:
    """Finished trials by row; the list has one entry for each seed."""
    return {
        AblationTrial(replace(base, seed=seed), ROWS[row]): AblationResult(
            "done", values, "", "a" * 40, "Xeon, 2 cores"
        )
        for row, seeds in figures.items()
        for seed, values in enumerate(seeds)
    }


@pytest.mark.parametrize("name", [name for name, row in ROWS.items() if not row.from_reference])
def test_rows_differ_from_the_stage_in_what_they_name(name: str) -> None:
    row = ROWS[name]
    settings = MeshSettings(**row_settings(row, 3, {}))
    assert settings == replace(MeshSettings(), seed=3, **row.settings)
    assert (settings == MeshSettings(seed=3) and not row.options) == (name == REFERENCE)


@pytest.mark.parametrize(("name", "remeshed"), [("uniform", 22000), ("uniform-reduced", 41000)])
def test_uniform_rows_end_with_the_faces_of_the_reference(name: str, remeshed: int) -> None:
    metrics = {"faces": 22000.0, "faces_before_reduction": 41000.0}
    settings = MeshSettings(**row_settings(ROWS[name], 0, metrics))
    assert (settings.remeshing, settings.remeshed_faces, settings.final_faces) == ("uniform", remeshed, 22000)


def test_the_reference_is_made_before_a_row_that_needs_its_faces(base: Trial, monkeypatch: pytest.MonkeyPatch) -> None:
    made: list[tuple[str, str]] = []

    def make(run_dir: Path, name: str) -> None:
        made.append((run_dir.name, name))
        write_stage(run_dir, name, {"faces": 1200.0, "faces_before_reduction": 2000.0})

    monkeypatch.setattr(ablation_trials, "make_stage", make)
    trial = AblationTrial(base, ROWS["uniform"])
    prepare_row(trial)
    assert made == [("ann-default-2-error-driven", "mesh")]
    expected = {"seed": 2, "remeshing": "uniform", "remeshed_faces": 1200, "final_faces": 1200}
    assert load_settings(trial.run_dir) == expected


def test_rows_share_the_stages_before_the_mesh(base: Trial) -> None:
    trial = AblationTrial(base, ROWS["extracted"])
    prepare_row(trial)
    prepare_row(trial)  # an interrupted run continues
    for name in ("frames", "body", "field"):
        assert (trial.run_dir / name).resolve() == (base.run_dir / name).resolve()
        assert not (trial.run_dir / name).readlink().is_absolute()
    assert read_record(trial.run_dir).overrides == {"field.seed": "2", "mesh.rounds": 0}
    assert plan_run_stage(trial.run_dir, "mesh").config.model_dump()["rounds"] == 0


def test_folders_are_copied_where_links_are_impossible(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    write_stage(tmp_path, "field", {})

    def refuse(*_: object, **__: object) -> None:
        raise OSError("no right to make links")

    monkeypatch.setattr(Path, "symlink_to", refuse)
    link_folder(tmp_path / "field", tmp_path / "copy")
    assert not (tmp_path / "copy").is_symlink()
    assert (tmp_path / "copy" / "content").read_text() == "field"


def test_the_result_of_the_mesh_stage_depends_on_the_settings(base: Trial) -> None:
    prepare_row(trial := AblationTrial(base, ROWS[REFERENCE]))
    prints = []
    for settings in ({"seed": 2}, {"seed": 2, "field_views": 5}, {"seed": 2}):
        save_settings(trial.run_dir, settings)
        plan = plan_run_stage(trial.run_dir, "mesh")
        prints.append(plan.fingerprint)
        assert plan.stage.run.keywords == {"settings": MeshSettings(**settings)}
    assert prints[0] == prints[2] != prints[1]


def test_rows_that_differ_after_the_mesh_share_the_mesh_of_the_reference(
    base: Trial, monkeypatch: pytest.MonkeyPatch
) -> None:
    made: list[str] = []

    def make_mesh(run_dir: Path, name: str) -> None:
        made.append(f"{run_dir.name} {name}")
        write_stage(run_dir, name, {})

    monkeypatch.setattr(ablation_trials, "make_stage", make_mesh)
    prepare_row(trial := AblationTrial(base, ROWS["texels-512"]))
    assert made == ["ann-default-2-error-driven mesh"]
    assert (trial.run_dir / "mesh").resolve() == trial.run_dir.with_name("ann-default-2-error-driven") / "mesh"
    assert load_settings(trial.run_dir) == {"seed": 2}
    assert {name for name, row in ROWS.items() if row.has_mesh_of_reference} == {
        "texels-512",
        "texels-1024",
        "texels-2048",
    }


@pytest.mark.slow
def test_a_failed_stage_names_its_message_and_log(base: Trial) -> None:
    """The texture stage refuses inputs without a fitted body."""
    prepare_row(trial := AblationTrial(base, ROWS[REFERENCE]))
    write_stage(trial.run_dir, "mesh", {})
    with pytest.raises(
        UserError, match=r"ann-default-2-error-driven, texture: .*see .*ann-default-2-error-driven\.log"
    ):
        ablation_trials.make_stage(trial.run_dir, "texture")


def test_unfinished_and_failed_trials_have_no_figures(base: Trial) -> None:
    trial = AblationTrial(base, ROWS[REFERENCE])
    assert ablation_trials.read_row(trial) == AblationResult("unfinished", {})
    prepare_row(trial)
    trial.run_dir.with_name(f"{trial.run_dir.name}.log").write_text("error: no light\n")
    assert ablation_trials.read_row(trial) == AblationResult("failed", {}, "no light")


def test_figures_are_read_from_report_truth_and_manifest(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    report = {
        "heldout": {"mesh": {"psnr_full": 33.0, "psnr_body": None}},
        "mesh": {"faces": 9},
        "export": {"glb_bytes": 5},
    }
    truth = {"mesh_matched": {"chamfer_mm": 2.5, "normal_angle_deg": 10.0}, "images": {}}
    (tmp_path / "report").mkdir()
    (tmp_path / "report" / "report.json").write_text(json.dumps(report))
    monkeypatch.setattr(ablation_trials, "load_comparison_scores", lambda _: truth)
    write_stage(tmp_path, "mesh", {"accepted_rounds": 2.0, "faces_before_reduction": 12.0})
    manifest = read_manifest(tmp_path / "mesh")
    assert manifest
    assert read_figures(tmp_path, manifest) == {
        "psnr_full_db": 33.0,
        "chamfer_mm": 2.5,
        "normal_angle_deg": 10.0,
        "faces": 9.0,
        "faces_before_reduction": 12.0,
        "glb_bytes": 5.0,
        "rounds_kept": 2.0,
        "mesh_seconds": 7.5,
    }


def test_cells_have_mean_and_spread_over_the_seeds() -> None:
    assert format_spread([], CHAMFER) == ""
    assert format_spread([2.5], CHAMFER) == "2.50"
    assert format_spread([1.0, 2.0, 3.0], CHAMFER) == "2.00 ± 1.00"
    assert format_spread([2_200_000.0, 2_200_000.0], BYTES) == "2,200 ± 0"


def test_differences_are_those_of_the_same_capture_and_seed(base: Trial) -> None:
    """The seeds differ by far more than the rows; only pairs show that the row is always worse."""
    runs = results(
        base,
        {
            "uniform": [{"chamfer_mm": 2.25}, {"chamfer_mm": 5.5}, {"chamfer_mm": 9.75}],
            REFERENCE: [{"chamfer_mm": 2.0}, {"chamfer_mm": 5.0}, {"chamfer_mm": 9.0}],
            "extracted": [{"faces": 1.0}],
        },
    )
    ((title, headings, rows),) = difference_tables(runs)
    assert "`error-driven`" in title
    cells = {row[0]: dict(zip(headings, row, strict=True)) for row in rows}
    assert cells["`uniform`"][CHAMFER.heading] == "+0.50 (+0.25 to +0.75)"
    assert cells["`uniform`"]["pairs"] == "3"
    assert cells["`extracted`"][CHAMFER.heading] == ""
    assert f"`{REFERENCE}`" not in cells
    assert format_differences([({"faces": 900.0}, {"faces": 2100.0})], FACES) == "-1,200"


def test_without_the_reference_there_are_no_differences(base: Trial) -> None:
    assert difference_tables(results(base, {"uniform": [{"faces": 1.0}]})) == []


def test_each_capture_has_a_table_with_the_rows_in_order(base: Trial) -> None:
    runs = results(base, {REFERENCE: [{"faces": 10.0}], "extracted": [{"faces": 20.0}, {"faces": 30.0}]})
    runs |= results(replace(base, capture=base.capture.with_name("bob.mp4")), {REFERENCE: [{}]})
    first, second = capture_tables(runs)
    assert [row[0] for row in first[2]] == ["`extracted`", f"`{REFERENCE}`"]
    assert "seeds 0, 1" in first[0]
    text = markdown_table(first).splitlines()
    assert text[2].startswith("| row | held-out PSNR, dB |")
    assert "| `extracted` |  |  |  |  |  | 25 ± 7 |" in text[4]
    assert second[2] == [[f"`{REFERENCE}`", *[""] * len(COLUMNS)]]


def test_tables_are_written_with_commit_machine_and_command(base: Trial) -> None:
    runs = results(base, {REFERENCE: [{"faces": 10.0}]})
    runs[AblationTrial(base, ROWS["uniform"])] = AblationResult("failed", {}, "no light")
    write_tables(base.out, runs, "make ablate SEEDS='0'")
    with (base.out / "ablation.csv").open(newline="") as file:
        rows = list(csv.DictReader(file))
    assert [(row["row"], row["status"], row["faces"], row["message"]) for row in rows] == [
        (REFERENCE, "done", "10.0", ""),
        ("uniform", "failed", "", "no light"),
    ]
    text = (base.out / "ablation.md").read_text()
    assert text.rstrip().endswith("Commit aaaaaaaaaa, Xeon, 2 cores; `make ablate SEEDS='0'`.")
    assert "uniform" not in text
    page = (base.out / "ablation.html").read_text()
    assert 'src="ann-default-0-error-driven/report/clay.jpg"' in page
    assert ROWS[REFERENCE].meaning in page


def test_the_command_runs_the_reference_first_and_names_unfinished_runs(
    base: Trial, monkeypatch: pytest.MonkeyPatch
) -> None:
    started: list[str] = []

    def run(trial: AblationTrial, _: object) -> AblationResult:
        started.append(trial.run_dir.name)
        done = trial.row.name == REFERENCE
        return AblationResult("done", {"faces": 8.0}) if done else AblationResult("failed", {}, "no light")

    monkeypatch.setattr(ablate, "run_row", run)
    arguments = [str(base.capture), "--rows", "uniform", REFERENCE, "--seeds", "0", "1", "--out", str(base.out)]
    with pytest.raises(UserError, match=r"2 of 4 runs are not done \(ann-default-0-uniform, ann-default-1-uniform\)"):
        ablate.main(arguments)
    assert started == [f"ann-default-{seed}-{row}" for seed in (0, 1) for row in (REFERENCE, "uniform")]
    command = f"make ablate CAPTURES='{base.capture}' ROWS='uniform error-driven' SEEDS='0 1'"
    assert command in (base.out / "ablation.md").read_text()


def test_write_only_runs_nothing(base: Trial, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(ablate, "run_row", lambda *_: pytest.fail("started"))
    with pytest.raises(UserError, match=f"{len(ROWS)} of {len(ROWS)} runs are not done"):
        ablate.main([str(base.capture), "--seeds", "2", "--out", str(base.out), "--write-only"])


def test_a_missing_capture_is_reported_before_any_run(tmp_path: Path) -> None:
    with pytest.raises(UserError, match=r"none\.mp4 does not exist"):
        ablate.main([str(tmp_path / "none.mp4"), "--out", str(tmp_path / "out")])
    assert not (tmp_path / "out").exists()
