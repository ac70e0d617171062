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


def test_arrays_are_compressed(tmp_path) -> None:
    npz.save_npz(tmp_path / "one.npz", {"zeros": np.zeros(10_000)})
    assert (tmp_path / "one.npz").stat().st_size < 1_000


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


def test_what_an_array_claims_must_be_there(tmp_path) -> None:
    """A header of a few bytes that claims 4 TB is refused before memory is allocated for it."""
    header = b"{'descr': '<f4', 'fortran_order': False, 'shape': (1000000000000,), }"
    member = b"\x93NUMPY\x01\x00" + (118).to_bytes(2, "little") + header.ljust(117) + b"\n" + bytes(16)
    with zipfile.ZipFile(tmp_path / "claim.npz", "w") as archive:
        archive.writestr("a.npy", member)
    with pytest.raises(UserError, match="claims shape"):
        npz.load_npz(tmp_path / "claim.npz")


def test_a_file_that_is_too_large_is_refused(tmp_path, monkeypatch) -> None:
    npz.save_npz(tmp_path / "a.npz", {"a": np.zeros(1000)})
    assert len(npz.load_npz(tmp_path / "a.npz")["a"]) == 1000
    monkeypatch.setattr(npz, "MAX_NPZ_BYTES", 8000)
    with pytest.raises(UserError, match="at most 8000 are read"):
        npz.load_npz(tmp_path / "a.npz")


def test_shapes_of_all_kinds_come_back(tmp_path) -> None:
    arrays = {
        "empty": np.zeros((0, 3)),
        "scalar": np.array(2.5),
        "text": np.array("neutral"),
        "flags": np.ones(3, bool),
    }
    arrays["fortran"] = np.asfortranarray(np.arange(6.0).reshape(2, 3))
    np.savez_compressed(tmp_path / "a.npz", **arrays)
    found = npz.load_npz(tmp_path / "a.npz")
    assert found.keys() == arrays.keys()
    assert all(np.array_equal(found[name], arrays[name]) and found[name].dtype == arrays[name].dtype for name in arrays)


def test_an_unfinished_header_is_refused(tmp_path) -> None:
    header = b"{'descr': '<f4', 'fortran_order': (\n"
    with zipfile.ZipFile(tmp_path / "a.npz", "w") as archive:
        archive.writestr("a.npy", b"\x93NUMPY\x01\x00" + len(header).to_bytes(2, "little") + header)
    with pytest.raises(UserError, match="cannot be read as npz arrays"):
        npz.load_npz(tmp_path / "a.npz")
