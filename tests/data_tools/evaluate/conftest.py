"""The true person as a finished run, shared by the tests of the comparison."""

from pathlib import Path

import pytest

from data_tools.evaluate.comparison import Comparison
from data_tools.sample import main as make_sample
from tests.data_tools.conftest import SAMPLE_OPTIONS
from tests.data_tools.ground_truth_run import ground_truth_run


@pytest.fixture(scope="session")
def perfect(sample: Path, tmp_path_factory: pytest.TempPathFactory) -> Comparison:
    return ground_truth_run(sample, tmp_path_factory.mktemp("perfect"))


@pytest.fixture(scope="session")
def hand_held(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The capture `sample`, filmed with a camera in the hand whose lens distorts."""
    out = tmp_path_factory.mktemp("captures") / "hand-held"
    make_sample([str(out), *SAMPLE_OPTIONS, "--hand-held-deg", "3", "--distortion", "-0.1"])
    return out
