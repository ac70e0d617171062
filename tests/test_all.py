"""The whole pipeline: a small generated capture becomes a rigged avatar with a report."""

import json
import re
import struct
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

from pipeline.core.cli import main_pipeline
from pipeline.core.manifest import PROGRESS_FILE, digest_video, find_damaged_files, read_manifest
from pipeline.core.measure import REPOSITORY_DIR
from pipeline.io.image import read_rgb
from stages import PIPELINE, STAGES, load_stage
from tests.core.toy_pipeline import user_environment

GLB_MAGIC, GLB_VERSION, JSON_CHUNK = 0x46546C67, 2, 0x4E4F534A


@pytest.fixture(scope="session")
def report(smoke_run: Path) -> dict[str, dict[str, float]]:
    values: dict[str, dict[str, float]] = json.loads((smoke_run / "report" / "report.json").read_text())
    return values


def command(*arguments: str) -> str:
    """Standard output of `python -m stages <arguments>`, which must succeed."""
    whole = [sys.executable, "-m", "stages", *arguments]
    done = subprocess.run(
        whole, cwd=REPOSITORY_DIR, env=user_environment(), capture_output=True, text=True, check=False
    )
    assert done.returncode == 0, done.stderr
    return done.stdout


def test_every_artifact_is_intact(smoke_run: Path) -> None:
    for name in STAGES:
        assert find_damaged_files(smoke_run / name) == []
        assert all((smoke_run / name / made).exists() for made in load_stage(name).makes)
    assert not list(smoke_run.glob("*.part"))


def test_the_manifests_name_what_they_read(smoke_run: Path) -> None:
    for name in STAGES:
        manifest = read_manifest(smoke_run / name)
        assert manifest is not None
        for need in manifest.inputs:
            source = read_manifest(smoke_run / need) if need != "video" else None
            digest = source.outputs_digest if source else digest_video(smoke_run.parent / "capture" / "video")
            assert manifest.inputs[need] == digest, f"{name} read another {need} than the present one"


def test_all_stages_are_fresh(smoke_run: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert main_pipeline(PIPELINE, ["--run", str(smoke_run), "--status"]) == 0
    lines = capsys.readouterr().out.splitlines()
    assert [line.split()[:2] for line in lines] == [[name, "fresh"] for name in STAGES]


def test_the_report_keeps_its_contract(report: dict[str, dict[str, float]]) -> None:
    assert {*STAGES, "total"} <= report["seconds"].keys()
    assert {*STAGES} <= report["peak_rss_mib"].keys()
    assert all(seconds > 0 for seconds in report["seconds"].values())
    for renderer in ("field", "mesh"):
        scores = report["heldout"][renderer]
        assert {"psnr_full", "psnr_body", "ssim_full"} <= scores.keys()  # type: ignore[attr-defined]
    assert isinstance(report["heldout"]["protocol"], str)
    assert {"vertices", "faces", "watertight", "manifold", "components"} <= report["mesh"].keys()
    assert {"glb_bytes", "texture_px"} <= report["export"].keys()
    assert {"landmark_error_px", "silhouette_iou"} <= report["body"].keys()
    assert report["masks"]["count"] > 0


def test_the_avatar_is_watertight_and_close_to_the_person(report: dict[str, dict[str, float]]) -> None:
    """Bounds that the few steps of the smoke preset keep by a wide margin."""
    assert report["mesh"]["watertight"] is True
    assert report["mesh"]["manifold"] is True
    assert report["mesh"]["components"] == 1
    assert report["body"]["silhouette_iou"] > 0.8
    assert report["heldout"]["mesh"]["psnr_full"] > 17.0  # type: ignore[index]


def test_held_out_frames_are_those_divisible_by_eight(smoke_run: Path) -> None:
    with np.load(smoke_run / "frames" / "frames.npz") as frames:
        index, split = frames["frame_index"], frames["split"]
    assert ((index % 8 == 0) == (split == 2)).all()
    assert ((index % 8 == 4) == (split == 1)).all()


def test_the_glb_holds_a_skinned_animated_avatar(smoke_run: Path) -> None:
    data = (smoke_run / "export" / "avatar.glb").read_bytes()
    magic, version, length, json_length, kind = struct.unpack_from("<5I", data)
    assert (magic, version, length, kind) == (GLB_MAGIC, GLB_VERSION, len(data), JSON_CHUNK)
    scene = json.loads(data[20 : 20 + json_length])
    assert len(scene["skins"]) == len(scene["meshes"]) == 1
    assert [animation["name"] for animation in scene["animations"]] == ["capture", "idle"]
    assert {"POSITION", "NORMAL", "TEXCOORD_0", "JOINTS_0", "WEIGHTS_0"} <= scene["meshes"][0]["primitives"][0][
        "attributes"
    ].keys()


def test_the_page_loads_no_other_files(smoke_run: Path) -> None:
    page = (smoke_run / "report" / "index.html").read_text(encoding="utf-8")
    loaded = re.findall(r"""(?:src|href)\s*=\s*["'](?!data:|#)([^"']+)["']""", page)
    assert loaded == []


def test_the_images_are_not_blank(smoke_run: Path) -> None:
    for name in ("body/overlay.png", "report/turntable.jpg", "texture/diffuse.png"):
        assert read_rgb(smoke_run / name).std() > 5, f"{name} is blank"


@pytest.mark.slow
def test_a_changed_option_reruns_only_what_reads_it(smoke_run: Path, tmp_path: Path) -> None:
    copy = tmp_path / "run"
    subprocess.run(["cp", "-r", str(smoke_run), str(copy)], check=True)
    table = command("--run", str(copy), "--set", "export.roughness=0.5")
    states = [line.split()[1] for line in table.splitlines() if line.split()[0] in STAGES]
    assert states == ["cached"] * 5 + ["run"] * 2


@pytest.mark.slow
def test_the_same_seed_makes_the_same_bytes(command_run: Path, tmp_path: Path) -> None:
    video = command_run.parent / "capture" / "video"
    command("--run", str(tmp_path / "again"), "--preset", "smoke", "--video", str(video))
    for name in STAGES[:-1]:
        first, again = read_manifest(command_run / name), read_manifest(tmp_path / "again" / name)
        assert first is not None
        assert again is not None
        timed = {PROGRESS_FILE: ""}
        assert first.outputs | timed == again.outputs | timed, name


@pytest.mark.slow
def test_make_all_runs_a_video(smoke_run: Path, tmp_path: Path) -> None:
    video = smoke_run.parent / "capture" / "video"
    arguments = [f"VIDEO={video}", f"RUN={tmp_path / 'made'}", "PRESET=smoke"]
    done = subprocess.run(
        ["make", "all", *arguments],
        cwd=REPOSITORY_DIR,
        env=user_environment(),
        capture_output=True,
        text=True,
        check=False,
    )
    assert done.returncode == 0, done.stderr
    assert (tmp_path / "made" / "export" / "avatar.glb").is_file()
