"""How every loop is compiled, and where what was compiled is kept."""

import hashlib
import os
from pathlib import Path
from typing import Any

from numba import config
from numba.misc.appdirs import AppDirs

NJIT_OPTIONS: dict[str, Any] = {"cache": True, "nogil": True, "error_model": "numpy", "fastmath": {"arcp", "nsz"}}
"""Arguments of numba's njit. Of fast math only what neither fuses nor reorders sums: what the compiler makes of that
freedom depends on what it compiles together, so a first run and a later one would differ (docs/decisions.md).
"""

KERNELS = Path(__file__).resolve().parents[1]
COMPILED_SOURCES = (*sorted(KERNELS.glob("*/*cpu.py")), KERNELS / "common" / "hashing.py", Path(__file__))
"""Files that compiled loops are made of."""


def cache_folder() -> Path:
    """Where numba keeps compiled loops: a folder for each state of `COMPILED_SOURCES` and of the optimiser's switches.

    numba itself asks only whether the file of a function has changed, not those of the functions and constants that
    are compiled into it, nor how they were optimised. The folder lies where NUMBA_CACHE_DIR says, else beside the
    sources, else, where these are read-only, in the user's cache.
    """
    compiler_flags = f"{config.OPT} {config.LOOP_VECTORIZE} {config.SLP_VECTORIZE}"
    digest = hashlib.sha256(compiler_flags.encode())
    for path in COMPILED_SOURCES:
        digest.update(path.read_bytes())
    default_folder = KERNELS / "__pycache__" if os.access(KERNELS, os.W_OK) else AppDirs("numba", False).user_cache_dir
    return Path(config.CACHE_DIR or default_folder) / f"kernels-{digest.hexdigest()[:16]}"


# Whoever imported numba before this package has it read the environment too early for what the package sets in it.
config.reload_config()
config.CACHE_DIR = str(cache_folder())
