"""Parallel map over images in threads, with results in order and few images in memory.

Threads, not processes: detectors, OpenCV and numpy release the interpreter's lock, images need no copy to another
process, and libraries (0.4 GB a process) are loaded once.
"""

from collections import deque
from collections.abc import Callable, Iterable, Iterator
from concurrent.futures import Future, ThreadPoolExecutor
from contextlib import contextmanager
from typing import Any, TypeVar

from pipeline.kernels.common.opencv_threads import single_threaded_opencv

Result = TypeVar("Result")
_MAX_PENDING_PER_WORKER = 2


class WorkerPool:
    """Runs functions in worker threads, or in the calling thread if `executor` is None."""

    def __init__(self, executor: ThreadPoolExecutor | None, count: int) -> None:
        self._executor = executor
        self.count = count

    def map(self, function: Callable[..., Result], tasks: Iterable[tuple[Any, ...]]) -> Iterator[Result]:
        """Yield `function(*task)` for each task in order; tasks are taken from the iterator when a worker is free."""
        if self._executor is None:
            for task in tasks:
                yield function(*task)
            return
        pending: deque[Future[Result]] = deque()
        for task in tasks:
            pending.append(self._executor.submit(function, *task))
            if len(pending) >= _MAX_PENDING_PER_WORKER * self.count:
                yield pending.popleft().result()
        while pending:
            yield pending.popleft().result()


@contextmanager
def start_worker_pool(count: int) -> Iterator[WorkerPool]:
    """Start `count` threads (none for 1) that end with the block; OpenCV uses one thread for each meanwhile."""
    with single_threaded_opencv():
        if count == 1:
            yield WorkerPool(None, 1)
            return
        with ThreadPoolExecutor(count) as executor:
            try:
                yield WorkerPool(executor, count)
            finally:
                executor.shutdown(wait=True, cancel_futures=True)
