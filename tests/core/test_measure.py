"""Memory is the process's own peak; the environment is recorded."""

import subprocess
import sys

from pipeline.core.measure import REPOSITORY, cpu_name, environment, peak_rss_mib

ALLOCATE = "from pipeline.core.measure import peak_rss_mib; b = bytearray({mib} << 20); del b; print(peak_rss_mib())"


def peak_after_allocating(mib: int) -> float:
    done = subprocess.run(
        [sys.executable, "-c", ALLOCATE.format(mib=mib)], capture_output=True, text=True, check=True, cwd=REPOSITORY
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
    found = environment()
    assert found["packages"]["numpy"]
    assert found["cpu"] == cpu_name() != ""
    assert found["cores"] >= 1
