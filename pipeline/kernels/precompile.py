"""Compile what a run needs before the stages call it, beside the first run on a machine; later runs read the cache."""

import numba
from numba.core.registry import cpu_target

from pipeline.kernels.common.numba_options import CACHE_FOLDER

MARKER = "complete"


def is_prepared() -> bool:
    """Return whether `prepare` was done with these sources, this compiler and this processor."""
    marker = CACHE_FOLDER / MARKER
    return marker.is_file() and marker.read_text(encoding="utf-8") == _compiler()


def prepare() -> None:
    """Compile the functions of `SIGNATURES` in their order."""
    from pipeline.kernels.signatures import SIGNATURES  # imports all compiled loops, which `is_prepared` does not need

    for function, arguments in SIGNATURES:
        function.compile(arguments)
    CACHE_FOLDER.mkdir(parents=True, exist_ok=True)
    (CACHE_FOLDER / MARKER).write_text(_compiler(), encoding="utf-8")


def _compiler() -> str:
    processor = cpu_target.target_context.codegen().magic_tuple()
    return f"numba {numba.__version__} for {' '.join(processor)}"
