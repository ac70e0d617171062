"""Memory that the C library keeps after it was freed."""

import ctypes
import sys


def trim_heap() -> None:
    """Return free memory to the system; for moments between large arrays. It takes 1 to 20 ms.

    glibc keeps freed blocks of up to 32 MB, and those of several threads apart: what passes through grows the process
    by a fifth. Other C libraries have no such call, and nothing happens.
    """
    if sys.platform == "linux":
        trim = getattr(ctypes.CDLL(None), "malloc_trim", None)
        if trim is not None:
            trim(0)
