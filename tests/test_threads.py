"""Threads that importing the package allows to libraries that have pools of their own."""

import subprocess
import sys
from pathlib import Path

import pytest

THREADS = Path("/proc/self/task")
PRODUCTS = f"""
import pipeline, numpy, scipy.linalg
square = numpy.ones((700, 700))
square @ square
scipy.linalg.blas.dgemm(1.0, square, square)
print(len(list(__import__("pathlib").Path("{THREADS}").iterdir())))
"""


@pytest.mark.skipif(not THREADS.is_dir(), reason="threads of a process are listed by Linux only")
def test_products_of_matrices_stay_on_the_thread_that_asks_for_them(monkeypatch: pytest.MonkeyPatch) -> None:
    """The workers of a thread pool would wait for the one pool of the library otherwise."""
    for name in ("OPENBLAS_NUM_THREADS", "OMP_NUM_THREADS"):
        monkeypatch.delenv(name, raising=False)
    finished = subprocess.run([sys.executable, "-c", PRODUCTS], capture_output=True, text=True, check=True)
    assert finished.stdout.strip() == "1"
