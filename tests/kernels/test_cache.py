"""Compilation cache: a second process finds it, and a process whose compiled loops would differ does not.

Each process imports a copy of the kernels, so that a test can change a file between two processes.
"""

import ast
import json
import os
import shutil
import subprocess
import sys
from pathlib import Path

import pytest

from pipeline.kernels.common.numba_options import COMPILED_SOURCES

HASH_ROWS_SCRIPT = """
import json
import numpy as np
from numba import config
from pipeline.kernels.hashgrid.cpu import CornerBuffers, _fill_corners

point, rows = np.full((1, 3), 0.3, np.float32), np.zeros((8, 1), np.uint32)
hashed_level = np.array([40, 40, 40, 0, 1 << 20, 0])
buffers = CornerBuffers(rows, np.zeros((8, 1), np.float32), np.zeros((3, 1), np.float32))
_fill_corners(point, 0, 1, hashed_level, buffers)
cached, compiled = (sum(c.values()) for c in (_fill_corners.stats.cache_hits, _fill_corners.stats.cache_misses))
print(json.dumps({"rows": rows.tolist(), "cached": cached, "compiled": compiled, "slp": config.SLP_VECTORIZE}))
"""
CACHE_FOLDER_SCRIPT = "from numba import config; import pipeline.kernels.common.numba_options; print(config.CACHE_DIR)"


@pytest.fixture
def kernels(repository: Path, tmp_path: Path) -> Path:
    """A copy of the kernels that can be imported as `pipeline.kernels`."""
    copy = tmp_path / "code" / "pipeline" / "kernels"
    shutil.copytree(repository / "pipeline" / "kernels", copy, ignore=shutil.ignore_patterns("__pycache__"))
    shutil.copy(repository / "pipeline" / "__init__.py", copy.parent)
    # The compiled loops need numba alone; without the public operation a process starts without torch.
    (copy / "hashgrid" / "__init__.py").write_text("")
    return copy


def output(kernels: Path, code: str, **environment: str) -> str:
    """Standard output of Python code that imports these kernels."""
    plain = {name: value for name, value in os.environ.items() if not name.startswith("NUMBA_")}
    command, folder = [sys.executable, "-c", code], kernels.parents[1]
    done = subprocess.run(command, cwd=folder, env=plain | environment, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    return done.stdout.strip()


def test_second_process_uses_the_cache(kernels: Path) -> None:
    first, second = (json.loads(output(kernels, HASH_ROWS_SCRIPT)) for _ in range(2))
    assert (first["cached"], first["compiled"]) == (0, 1)
    assert (second["cached"], second["compiled"]) == (1, 0)
    assert second["rows"] == first["rows"]


@pytest.mark.slow
def test_changed_constant_in_another_file_invalidates_the_cache(kernels: Path) -> None:
    before = json.loads(output(kernels, HASH_ROWS_SCRIPT))
    (kernels / "common" / "hashing.py").write_text("PRIMES = (2654435769, 805459861)\n")
    after = json.loads(output(kernels, HASH_ROWS_SCRIPT))
    assert after["compiled"] == 1
    assert after["rows"] != before["rows"]


@pytest.mark.slow
def test_order_of_imports_has_no_effect(kernels: Path) -> None:
    """numba reads the environment at its import, which may be before the kernels set their variables."""
    late, early = (json.loads(output(kernels, f"import {first}\n{HASH_ROWS_SCRIPT}")) for first in ("numba", "json"))
    assert late["slp"] == early["slp"] == 1
    assert (early["cached"], early["compiled"]) == (1, 0)


@pytest.mark.slow
def test_cache_is_separate_without_slp_vectorisation(kernels: Path) -> None:
    output(kernels, HASH_ROWS_SCRIPT, NUMBA_SLP_VECTORIZE="0")
    assert json.loads(output(kernels, HASH_ROWS_SCRIPT))["compiled"] == 1


def test_cache_folder_is_default_or_user_supplied(kernels: Path, tmp_path: Path) -> None:
    default_folder = Path(output(kernels, CACHE_FOLDER_SCRIPT))
    assert default_folder.parent == kernels / "__pycache__"
    custom_folder = Path(output(kernels, CACHE_FOLDER_SCRIPT, NUMBA_CACHE_DIR=str(tmp_path / "custom_folder")))
    assert custom_folder == tmp_path / "custom_folder" / default_folder.name
    read_only = f"import os; os.access = lambda *_: False; {CACHE_FOLDER_SCRIPT}"
    assert Path(output(kernels, read_only, XDG_CACHE_HOME=str(tmp_path))).is_relative_to(tmp_path / "numba")
    homeless = output(kernels, read_only, XDG_CACHE_HOME="/dev/null/none", TMPDIR=str(tmp_path))
    assert Path(homeless).parent.name.startswith("numba-")
    assert Path(homeless).is_relative_to(tmp_path)


def test_cache_key_covers_all_imported_files(repository: Path) -> None:
    kernels = repository / "pipeline" / "kernels"
    covered_files = {".".join(path.relative_to(kernels).with_suffix("").parts) for path in COMPILED_SOURCES}
    for path in kernels.glob("*/*cpu.py"):
        imports = [node for node in ast.walk(ast.parse(path.read_text())) if isinstance(node, ast.ImportFrom)]
        modules = [node.module or "" for node in imports]
        ours = {name.removeprefix("pipeline.kernels.") for name in modules if name.startswith("pipeline")}
        assert ours <= covered_files, path
        assert ".".join(path.relative_to(kernels).with_suffix("").parts) in covered_files
