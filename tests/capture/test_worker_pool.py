"""Order, laziness and errors of the worker pool; the same answers with and without threads."""

import threading

import cv2
import pytest

from pipeline.capture.worker_pool import start_worker_pool
from pipeline.core.errors import UserError


def square(number: int) -> tuple[int, int]:
    return number * number, threading.get_ident()


def refuse(number: int) -> int:
    raise UserError(f"number {number} is refused")


def test_results_come_in_order_from_other_threads():
    with start_worker_pool(2) as workers:
        results = list(workers.map(square, ((k,) for k in range(20))))
    assert [value for value, _ in results] == [k * k for k in range(20)]
    assert threading.get_ident() not in {thread for _, thread in results}


def test_one_worker_is_this_thread():
    with start_worker_pool(1) as workers:
        assert list(workers.map(square, [(3,)])) == [(9, threading.get_ident())]


def test_tasks_are_drawn_as_they_are_needed():
    drawn = []

    def tasks():
        for k in range(100):
            drawn.append(k)
            yield (k,)

    with start_worker_pool(2) as workers:
        results = workers.map(square, tasks())
        next(results)
        assert len(drawn) < 10
        results.close()


def test_an_error_in_a_worker_arrives_as_itself_and_opencv_gets_its_threads_back():
    threads = cv2.getNumThreads()
    with pytest.raises(UserError, match="number 7"), start_worker_pool(2) as workers:
        list(workers.map(refuse, [(7,)]))
    assert cv2.getNumThreads() == threads
