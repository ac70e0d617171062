import pytest

from tests.bench import bench_kernels


@pytest.mark.slow
def test_kernels(capsys):
    figures = bench_kernels.field_parts(bench_kernels.FieldConfig(), 7) | bench_kernels.warp_parts(7)
    with capsys.disabled():
        for name, value in figures.items():
            print(f"{name:32s} {value:10.2f}")
    assert all(value > 0 for value in figures.values())
