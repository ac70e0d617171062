"""Restricted reading of untrusted pickles: numpy arrays and plain containers only; nothing is executed.

A pickle is a program that may call any function it names. Here it may name only the constructors of numpy arrays and
plain containers. numpy's own constructors are replaced, because they trust type flags, array lengths and even object
pointers in the pickle. Objects of other packages (chumpy, scipy) are read as `OpaqueObject` if the caller lists their
classes, so that the packages are neither needed nor executed. Python 2 pickles are supported; their byte strings become
Latin-1 text.
"""

import math
import pickle
import struct
from collections import OrderedDict
from collections.abc import Callable, Iterable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import IO, Any

import numpy as np

from pipeline.core.errors import UserError

# Exceptions of the unpickler and of numpy for damaged data.
_UNPICKLING_ERRORS = (
    pickle.UnpicklingError,
    ArithmeticError,
    AttributeError,
    EOFError,
    ImportError,
    LookupError,
    MemoryError,
    RecursionError,
    TypeError,
    ValueError,
    struct.error,
)


class ForbiddenGlobalError(pickle.UnpicklingError):
    """The pickle names a global that is not on the allow-list; the message is its dotted name."""


class OpaqueObject:
    """An object of another package that was not constructed; `state` holds its pickled state."""

    state: Any = None

    def __setstate__(self, state: object) -> None:
        """Store the pickled state."""
        self.state = state


class _NdarrayPlaceholder:
    """Replacement of `numpy.ndarray`, whose constructor would accept any bytes as object pointers."""


class _DtypePlaceholder:
    """A numpy dtype as described by a pickle: a name and, after BUILD, its state."""

    def __init__(self, name: object, *_: object) -> None:
        if not isinstance(name, str):
            raise pickle.UnpicklingError("a numpy dtype has no name")
        self.name, self.parts = name, None

    def __setstate__(self, state: Any) -> None:
        """Store the pickled state."""
        self.parts = state

    @property
    def dtype(self) -> np.dtype:
        """Return the dtype that numpy constructs from the state with its own flags; ValueError if the state is
        inconsistent.
        """
        if self.parts is None:
            return np.dtype(self.name)
        _, byte_order, subarray, names, fields, itemsize, *_ = self.parts
        if fields:
            formats, offsets = ([fields[name][part] for name in names] for part in (0, 1))
            formats = [kind.dtype for kind in formats]
            return np.dtype({"names": list(names), "formats": formats, "offsets": offsets, "itemsize": itemsize})
        if subarray:
            return np.dtype((subarray[0].dtype, subarray[1]))
        return np.dtype(self.name).newbyteorder(byte_order)


def _empty_array(*_: object) -> np.ndarray:
    """Replacement of `_reconstruct`; BUILD fills the array."""
    return np.empty(0)


def _checked_array_state(state: Any) -> tuple[Any, ...]:
    """Check the state of BUILD: numpy would read beyond the content of an object array shorter than its shape."""
    version, shape, kind, is_fortran, content = state
    dtype = kind.dtype
    if dtype.hasobject and len(content) != math.prod(shape):
        raise pickle.UnpicklingError(f"the content of an array does not fill its shape {shape}")
    return version, shape, dtype, is_fortran, content


def _array_of_bytes(content: Any, kind: Any, shape: Any, order: Any) -> np.ndarray:
    """Replacement of `_frombuffer` for bytes only (no other buffer is immutable). ValueError for object dtypes."""
    if not isinstance(content, bytes | bytearray):
        raise pickle.UnpicklingError("the content of an array is not bytes")
    return np.frombuffer(content, kind.dtype).reshape(shape, order=order)


def _scalar(kind: Any, content: Any) -> Any:
    """Replacement of `scalar`; bytes of Python 2 have been decoded to text."""
    return _array_of_bytes(content.encode("latin1") if isinstance(content, str) else content, kind, 1, "C")[0]


def _latin1_bytes(text: str, encoding: str) -> bytes:
    """Replacement of `_codecs.encode`, with which Python 3 stores bytes in protocol 2."""
    if encoding not in ("latin1", "latin-1"):
        raise ValueError(f"bytes are stored as {encoding}, not as latin1")
    return text.encode("latin1")


def _reconstruct_opaque_object(kind: type, base: type, state: object) -> OpaqueObject:
    """Replacement of `copyreg._reconstructor` of protocols 0 and 1, for opaque objects only."""
    if not issubclass(kind, OpaqueObject) or base is not object or state is not None:
        raise ForbiddenGlobalError("copyreg._reconstructor")
    return kind()


