"""Parallel map over images in worker processes, with results in order and few images in memory."""

import multiprocessing
import os
import threading
from collections import deque
from collections.abc import Callable, Iterable, Iterator
from concurrent.futures import Future, ProcessPoolExecutor
from contextlib import contextmanager
from multiprocessing.process import BaseProcess
from typing import Any, TypeVar

import cv2

from pipeline.core.measure import record_worker_peaks

Result = TypeVar("Result")
_MAX_PENDING_PER_WORKER = 3


class ProcessPool:
    """Runs functions in worker processes, or in this process if `executor` is None."""

    def __init__(self, executor: ProcessPoolExecutor | None, count: int) -> None:
        self._executor = executor
        self._count = count

    def map(self, function: Callable[..., Result], tasks: Iterable[tuple[Any, ...]]) -> Iterator[Result]:
        """Yield `function(*task)` for each task in order; tasks are taken from the iterator when a worker is free."""
        if self._executor is None:
            for task in tasks:
                yield function(*task)
            return
        pending: deque[Future[Result]] = deque()
        for task in tasks:
            pending.append(self._executor.submit(function, *task))
            if len(pending) >= _MAX_PENDING_PER_WORKER * self._count:
                yield pending.popleft().result()
        while pending:
            yield pending.popleft().result()


@contextmanager
def start_process_pool(count: int) -> Iterator[ProcessPool]:
    """Start `count` processes (none for 1) that end with the block, or when this process is killed.

    Processes are spawned, not forked: a fork would lose threads of the libraries in use.
    """
    if count == 1:
        yield ProcessPool(None, 1)
        return
    context = multiprocessing.get_context("spawn")
    executor = ProcessPoolExecutor(count, mp_context=context, initializer=_initialise_worker)
    try:
        yield ProcessPool(executor, count)
    finally:
        record_worker_peaks(process.pid for process in multiprocessing.active_children() if process.pid is not None)
        executor.shutdown(wait=True, cancel_futures=True)


def _initialise_worker() -> None:
    """Use one thread per process and exit with the parent, because a killed parent cannot stop its workers."""
    cv2.setNumThreads(1)
    parent = multiprocessing.parent_process()
    if parent is not None:
        threading.Thread(target=_exit_with_parent, args=(parent,), daemon=True).start()


def _exit_with_parent(parent: BaseProcess) -> None:
    parent.join()
    os._exit(1)
