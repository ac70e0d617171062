"""One stage: fresh results are kept, unfinished ones removed, faults in the code of a stage are raised."""

import errno
import json
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

import pytest

from pipeline.core import stage as stage_module
from pipeline.core.config import Config
from pipeline.core.errors import UserError
from pipeline.core.manifest import MANIFEST_FILE, read_manifest
from pipeline.core.progress import warn
from pipeline.core.stage import Stage, StagePlan, discard_work_dir, plan_stage, run_stage

Work = Callable[[Mapping[str, Path], Path, Any], Mapping[str, float]]


class Options(Config):
    number: int = 1


def write_number(inputs: Mapping[str, Path], out: Path, config: Options) -> Mapping[str, float]:
    (out / "number.txt").write_text(str(config.number))
    return {"number": config.number, "loss": float("nan")}


def plan(tmp_path: Path, work: Work = write_number, number: int = 1, version: int = 1) -> StagePlan:
    """The plan of a stage `count` that reads a video and makes number.txt."""
    video = tmp_path / "video.txt"
    if not video.exists():
        video.write_text("frames")
    stage = Stage("count", version, ("video",), ("number.txt",), Options, work)
    return plan_stage(stage, Options(number=number), tmp_path / "run", video)


def names(tmp_path: Path) -> set[str]:
    return {path.name for path in (tmp_path / "run").iterdir()}


def test_a_result_is_made_once(tmp_path: Path) -> None:
    assert run_stage(plan(tmp_path))
    assert not run_stage(plan(tmp_path))
    assert names(tmp_path) == {"count"}
    assert {path.name for path in (tmp_path / "run" / "count").iterdir()} == {"number.txt", MANIFEST_FILE}


def test_manifest_records_the_run(tmp_path: Path) -> None:
    def work(inputs: Mapping[str, Path], out: Path, config: Options) -> Mapping[str, float]:
        warn("3 frames show nobody and are left out")
        return write_number(inputs, out, config)

    warn("printed before this stage")
    run_stage(plan(tmp_path, work, number=7))
    manifest = read_manifest(tmp_path / "run" / "count")
    assert manifest is not None
    assert manifest.config == {"number": 7}
    assert manifest.metrics == {"number": 7.0, "loss": None}
    assert manifest.warnings == ["3 frames show nobody and are left out"]
    assert manifest.peak_rss_mib > 1
    assert {"commit", "cpu", "packages", "gpu"} <= manifest.environment.keys()


@pytest.mark.parametrize("change", [{"number": 2}, {"version": 2}])
def test_config_and_version_make_it_stale(tmp_path: Path, change: dict[str, int]) -> None:
    run_stage(plan(tmp_path))
    assert run_stage(plan(tmp_path, **change))


def test_the_content_of_the_video_makes_it_stale(tmp_path: Path) -> None:
    run_stage(plan(tmp_path))
    (tmp_path / "video.txt").write_text("other frames")
    assert not plan(tmp_path).is_fresh()


def test_the_content_of_a_file_that_an_option_names_makes_it_stale(tmp_path: Path) -> None:
    class Named(Options):
        model_file: str | None = None

    stage = Stage("count", 1, (), ("number.txt",), Named, write_number)
    model = tmp_path / "model.npz"

    def runs(name: Path | None) -> bool:
        options = Named(model_file=None if name is None else str(name))
        return run_stage(plan_stage(stage, options, tmp_path / "run", None))

    assert runs(None)
    model.write_text("neutral")
    assert runs(model)
    assert not runs(model)
    model.write_text("female")
    assert runs(model)


def test_a_lost_file_makes_it_stale(tmp_path: Path) -> None:
    run_stage(plan(tmp_path))
    (tmp_path / "run" / "count" / "number.txt").unlink()
    assert run_stage(plan(tmp_path))


def test_force_runs_again(tmp_path: Path) -> None:
    run_stage(plan(tmp_path))
    assert run_stage(plan(tmp_path), force=True)


@pytest.mark.parametrize("fault", [UserError("no person"), OSError(errno.ENOSPC, "full"), MemoryError()])
def test_user_errors_leave_no_folder(tmp_path: Path, fault: Exception) -> None:
    def work(inputs: Mapping[str, Path], out: Path, config: Options) -> Mapping[str, float]:
        (out / "checkpoint.txt").write_text("half")
        raise fault

    with pytest.raises(type(fault)):
        run_stage(plan(tmp_path, work))
    assert names(tmp_path) == set()


def test_a_failure_leaves_the_older_result(tmp_path: Path) -> None:
    def work(inputs: Mapping[str, Path], out: Path, config: Options) -> Mapping[str, float]:
        raise UserError("no person")

    run_stage(plan(tmp_path))
    with pytest.raises(UserError):
        run_stage(plan(tmp_path, work, number=2))
    assert (tmp_path / "run" / "count" / "number.txt").read_text() == "1"


def interrupted(inputs: Mapping[str, Path], out: Path, config: Options) -> Mapping[str, float]:
    (out / "checkpoint.txt").write_text("half")
    (out / "checkpoints").mkdir()
    (out / "stray.txt").write_text("half")
    raise KeyboardInterrupt


def test_checkpoints_of_the_same_fingerprint_are_resumed(tmp_path: Path) -> None:
    seen: list[set[str]] = []

    def work(inputs: Mapping[str, Path], out: Path, config: Options) -> Mapping[str, float]:
        seen.append({path.name for path in out.iterdir() if not path.name.startswith(".")})
        return write_number(inputs, out, config)

    with pytest.raises(KeyboardInterrupt):
        run_stage(plan(tmp_path, interrupted))
    run_stage(plan(tmp_path, work))
    assert seen == [{"checkpoint.txt", "checkpoints"}]
    manifest = read_manifest(tmp_path / "run" / "count")
    assert manifest is not None
    assert manifest.resumed
    assert list(manifest.outputs) == ["number.txt"]