# Globals in pickles of arrays (protocols 0 to 4, and 5) and scalars; the module was renamed in numpy 2.
_NUMPY_BUILDERS: dict[str, Callable[..., Any]] = {
    "multiarray._reconstruct": _empty_array,
    "multiarray.scalar": _scalar,
    "numeric._frombuffer": _array_of_bytes,
}

_ALLOWED_GLOBALS: dict[str, Callable[..., Any]] = {
    "numpy.ndarray": _NdarrayPlaceholder,
    "numpy.dtype": _DtypePlaceholder,
    **{f"numpy.{core}.{name}": builder for core in ("core", "_core") for name, builder in _NUMPY_BUILDERS.items()},
    "_codecs.encode": _latin1_bytes,
    "collections.OrderedDict": OrderedDict,
    "copy_reg._reconstructor": _reconstruct_opaque_object,
    "copyreg._reconstructor": _reconstruct_opaque_object,
    **{
        f"{module}.{kind.__name__}": kind
        for module in ("__builtin__", "builtins")
        for kind in (bytearray, complex, frozenset, object, set)
    },
}


# The pure Python unpickler: the C version does not allow to intercept BUILD. It does not read ahead either.
_PythonUnpickler: Any = pickle._Unpickler


class RestrictedUnpickler(_PythonUnpickler):
    """Reads arrays and plain containers; `opaque_classes` are dotted names of classes that come back as
    `OpaqueObject`s.
    """

    def __init__(self, file: IO[bytes], opaque_classes: Iterable[str] = ()) -> None:
        super().__init__(file, encoding="latin1")
        # New classes for each load: a pickle may set attributes of classes.
        self._opaque_classes = {name: type(name.rpartition(".")[2], (OpaqueObject,), {}) for name in opaque_classes}

    def find_class(self, module_name: str, global_name: str) -> Any:
        """Return the replacement of a global.

        Raises:
            ForbiddenGlobalError: the global is not allowed.
        """
        name = f"{module_name}.{global_name}"
        found = self._opaque_classes.get(name) or _ALLOWED_GLOBALS.get(name)
        if found is None:
            raise ForbiddenGlobalError(name)
        return found

    def load_build(self) -> None:
        """Handle BUILD for types with a known state only; otherwise it could set attributes of any object."""
        state, instance = self.stack[-1], self.stack[-2]
        if isinstance(instance, np.ndarray):
            self.stack[-1] = _checked_array_state(state)
        elif not isinstance(instance, _DtypePlaceholder | OpaqueObject):
            raise pickle.UnpicklingError(f"BUILD on an object of type {type(instance).__name__}")
        super().load_build()

    dispatch = {**_PythonUnpickler.dispatch, pickle.BUILD[0]: load_build}


def load_pickle(path: Path, opaque_classes: Iterable[str] = ()) -> Any:
    """Read a pickle of numpy arrays and plain containers.

    Args:
        path: the file; protocols 0 to 5, of Python 2 or 3.
        opaque_classes: dotted names of classes to read as `OpaqueObject`, for example `chumpy.ch.Ch`.

    Raises:
        UserError: the file is missing or damaged, or names another global.
    """
    with open_pickle(path) as file:
        return RestrictedUnpickler(file, opaque_classes).load()


def load_npy(path: Path) -> np.ndarray:
    """Read a `.npy` file; object arrays are read as by `load_pickle`. Raises UserError as `load_pickle` does."""
    with open_pickle(path) as file:
        is_first_version = np.lib.format.read_magic(file) == (1, 0)
        if is_first_version and np.lib.format.read_array_header_1_0(file)[2].hasobject:
            return np.asarray(RestrictedUnpickler(file).load())
        file.seek(0)
        return np.asarray(np.load(file, allow_pickle=False))


@contextmanager
def open_pickle(path: Path) -> Iterator[IO[bytes]]:
    """Open the file; exceptions of unpickling inside the block become a UserError that names the file."""
    try:
        with path.open("rb") as file:
            yield file
    except FileNotFoundError:
        raise UserError(f"{path} does not exist; supply a file of arrays") from None
    except ForbiddenGlobalError as refused:
        raise UserError(
            f"{path} is refused: it contains `{refused}`, but only numpy arrays and plain containers are read; "
            "store the arrays as .npz"
        ) from None
    except _UNPICKLING_ERRORS as error:
        raise UserError(f"{path} cannot be read as pickled arrays ({error}); download or write it again") from None
