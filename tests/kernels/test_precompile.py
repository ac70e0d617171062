"""What is compiled beside the first run: what the stages call, and nothing else."""

import json
import shutil
import subprocess
import sys
from pathlib import Path
from types import SimpleNamespace

import numba
import pytest

from pipeline.core.measure import REPOSITORY_DIR
from pipeline.kernels import precompile, precompile_cuda
from pipeline.kernels.signatures import SIGNATURES

CALLED = """
import json, sys
from numba.core.dispatcher import Dispatcher
from pipeline.core.cli import main_pipeline
from stages import PIPELINE

assert main_pipeline(PIPELINE, ["--run", sys.argv[1], "--from", "body"], isolate=False) == 0
called = {
    f"{name}.{key}": [str(types) for types in function.signatures]
    for name, module in sys.modules.items() if name.startswith("pipeline.kernels")
    for key, function in vars(module).items()
    if isinstance(function, Dispatcher) and function.py_func.__module__ == name and function.signatures
}
json.dump(called, sys.stdout)
"""


def test_prepared_when_done_with_this_compiler(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    compiled = []

    class Function:
        def compile(self, arguments: tuple[object, ...]) -> None:
            compiled.append(arguments)

    monkeypatch.setattr(precompile, "CACHE_FOLDER", tmp_path / "cache")
    monkeypatch.setattr("pipeline.kernels.signatures.SIGNATURES", ((Function(), (1, 2)), (Function(), (3,))))
    assert not precompile.is_prepared()
    precompile.prepare()
    assert compiled == [(1, 2), (3,)]
    assert precompile.is_prepared()
    monkeypatch.setattr(precompile, "_compiler", lambda: "numba 99 for another processor")
    assert not precompile.is_prepared()


def test_without_numba_cuda_nothing_is_prepared(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(precompile_cuda, "CUDA_CACHE_FOLDER", tmp_path / "cache")
    monkeypatch.setattr(precompile_cuda, "has_numba_cuda", lambda: False)
    assert precompile_cuda.is_prepared()


@pytest.mark.parametrize("has_gpu", [True, False])
def test_cuda_kernels_are_compiled_where_there_is_a_gpu(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, has_gpu: bool
) -> None:
    compiled = []
    kernel = SimpleNamespace(compile=compiled.append)
    monkeypatch.setattr(precompile_cuda, "CUDA_CACHE_FOLDER", tmp_path / "cache")
    monkeypatch.setattr(precompile_cuda, "has_numba_cuda", lambda: True)
    monkeypatch.setattr("torch.cuda.is_available", lambda: has_gpu)
    monkeypatch.setattr("pipeline.kernels.cuda_signatures.SIGNATURES", ((kernel, (1, 2)), (kernel, (3,))))
    assert not precompile_cuda.is_prepared()
    precompile_cuda.prepare()
    assert compiled == ([(1, 2), (3,)] if has_gpu else [])
    assert precompile_cuda.is_prepared()


def test_the_marker_is_in_the_folder_of_the_cache() -> None:
    assert Path(numba.config.CACHE_DIR) == precompile.CACHE_FOLDER


def test_every_function_is_cached_and_listed_once() -> None:
    listed = [(function.py_func, arguments) for function, arguments in SIGNATURES]
    assert len(set(listed)) == len(listed)
    for function, _ in SIGNATURES:
        assert Path(function.py_func.__code__.co_filename).name.endswith("cpu.py")
        assert function.targetoptions["nopython"]


@pytest.mark.slow
def test_the_signatures_are_those_that_the_stages_call(smoke_run: Path, tmp_path: Path) -> None:
    """The kernels are in the cache, so a process knows the signatures that Python calls, and no others."""
    shutil.copytree(smoke_run, tmp_path / "run")
    command = [sys.executable, "-c", CALLED, str(tmp_path / "run")]
    done = subprocess.run(command, cwd=REPOSITORY_DIR, capture_output=True, text=True, check=True)
    called = {name: set(types) for name, types in json.loads(done.stdout.splitlines()[-1]).items()}
    listed: dict[str, set[str]] = {}
    for function, arguments in SIGNATURES:
        name = f"{function.py_func.__module__}.{function.py_func.__name__}"
        listed.setdefault(name, set()).add(str(tuple(arguments)))
    assert called == listed
