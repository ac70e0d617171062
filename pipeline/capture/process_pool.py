"""The same function on many pictures in a few processes: results in order, few pictures in memory at once."""

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

from pipeline.core.measure import count_workers

Result = TypeVar("Result")
_WAITING_PER_WORKER = 3


class Workers:
    """Runs functions in other processes, or in this one when `executor` is None."""

    def __init__(self, executor: ProcessPoolExecutor | None, count: int) -> None:
        self._executor = executor
        self._count = count

    def map(self, function: Callable[..., Result], tasks: Iterable[tuple[Any, ...]]) -> Iterator[Result]:
        """Yield `function(*task)` for each task, in the order of the tasks; tasks are drawn as workers get free."""
        if self._executor is None:
            for task in tasks:
                yield function(*task)
            return
        waiting: deque[Future[Result]] = deque()
        for task in tasks:
            waiting.append(self._executor.submit(function, *task))
            if len(waiting) >= _WAITING_PER_WORKER * self._count:
                yield waiting.popleft().result()
        while waiting:
            yield waiting.popleft().result()


@contextmanager
def start_workers(count: int) -> Iterator[Workers]:
    """Start `count` processes (none for 1); they end with the block, or when this process is killed.

    Processes are started afresh, not forked: the libraries in use keep threads that a fork would cut off.
    """
    if count == 1:
        yield Workers(None, 1)
        return
    context = multiprocessing.get_context("spawn")
    executor = ProcessPoolExecutor(count, mp_context=context, initializer=_prepare_process)
    try:
        yield Workers(executor, count)
    finally:
        count_workers(process.pid for process in multiprocessing.active_children() if process.pid is not None)
        executor.shutdown(wait=True, cancel_futures=True)


def _prepare_process() -> None:
    """One thread a process, and no life without the parent: a killed parent cannot tell its workers to stop."""
    cv2.setNumThreads(1)
    parent = multiprocessing.parent_process()
    if parent is not None:
        threading.Thread(target=_end_with, args=(parent,), daemon=True).start()


def _end_with(parent: BaseProcess) -> None:
    parent.join()
    os._exit(1)
