"""Manifests and digests: what a fingerprint depends on, and how damage is found."""

import hashlib
import json
from dataclasses import replace
from pathlib import Path

import pytest

from pipeline.core.errors import UserError
from pipeline.core.manifest import (
    MANIFEST_FILE,
    PROGRESS_FILE,
    Manifest,
    digest_file,
    digest_files,
    digest_json,
    digest_video,
    find_damaged_files,
    fingerprint,
    list_files,
    read_manifest,
    require_matching_stages,
    write_manifest,
)

BASE = {"stage": "mesh", "version": 1, "config": {"size": 3, "kind": "a"}, "inputs": {"field": "0a"}}


def finished(folder: Path) -> Manifest:
    """Make a finished stage folder with two files."""
    (folder / "deep").mkdir(parents=True)
    (folder / "mesh.npz").write_bytes(b"vertices")
    (folder / "deep" / "a.png").write_bytes(b"pixels")
    manifest = Manifest(
        **BASE, fingerprint="f", outputs=digest_files(folder), metrics={}, seconds=1.0, peak_rss_mib=2.0
    )
    write_manifest(manifest, folder / MANIFEST_FILE)
    return manifest


def test_a_digest_is_sha256(tmp_path: Path) -> None:
    (tmp_path / "a").write_bytes(b"abc")
    assert digest_file(tmp_path / "a") == hashlib.sha256(b"abc").hexdigest()


def test_the_fingerprint_ignores_the_order_of_keys() -> None:
    reordered = {**BASE, "config": {"kind": "a", "size": 3}}
    assert fingerprint(**BASE) == fingerprint(**reordered)


@pytest.mark.parametrize(
    "change", [{"stage": "body"}, {"version": 2}, {"config": {"size": 4, "kind": "a"}}, {"inputs": {"field": "0b"}}]
)
def test_each_part_decides_the_fingerprint(change: dict[str, object]) -> None:
    assert fingerprint(**{**BASE, **change}) != fingerprint(**BASE)


def test_a_video_file_is_identified_by_its_content(tmp_path: Path) -> None:
    (tmp_path / "a.mp4").write_bytes(b"abc")
    (tmp_path / "b.mp4").write_bytes(b"abc")
    assert digest_video(tmp_path / "a.mp4") == digest_video(tmp_path / "b.mp4")


def test_a_video_folder_is_identified_by_names_and_contents(tmp_path: Path) -> None:
    (tmp_path / "0.png").write_bytes(b"abc")
    before = digest_video(tmp_path)
    (tmp_path / ".DS_Store").write_bytes(b"metadata of a file browser")
    assert digest_video(tmp_path) == before
    (tmp_path / "0.png").rename(tmp_path / "1.png")
    renamed = digest_video(tmp_path)
    (tmp_path / "1.png").write_bytes(b"abd")
    assert len({before, renamed, digest_video(tmp_path)}) == 3


def test_linked_folders_belong_to_a_video(tmp_path: Path) -> None:
    """Large data sets are linked, also twice; a link to a folder above is not followed."""
    video, data = tmp_path / "video", tmp_path / "data"
    video.mkdir()
    data.mkdir()
    (data / "0.png").write_bytes(b"abc")
    for name in ("images", "masks"):
        (video / name).symlink_to(data)
    (video / "loop").symlink_to(video)
    assert list_files(video) == ["images/0.png", "masks/0.png"]
    before = digest_video(video)
    (data / "0.png").write_bytes(b"abd")
    assert digest_video(video) != before


def test_a_missing_video_is_a_user_error(tmp_path: Path) -> None:
    with pytest.raises(UserError, match="--video"):
        digest_video(tmp_path / "none.mp4")


def test_a_manifest_reads_back(tmp_path: Path) -> None:
    manifest = finished(tmp_path / "mesh")
    assert read_manifest(tmp_path / "mesh") == manifest
    assert manifest.outputs_digest == digest_json(manifest.outputs)
    assert read_manifest(tmp_path / "nothing") is None


def test_nothing_depends_on_the_record_of_progress(tmp_path: Path) -> None:
    manifest = finished(tmp_path / "mesh")
    timed = replace(manifest, outputs=manifest.outputs | {PROGRESS_FILE: "0" * 64})
    assert timed.outputs_digest == manifest.outputs_digest


@pytest.mark.parametrize("text", ["", "{", "[]", '{"stage": "mesh"}', '{"unknown": 1}'])
def test_a_damaged_manifest_is_a_user_error(tmp_path: Path, text: str) -> None:
    (tmp_path / MANIFEST_FILE).write_text(text)
    with pytest.raises(UserError, match="damaged"):
        read_manifest(tmp_path)


def test_damage_is_found(tmp_path: Path) -> None:
    folder = tmp_path / "mesh"
    finished(folder)
    assert find_damaged_files(folder) == []
    (folder / "mesh.npz").write_bytes(b"verticeS")
    assert find_damaged_files(folder) == ["mesh.npz"]
    (folder / "deep" / "a.png").unlink()
    (folder / "new.txt").write_text("of the user")
    assert find_damaged_files(folder) == ["deep/a.png", "mesh.npz"]  # a user's file is no damage
    (folder / MANIFEST_FILE).unlink()
    assert find_damaged_files(folder) == [MANIFEST_FILE]


def test_a_manifest_is_strict_json(tmp_path: Path) -> None:
    finished(tmp_path / "mesh")
    values = json.loads((tmp_path / "mesh" / MANIFEST_FILE).read_text())
    assert {"stage", "version", "fingerprint", "config", "inputs", "outputs", "metrics", "seconds"} <= values.keys()


def write_stage(run: Path, name: str, content: bytes, **inputs: str) -> Manifest:
    """Write a finished stage with one file; inputs: digest by name."""
    (run / name).mkdir(parents=True, exist_ok=True)
    (run / name / "result").write_bytes(content)
    manifest = Manifest(name, 1, "", {}, inputs, digest_files(run / name), {}, 1.0, 2.0)
    write_manifest(manifest, run / name / MANIFEST_FILE)
    return manifest


def test_stages_that_do_not_belong_together_are_named(tmp_path: Path) -> None:
    """The fingerprint does not count: only what the later stage has read, and what is there now."""
    mesh = write_stage(tmp_path, "mesh", b"vertices", video="0a", model_file="0b")
    write_stage(tmp_path, "texture", b"pixels", mesh=mesh.outputs_digest, frames="not finished")
    require_matching_stages(tmp_path, ["frames", "mesh", "texture"])
    write_stage(tmp_path, "mesh", b"other vertices")
    with pytest.raises(UserError, match=r"another result of mesh than .*/mesh holds now; .* --run "):
        require_matching_stages(tmp_path, ["frames", "mesh", "texture"])
    require_matching_stages(tmp_path, ["frames", "mesh"])
    require_matching_stages(tmp_path, ["frames", "texture"])
