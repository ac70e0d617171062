"""The true person as a finished run, shared by the tests of the comparison."""

from pathlib import Path

import pytest

from data_tools.evaluate.comparison import Comparison
from tests.data_tools.ground_truth_run import ground_truth_run


@pytest.fixture(scope="session")
def perfect(sample: Path, tmp_path_factory: pytest.TempPathFactory) -> Comparison:
    return ground_truth_run(sample, tmp_path_factory.mktemp("perfect"))
