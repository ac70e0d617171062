"""npz files: round trips, equal bytes for equal arrays, refused pickles."""

import zipfile

import numpy as np
import pytest

from pipeline.core.errors import UserError
from pipeline.io import npz


def test_same_arrays_give_the_same_bytes_and_come_back(tmp_path) -> None:
    arrays = {"b": np.arange(6.0).reshape(2, 3), "a": np.array(["x", "yy"])}
    npz.save_npz(tmp_path / "one.npz", arrays)
    npz.save_npz(tmp_path / "two.npz", dict(reversed(arrays.items())))
    assert (tmp_path / "one.npz").read_bytes() == (tmp_path / "two.npz").read_bytes()
    with zipfile.ZipFile(tmp_path / "one.npz") as archive:
        assert {info.date_time for info in archive.infolist()} == {(1980, 1, 1, 0, 0, 0)}  # no time of writing
    again = npz.load_npz(tmp_path / "one.npz")
    np.testing.assert_array_equal(again["b"], arrays["b"])
    assert again["a"].tolist() == ["x", "yy"]


def test_shapes_are_kept(tmp_path) -> None:
    arrays = {"number": np.array(2.5), "word": np.array("x"), "row": np.zeros(1), "turned": np.eye(3, 2).T}
    npz.save_npz(tmp_path / "one.npz", arrays)
    shapes = {name: array.shape for name, array in npz.load_npz(tmp_path / "one.npz").items()}
    assert shapes == {name: array.shape for name, array in arrays.items()}


def test_pickles_and_damaged_files_are_refused(tmp_path) -> None:
    np.savez(tmp_path / "pickled.npz", a=np.array([{}], dtype=object))
    (tmp_path / "damaged.npz").write_bytes(b"no zip")
    for name in ("pickled.npz", "damaged.npz", "missing.npz"):
        with pytest.raises(UserError, match=name):
            npz.load_npz(tmp_path / name)
