"""Compile options of all numba kernels, and the folder of the compilation cache."""

import hashlib
import os
import tempfile
from collections.abc import Iterable
from pathlib import Path
from typing import Any

from numba import config
from numba.core.registry import cpu_target
from numba.misc.appdirs import AppDirs

NJIT_OPTIONS: dict[str, Any] = {"cache": True, "nogil": True, "error_model": "numpy", "fastmath": {"arcp", "nsz"}}
"""Arguments of `numba.njit`. The fast-math flags exclude fusing and reordering of sums: how the compiler uses that
freedom depends on the functions it compiles together, so a first process and a later one, which loads a part from the
cache, would give different results (docs/decisions/engineering.md).
"""

KERNELS_FOLDER = Path(__file__).resolve().parents[1]
COMPILED_SOURCES = (
    *sorted(KERNELS_FOLDER.glob("*/*cpu.py")),
    KERNELS_FOLDER / "common" / "hashing.py",
    Path(__file__),
)
"""Source files of all compiled functions and of the constants in them."""


def cache_folder(sources: Iterable[Path]) -> Path:
    """Return numba's cache folder, one for each state of the sources and of the compiler flags.

    numba itself checks only the file of a function for changes, not the files of the functions and constants that are
    compiled into it, and not the flags. The parent folder is NUMBA_CACHE_DIR; without it `__pycache__` next to the
    sources, or where these are read-only the user's cache folder, or a temporary one where there is no home either.
    """
    compiler_flags = f"{config.OPT} {config.LOOP_VECTORIZE} {config.SLP_VECTORIZE}"
    digest = hashlib.sha256(compiler_flags.encode())
    for path in sources:
        digest.update(path.read_bytes())
    return _parent_folder() / f"kernels-{digest.hexdigest()[:16]}"


def _parent_folder() -> Path:
    if config.CACHE_DIR:
        return Path(config.CACHE_DIR)
    if os.access(KERNELS_FOLDER, os.W_OK):
        return KERNELS_FOLDER / "__pycache__"
    of_user = Path(AppDirs("numba", False).user_cache_dir)
    try:
        of_user.mkdir(parents=True, exist_ok=True)
    except OSError:
        return Path(tempfile.gettempdir()) / f"numba-{os.getuid() if hasattr(os, 'getuid') else 'user'}"
    return of_user


# If numba was imported before this package, it read the environment before the package set its variables.
config.reload_config()
CACHE_FOLDER = cache_folder(COMPILED_SOURCES)
config.CACHE_DIR = str(CACHE_FOLDER)

CUDA_SOURCES = (*COMPILED_SOURCES, *sorted(KERNELS_FOLDER.glob("*/cuda.py")))
CUDA_CACHE_FOLDER = cache_folder(CUDA_SOURCES)

# What numba itself is made of it loads at the first call of a function, in 0.4 s. Loaded here, the processes that a
# command forks have it already.
cpu_target.target_context.refresh()
