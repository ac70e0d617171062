"""A thread pool for a few jobs of similar size, each with an equal number of the threads of torch and numba.

A training step consists of about a thousand operations that are too small to be divided among threads one by one: to
wake a thread takes as long as such an operation (docs/decisions/engineering.md).
"""

from collections.abc import Callable, Iterable, Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager
from functools import cache
from itertools import islice
from typing import TypeVar

import numba
import torch

A = TypeVar("A")
T = TypeVar("T")


@contextmanager
def torch_threads(count: int) -> Iterator[None]:
    """Let torch use `count` threads inside the block. One gives the same rounding of products on every machine."""
    before = torch.get_num_threads()
    torch.set_num_threads(count)
    try:
        yield
    finally:
        torch.set_num_threads(before)


@contextmanager
def one_thread() -> Iterator[None]:
    """Let torch and numba use one thread inside the block, for many small operations one after the other."""
    before = numba.get_num_threads()
    numba.set_num_threads(1)
    try:
        with torch_threads(1):
            yield
    finally:
        numba.set_num_threads(before)


class ThreadPool:
    """At most `count` concurrent workers, at least one, and no more than torch and numba have threads.

    Jobs run sequentially where several threads cannot enter numba's parallel loops at the same time: in its own
    "workqueue" layer, which it uses if neither OpenMP nor TBB is found.
    """

    def __init__(self, count: int) -> None:
        threads = min(torch.get_num_threads(), numba.get_num_threads())
        worker_count = 1 if numba.threading_layer() == "workqueue" else min(count, threads)
        self._worker_count, self._threads_per_worker = worker_count, threads // worker_count
        self._pool = ThreadPoolExecutor(worker_count, initializer=self._set_thread_limits) if worker_count > 1 else None

    def map(self, function: Callable[..., T], *arguments: Iterable) -> list[T]:
        """Return the results of `function` for all jobs, in the order of the jobs; `arguments` as in built-in `map`.

        Without arguments there are no jobs.
        """
        if self._pool is None:
            return [function(*job) for job in zip(*arguments, strict=False)]
        # The calling thread needs the limit too: MKL has one number of threads for the whole process.
        with torch_threads(self._threads_per_worker):
            return list(self._pool.map(function, *arguments))

    def imap(self, function: Callable[[A], T], items: Iterable[A]) -> Iterator[T]:
        """Yield the results of `function` for all items, in their order; no more are held than there are workers."""
        iterator = iter(items)
        while batch := list(islice(iterator, self._worker_count)):
            yield from self.map(function, batch)

    def _set_thread_limits(self) -> None:
        torch.set_num_threads(self._threads_per_worker)
        numba.set_num_threads(self._threads_per_worker)


@cache
def shared_thread_pool(count: int) -> ThreadPool:
    """Return the pool of `count` workers that all callers of this process share; its threads are started once."""
    return ThreadPool(count)
