"""Read data sets of HDF5 files that the program did not write: bounded, and never from another file."""

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import TypeVar

import h5py
import numpy as np

from pipeline.core.errors import UserError

MAX_DATASET_BYTES = 4 << 30
"""A larger data set is not read at once; one whose values were never written takes no space in its file."""

Result = TypeVar("Result")


def read_dataset(path: Path, name: str, select: Callable[[h5py.Dataset], Result]) -> Result:
    """Apply `select` to a data set and return the result.

    Raises:
        UserError: the file cannot be read, there is no such data set of numbers, or its values are in another file.
    """
    try:
        with _open_dataset(path, name) as dataset:
            return select(dataset)
    except (OSError, LookupError, ValueError, TypeError, RuntimeError, OverflowError) as error:
        reason = " ".join(str(error).split())
        raise UserError(
            f"{path} cannot be read as HDF5 with a data set `{name}` ({reason}); remove or replace it"
        ) from None


def read_whole(dataset: h5py.Dataset) -> np.ndarray:
    """Return all values. ValueError if they take more than `MAX_DATASET_BYTES`."""
    size = dataset.size * dataset.dtype.itemsize
    if size > MAX_DATASET_BYTES:
        raise ValueError(f"shape {dataset.shape} has {size} bytes, at most {MAX_DATASET_BYTES} are read")
    return np.asarray(dataset)


@contextmanager
def _open_dataset(path: Path, name: str) -> Iterator[h5py.Dataset]:
    with h5py.File(path, "r") as file:
        if not isinstance(file.get(name, getlink=True), h5py.HardLink):
            raise ValueError("it is no data set of this file")
        dataset = file[name]
        if not isinstance(dataset, h5py.Dataset) or dataset.dtype.kind not in "buif" or dataset.shape is None:
            raise ValueError("it holds no array of numbers")
        if dataset.external is not None or dataset.is_virtual:
            raise ValueError("its values are in another file")
        yield dataset
