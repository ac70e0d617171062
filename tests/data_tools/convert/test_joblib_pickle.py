"""Files of joblib: arrays of all kinds are read, and no code is executed."""

import os

import numpy as np
import pytest

from data_tools.convert.joblib_pickle import load_joblib
from pipeline.core.errors import UserError
from tests.data_tools.convert.joblib_writer import dump_joblib

CONTENT = {
    1: {
        "pose": [np.arange(72.0), np.arange(72, dtype=np.float32)],
        "columns": np.asfortranarray(np.arange(6).reshape(2, 3)),
        "empty": np.zeros((0, 3)),
        "scalar": np.array(2.5),
        "word": "x",
    }
}


@pytest.mark.parametrize("protocol", [2, 3, 4, 5])
@pytest.mark.parametrize("is_aligned", [True, False])
def test_round_trip(tmp_path, protocol, is_aligned):
    dump_joblib(CONTENT, tmp_path / "a.pkl", protocol, is_aligned)
    np.testing.assert_equal(load_joblib(tmp_path / "a.pkl"), CONTENT)


class Malice:
    def __init__(self, marker):
        self.marker = marker

    def __reduce__(self):
        return os.system, (f"touch {self.marker}",)


def test_code_in_a_pickle_is_not_executed(tmp_path):
    dump_joblib({1: [np.zeros(3), Malice(tmp_path / "marker")]}, tmp_path / "a.pkl")
    with pytest.raises(UserError, match=r"a\.pkl is refused: it contains `.*system`"):
        load_joblib(tmp_path / "a.pkl")
    assert not (tmp_path / "marker").exists()


def test_truncated_file_is_an_error(tmp_path):
    dump_joblib(CONTENT, tmp_path / "a.pkl")
    whole = (tmp_path / "a.pkl").read_bytes()
    for length in range(0, len(whole), 37):
        (tmp_path / "a.pkl").write_bytes(whole[:length])
        with pytest.raises(UserError, match=r"a\.pkl cannot be read"):
            load_joblib(tmp_path / "a.pkl")
