"""Write files like `joblib.dump` without joblib (joblib 1.6.0 reads them)."""

import pickle
import sys
from pathlib import Path
from types import ModuleType
from typing import Any

import numpy as np

ALIGNMENT_BYTES = 16


class NumpyArrayWrapper:
    """Header of an array in the pickle; the bytes of the array follow."""

    def __init__(self, array: np.ndarray, is_aligned: bool) -> None:
        self.subclass, self.shape, self.dtype, self.allow_mmap = np.ndarray, array.shape, array.dtype, True
        self.order = "F" if array.flags.f_contiguous and not array.flags.c_contiguous else "C"
        if is_aligned:
            self.numpy_array_alignment_bytes = ALIGNMENT_BYTES


NumpyArrayWrapper.__module__ = "joblib.numpy_pickle"


class _Pickler(pickle._Pickler):
    is_aligned = True

    def save(self, obj: Any, save_persistent_id: bool = True) -> None:
        if type(obj) is not np.ndarray:
            super().save(obj, save_persistent_id)
            return
        super().save(NumpyArrayWrapper(obj, self.is_aligned))
        if self.proto >= 4:
            self.framer.commit_frame(force=True)
        if self.is_aligned:
            filling = ALIGNMENT_BYTES - (self.raw.tell() + 1) % ALIGNMENT_BYTES
            self.raw.write(bytes([filling]) + b"\xff" * filling)
        self.raw.write(obj.tobytes("F" if obj.flags.f_contiguous and not obj.flags.c_contiguous else "C"))


def dump_joblib(content: object, path: Path, protocol: int = 4, is_aligned: bool = True) -> None:
    """Write like `joblib.dump(content, path)`; without alignment, like joblib before 1.2."""
    modules = {"joblib": ModuleType("joblib"), "joblib.numpy_pickle": ModuleType("joblib.numpy_pickle")}
    modules["joblib.numpy_pickle"].NumpyArrayWrapper = NumpyArrayWrapper
    before = {name: sys.modules.get(name) for name in modules}
    sys.modules.update(modules)
    try:
        with path.open("wb") as file:
            pickler = _Pickler(file, protocol)
            pickler.raw, pickler.is_aligned = file, is_aligned
            pickler.dump(content)
    finally:
        for name, module in before.items():
            sys.modules.pop(name)
            if module is not None:
                sys.modules[name] = module
