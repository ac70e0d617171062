"""Order, laziness and errors of the process pool; the same answers with and without processes."""

import os
import sys

import pytest

from pipeline.capture.process_pool import start_process_pool
from pipeline.core.errors import UserError
from pipeline.core.measure import peak_rss_mib


def square(number: int) -> tuple[int, int]:
    return number * number, os.getpid()


def refuse(number: int) -> int:
    raise UserError(f"number {number} is refused")


def test_results_come_in_order_from_other_processes():
    with start_process_pool(2) as workers:
        results = list(workers.map(square, ((k,) for k in range(20))))
    assert [value for value, _ in results] == [k * k for k in range(20)]
    assert os.getpid() not in {pid for _, pid in results}


@pytest.mark.skipif(sys.platform != "linux", reason="other systems tell the largest child alone")
def test_what_workers_held_counts():
    before = peak_rss_mib()
    with start_process_pool(2) as workers:
        list(workers.map(square, [(3,), (4,)]))
    assert peak_rss_mib() > before + 50  # each worker has loaded numpy and OpenCV


def test_one_worker_is_this_process():
    with start_process_pool(1) as workers:
        assert list(workers.map(square, [(3,)])) == [(9, os.getpid())]


def test_tasks_are_drawn_as_they_are_needed():
    drawn = []

    def tasks():
        for k in range(100):
            drawn.append(k)
            yield (k,)

    with start_process_pool(2) as workers:
        results = workers.map(square, tasks())
        next(results)
        assert len(drawn) < 10
        results.close()


def test_an_error_in_a_worker_arrives_as_itself():
    with start_process_pool(2) as workers, pytest.raises(UserError, match="number 7"):
        list(workers.map(refuse, [(7,)]))
