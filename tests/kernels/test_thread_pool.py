"""Concurrent jobs: order of results, threads of each worker, sequential fallback."""

import threading

import numba
import pytest
import torch

from pipeline.kernels.common.thread_pool import ThreadPool, one_thread


@pytest.fixture
def four_threads(monkeypatch: pytest.MonkeyPatch) -> None:
    """Simulate a machine with four threads; the limit of each thread is recorded, not applied."""
    thread_counts = threading.local()
    numba.get_num_threads()  # starts the threads, which determines the threading layer
    monkeypatch.setattr(numba, "threading_layer", lambda: "omp")
    for module in (numba, torch):
        name = f"{module.__name__}_threads"
        monkeypatch.setattr(module, "get_num_threads", lambda name=name: getattr(thread_counts, name, 4))
        monkeypatch.setattr(module, "set_num_threads", lambda count, name=name: setattr(thread_counts, name, count))


def thread_state(_: int) -> tuple[int, int, int]:
    return threading.get_ident(), torch.get_num_threads(), numba.get_num_threads()


def test_one_thread_and_then_as_before() -> None:
    before = torch.get_num_threads(), numba.get_num_threads()
    with one_thread():
        assert (torch.get_num_threads(), numba.get_num_threads()) == (1, 1)
    assert (torch.get_num_threads(), numba.get_num_threads()) == before


def test_results_keep_job_order(four_threads: None) -> None:
    second_done = threading.Event()

    def job(number: int, word: str) -> str:
        if number == 0:
            assert second_done.wait(20)
        else:
            second_done.set()
        return f"{number} {word}"

    assert ThreadPool(2).map(job, [0, 1], ["first", "second"]) == ["0 first", "1 second"]


@pytest.mark.parametrize("count", [1, 4])
def test_without_arguments_there_are_no_jobs(four_threads: None, count: int) -> None:
    assert ThreadPool(count).map(lambda: pytest.fail("there is no job")) == []


def test_imap_keeps_the_order_and_holds_few_results(four_threads: None) -> None:
    started = []

    def job(number: int) -> int:
        started.append(number)
        return number**2

    results = ThreadPool(2).imap(job, iter(range(7)))
    assert next(results) == 0
    assert sorted(started) == [0, 1]
    assert list(results) == [1, 4, 9, 16, 25, 36]


def test_threads_are_divided_and_restored(four_threads: None) -> None:
    states = ThreadPool(2).map(thread_state, range(6))
    assert {state[1:] for state in states} == {(2, 2)}
    assert threading.get_ident() not in {state[0] for state in states}
    assert (torch.get_num_threads(), numba.get_num_threads()) == (4, 4)


def test_threads_are_restored_after_a_failure(four_threads: None) -> None:
    def fail(number: int) -> None:
        raise LookupError(number)

    with pytest.raises(LookupError, match="0"):
        ThreadPool(2).map(fail, range(2))
    assert torch.get_num_threads() == 4


@pytest.mark.parametrize("layer", ["omp", "workqueue"])
def test_jobs_run_sequentially_without_reentrant_threads(
    four_threads: None, monkeypatch: pytest.MonkeyPatch, layer: str
) -> None:
    if layer == "omp":
        torch.set_num_threads(1)
    monkeypatch.setattr(numba, "threading_layer", lambda: layer)
    expected = (threading.get_ident(), torch.get_num_threads(), 4)
    assert ThreadPool(2).map(thread_state, range(3)) == [expected] * 3
