"""Data sets of foreign HDF5 files: read, or refused in one sentence, never from another file."""

from collections.abc import Callable
from pathlib import Path

import h5py
import numpy as np
import pytest

from pipeline.core.errors import UserError
from pipeline.io.hdf5 import read_dataset, read_whole


def write(path: Path, fill: Callable[[h5py.File], object]) -> Path:
    with h5py.File(path, "w") as file:
        fill(file)
    return path


def test_values_and_parts_come_back(tmp_path: Path) -> None:
    values = np.arange(24, dtype=np.uint8).reshape(2, 3, 4)
    path = write(tmp_path / "a.h5", lambda file: file.create_dataset("masks", data=values, compression="gzip"))
    assert np.array_equal(read_dataset(path, "masks", read_whole), values)
    assert np.array_equal(read_dataset(path, "masks", lambda masks: masks[1]), values[1])


@pytest.mark.parametrize(
    ("fill", "reason"),
    [
        (lambda file: None, "no data set of this file"),
        (lambda file: file.create_group("masks"), "no array of numbers"),
        (lambda file: file.create_dataset("masks", data=["a", "b"]), "no array of numbers"),
        (lambda file: file.create_dataset("masks", (10**6, 4096, 4096), "u1", chunks=True), "at most"),
        (lambda file: file.__setitem__("masks", h5py.ExternalLink("secret.h5", "masks")), "no data set of this file"),
        (lambda file: file.create_dataset("masks", (4,), "u1", external=[("secret.h5", 0, 4)]), "in another file"),
        (lambda file: file.__setitem__("masks", h5py.SoftLink("/masks")), "no data set of this file"),
    ],
)
def test_other_content_is_refused(tmp_path: Path, fill: Callable[[h5py.File], object], reason: str) -> None:
    write(tmp_path / "secret.h5", lambda file: file.create_dataset("masks", data=np.ones(4, np.uint8)))
    path = write(tmp_path / "a.h5", fill)
    with pytest.raises(UserError, match=reason):
        read_dataset(path, "masks", read_whole)


def test_a_file_that_is_no_hdf5_is_refused(tmp_path: Path) -> None:
    (tmp_path / "a.h5").write_bytes(b"text")
    with pytest.raises(UserError, match=r"a\.h5 cannot be read as HDF5"):
        read_dataset(tmp_path / "a.h5", "masks", read_whole)
