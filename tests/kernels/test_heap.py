"""Freed memory goes back to the system."""

import re
import sys
from pathlib import Path

import numpy as np
import pytest

from pipeline.kernels.common.heap import trim_heap

MIB_OF_BLOCKS = 100


def resident_mib() -> float:
    found = re.search(r"VmRSS:\s+(\d+) kB", Path("/proc/self/status").read_text())
    assert found is not None
    return int(found.group(1)) / 1024


@pytest.mark.skipif(sys.platform != "linux", reason="the size of the process is read from /proc")
def test_freed_blocks_are_returned() -> None:
    np.ones(30 << 17)  # 30 MiB: after it is freed, glibc takes blocks of up to this size from its heap
    blocks = [np.ones(1 << 16) for _ in range(2 * MIB_OF_BLOCKS)]
    last = blocks.pop()
    held_mib = resident_mib()
    blocks.clear()  # `last` lies above them, so that they stay
    trim_heap()
    assert resident_mib() < held_mib - 0.8 * MIB_OF_BLOCKS
    assert last.sum() == len(last)