@pytest.mark.parametrize(("number", "force"), [(2, False), (1, True)])
def test_checkpoints_of_another_fingerprint_are_dropped(tmp_path: Path, number: int, force: bool) -> None:
    def work(inputs: Mapping[str, Path], out: Path, config: Options) -> Mapping[str, float]:
        assert not (out / "checkpoint.txt").exists()
        return write_number(inputs, out, config)

    with pytest.raises(KeyboardInterrupt):
        run_stage(plan(tmp_path, interrupted))
    assert run_stage(plan(tmp_path, work, number=number), force)


def test_a_kill_just_before_the_rename_costs_no_work(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def die(plan: StagePlan) -> None:
        raise KeyboardInterrupt

    def never(inputs: Mapping[str, Path], out: Path, config: Options) -> Mapping[str, float]:
        raise AssertionError("the work was done already")

    with monkeypatch.context() as patched:
        patched.setattr(stage_module, "_publish", die)
        with pytest.raises(KeyboardInterrupt):
            run_stage(plan(tmp_path))
    assert names(tmp_path) == {"count.part"}
    run_stage(plan(tmp_path, never))
    assert names(tmp_path) == {"count"}


@pytest.mark.parametrize("name", ["count", "count.old", "count.part"])
def test_what_no_stage_made_is_never_replaced(tmp_path: Path, name: str) -> None:
    own = tmp_path / "run" / name
    own.mkdir(parents=True)
    (own / "IMG_0001.png").write_text("mine")
    with pytest.raises(UserError, match=f"{name} was not made by this program"):
        run_stage(plan(tmp_path), force=True)
    assert (own / "IMG_0001.png").read_text() == "mine"
    (own / "IMG_0001.png").unlink()
    assert run_stage(plan(tmp_path))


def test_unfinished_work_is_removed_only_if_a_stage_made_it(tmp_path: Path) -> None:
    run_stage(plan(tmp_path))
    own = tmp_path / "run" / "count.part"
    own.mkdir()
    (own / "IMG_0001.png").write_text("mine")
    with pytest.raises(UserError, match="count.part was not made by this program"):
        discard_work_dir(plan(tmp_path))
    assert (own / "IMG_0001.png").read_text() == "mine"


def test_files_of_the_user_in_a_result_outlive_it(tmp_path: Path) -> None:
    run_stage(plan(tmp_path))
    folder = tmp_path / "run" / "count"
    (folder / "scenes").mkdir()
    (folder / "scenes" / "me.blend").write_text("mine")
    assert run_stage(plan(tmp_path, number=2))
    assert (folder / "number.txt").read_text() == "2"
    assert (folder / "scenes" / "me.blend").read_text() == "mine"
    assert names(tmp_path) == {"count"}


def test_a_kill_while_a_result_is_removed_leaves_what_the_next_run_can_remove(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def die(path: Path) -> None:
        if not path.exists():
            return
        assert path.name == "number.txt"
        path.unlink()
        raise KeyboardInterrupt

    run_stage(plan(tmp_path))
    with monkeypatch.context() as patched:
        patched.setattr(stage_module, "_remove", die)
        patched.setattr(stage_module, "_is_working_file", lambda name: False)
        with pytest.raises(KeyboardInterrupt):
            run_stage(plan(tmp_path, number=2))
    assert names(tmp_path) == {"count", "count.old"}
    run_stage(plan(tmp_path, number=2))
    assert names(tmp_path) == {"count"}


def test_a_missing_output_is_a_fault(tmp_path: Path) -> None:
    def work(inputs: Mapping[str, Path], out: Path, config: Options) -> Mapping[str, float]:
        (out / "number.txt").touch()
        return {}

    with pytest.raises(RuntimeError, match=r"did not make number\.txt"):
        run_stage(plan(tmp_path, work))


def test_more_than_declared_is_kept_and_digested(tmp_path: Path) -> None:
    def work(inputs: Mapping[str, Path], out: Path, config: Options) -> Mapping[str, float]:
        (out / "preview.png").write_text("pixels")
        return write_number(inputs, out, config)

    run_stage(plan(tmp_path, work))
    manifest = read_manifest(tmp_path / "run" / "count")
    assert manifest is not None
    assert list(manifest.outputs) == ["number.txt", "preview.png"]


def test_a_missing_input_names_the_command(tmp_path: Path) -> None:
    stage = Stage("paint", 1, ("count",), ("paint.txt",), Options, write_number)
    with pytest.raises(UserError, match=r"python -m stages count"):
        plan_stage(stage, Options(), tmp_path / "run", None)
    with pytest.raises(UserError, match="--video"):
        plan_stage(plan(tmp_path).stage, Options(), tmp_path / "run", None)


def test_equal_outputs_upstream_keep_downstream_fresh(tmp_path: Path) -> None:
    paint = Stage("paint", 1, ("count",), ("number.txt",), Options, write_number)
    run_stage(plan(tmp_path))
    run_stage(plan_stage(paint, Options(), tmp_path / "run", None))
    run_stage(plan(tmp_path, version=2))
    assert plan_stage(paint, Options(), tmp_path / "run", None).is_fresh()
    run_stage(plan(tmp_path, number=2))
    assert not plan_stage(paint, Options(), tmp_path / "run", None).is_fresh()


def test_manifests_hold_no_nan(tmp_path: Path) -> None:
    run_stage(plan(tmp_path))
    text = (tmp_path / "run" / "count" / MANIFEST_FILE).read_text()
    json.loads(text, parse_constant=lambda name: pytest.fail(f"{name} is no JSON"))
