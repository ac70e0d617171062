"""Read uncompressed files of `joblib.dump`, with the restrictions of `pipeline.io.safe_pickle`.

Such a file is a pickle in which each array is an object with shape, order and dtype, followed by the raw bytes of the
array. Since joblib 1.2 a byte with the number of padding bytes, and the padding, precede the raw bytes.
"""

import pickle
from pathlib import Path
from typing import IO, Any

import numpy as np

from pipeline.io.safe_pickle import OpaqueObject, RestrictedUnpickler, open_pickle

_WRAPPER = "joblib.numpy_pickle.NumpyArrayWrapper"


def load_joblib(path: Path) -> Any:
    """Read arrays and plain containers. Raises UserError like `pipeline.io.safe_pickle.load_pickle`."""
    with open_pickle(path) as file:
        return _JoblibUnpickler(file).load()


class _JoblibUnpickler(RestrictedUnpickler):
    def __init__(self, file: IO[bytes]) -> None:
        super().__init__(file, opaque_classes=[_WRAPPER])
        self._stream = file

    def load_build(self) -> None:
        """Build the object, and replace the header of an array by the array."""
        super().load_build()
        if isinstance(self.stack[-1], OpaqueObject):
            self.stack[-1] = self._read_array(self.stack[-1].state)

    def _read_array(self, header: dict[str, Any]) -> np.ndarray:
        shape, dtype = header["shape"], header["dtype"].dtype
        if dtype.hasobject:
            raise pickle.UnpicklingError("it contains an array of objects")
        if header.get("numpy_array_alignment_bytes") is not None:
            self._stream.read(self._stream.read(1)[0])
        count = int(np.prod([int(side) for side in shape], dtype=object))
        data = self._stream.read(count * dtype.itemsize)
        return np.frombuffer(data, dtype, count).reshape(shape, order=header["order"]).copy()

    dispatch = {**RestrictedUnpickler.dispatch, pickle.BUILD[0]: load_build}
