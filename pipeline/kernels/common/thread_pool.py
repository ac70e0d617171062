"""Threads for work that comes in a few equal parts, each with its share of torch's and numba's threads.

A training step is some thousand operations that are too small to be shared out among threads one by one: waking a
thread takes as long as such an operation (docs/decisions.md).
"""

from collections.abc import Callable, Iterable
from concurrent.futures import ThreadPoolExecutor
from typing import TypeVar

import numba
import torch

T = TypeVar("T")


class ThreadPool:
    """At most `count` threads that take jobs at the same time: as many as torch and numba have, one at least.

    Where numba's threads cannot be entered from several others (its own "workqueue", used where neither OpenMP nor TBB
    is found), jobs come one after the other.
    """

    def __init__(self, count: int) -> None:
        threads = min(torch.get_num_threads(), numba.get_num_threads())
        worker_count = 1 if numba.threading_layer() == "workqueue" else min(count, threads)
        self._threads_per_worker = threads // worker_count
        self._pool = ThreadPoolExecutor(worker_count, initializer=self._set_thread_limits) if worker_count > 1 else None

    def map(self, function: Callable[..., T], *arguments: Iterable) -> list[T]:
        """What `function` gives for each of the jobs, in their order; arguments as in `map`."""
        if self._pool is None:
            return list(map(function, *arguments))
        threads = torch.get_num_threads()
        # Here too: MKL has one number of threads for all threads of a process.
        torch.set_num_threads(self._threads_per_worker)
        try:
            return list(self._pool.map(function, *arguments))
        finally:
            torch.set_num_threads(threads)

    def _set_thread_limits(self) -> None:
        torch.set_num_threads(self._threads_per_worker)
        numba.set_num_threads(self._threads_per_worker)
