"""Which files a request writes, and what a missing package means."""

import importlib.util
from pathlib import Path

import pytest

from pipeline.avatar.formats.vrm import VrmMeta
from pipeline.avatar.formats.write import PACKAGES, FormatRequest, missing_package, write_formats
from tests.avatar.formats.anny_avatar import anny_body, anny_glb

FILES = {
    "lod": ["avatar_lod1.glb", "avatar_lod2.glb"],
    "usdz": ["avatar.usdz"],
    "vrm": ["avatar.vrm"],
    "vrm0": ["avatar_vrm0.vrm"],
    "web": ["avatar_web.glb"],
}


@pytest.mark.parametrize("name", FILES)
def test_a_format_writes_its_files_and_leaves_the_glb(name: str, tmp_path: Path) -> None:
    if missing_package([name]):
        pytest.skip(f"make venv EXTRA={name}")
    glb = anny_glb(tmp_path)
    before = glb.path.read_bytes()
    write_formats(glb.path, FormatRequest([name], anny_body().joint_names, VrmMeta("avatar", "unknown", "")))
    assert sorted(path.name for path in tmp_path.iterdir()) == sorted(["avatar.glb", *FILES[name]])
    assert glb.path.read_bytes() == before


def test_no_format_writes_no_file(tmp_path: Path) -> None:
    glb = anny_glb(tmp_path)
    write_formats(glb.path, FormatRequest([], anny_body().joint_names, VrmMeta("avatar", "unknown", "")))
    assert [path.name for path in tmp_path.iterdir()] == ["avatar.glb"]


@pytest.mark.parametrize("name", PACKAGES)
def test_a_missing_package_is_named_with_the_command(name: str, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("pipeline.avatar.formats.write.find_spec", lambda module: None)
    assert missing_package(["vrm", "lod"]) is None
    message = missing_package(["vrm", name])
    assert message
    assert f"make venv EXTRA={name}" in message
    assert f"pip install {PACKAGES[name][1]}" in message


def test_modules_of_installed_packages_are_found(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("pipeline.avatar.formats.write.find_spec", lambda module: importlib.util.find_spec("json"))
    assert missing_package(list(PACKAGES)) is None
