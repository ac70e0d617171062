"""Peak memory of a process and of its workers; description of the environment."""

import subprocess
import sys
from types import SimpleNamespace

import pytest

from pipeline.core import measure
from pipeline.core.measure import REPOSITORY_DIR, cpu_name, describe_environment, peak_rss_mib

ALLOCATE = "from pipeline.core.measure import peak_rss_mib; b = bytearray({mib} << 20); del b; print(peak_rss_mib())"


def peak_after_allocating(mib: int) -> float:
    done = subprocess.run(
        [sys.executable, "-c", ALLOCATE.format(mib=mib)], capture_output=True, text=True, check=True, cwd=REPOSITORY_DIR
    )
    return float(done.stdout)


def test_a_freed_block_is_still_in_the_peak() -> None:
    assert 190 < peak_after_allocating(200) - peak_after_allocating(0) < 220


def test_a_childs_peak_does_not_count_its_parents_memory() -> None:
    ballast = bytearray(300 << 20)
    assert peak_rss_mib() > 300
    assert peak_after_allocating(0) < 200
    assert len(ballast) == 300 << 20


COUNT = """
import subprocess, sys
from pipeline.core.measure import record_worker_peaks, peak_rss_mib
held = "b = bytearray(100 << 20); del b; print(flush=True); input()"
start = [sys.executable, "-c", held]
workers = [subprocess.Popen(start, stdin=subprocess.PIPE, stdout=subprocess.PIPE) for _ in range(2)]
before = peak_rss_mib()
for worker in workers: worker.stdout.readline()
record_worker_peaks([worker.pid for worker in workers] + [2**22 + 1])
record_worker_peaks([workers[0].pid])
for worker in workers: worker.communicate(b"x")
print(peak_rss_mib() - before)
"""


@pytest.mark.skipif(sys.platform != "linux", reason="other systems report the largest child only")
def test_peaks_of_workers_are_added() -> None:
    """Two of 100 MiB plus an interpreter, one of them recorded twice; a process that has ended adds nothing."""
    done = subprocess.run([sys.executable, "-c", COUNT], capture_output=True, text=True, check=True, cwd=REPOSITORY_DIR)
    assert 200 < float(done.stdout) < 240


def test_the_environment_names_machine_and_packages() -> None:
    found = describe_environment()
    assert found["packages"]["numpy"]
    assert found["cpu"] == cpu_name() != ""
    assert found["cores"] >= 1


def test_the_commit_is_that_of_this_project_only(monkeypatch: pytest.MonkeyPatch) -> None:
    """An installation inside the repository of another project has no commit."""
    monkeypatch.setattr(measure, "REPOSITORY_DIR", REPOSITORY_DIR / "pipeline")
    assert describe_environment()["commit"] is None


def test_a_gpu_that_refuses_access_does_not_fail_the_run(monkeypatch: pytest.MonkeyPatch) -> None:
    """A GPU in exclusive mode that another process uses is available, but raises on any access."""

    def refuse(_: int) -> str:
        raise RuntimeError("CUDA error: all CUDA-capable devices are busy or unavailable")

    busy, free = (
        SimpleNamespace(is_available=lambda: True, get_device_name=name) for name in (refuse, lambda _: "Card")
    )
    monkeypatch.setitem(sys.modules, "torch", SimpleNamespace(cuda=busy))
    assert describe_environment()["gpu"] is None
    monkeypatch.setitem(sys.modules, "torch", SimpleNamespace(cuda=free))
    assert describe_environment()["gpu"] == "Card"
