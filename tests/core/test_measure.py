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
