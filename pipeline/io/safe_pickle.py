"""Pickles from strangers, read without running anything: arrays and plain containers, everything else is refused.

A pickle is a program that may call any function it names. Here it may name only those that make numpy arrays and plain
containers. Those of numpy itself are replaced: they take a type's flags, an array's length and even pointers to objects
as the pickle gives them. Objects of other packages (chumpy, scipy) are read as `OpaqueObject`s when the caller asks
for it by
name, so that the packages are neither needed nor run. Python 2's pickles are read too; their byte strings come back as
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

# What damaged bytes can raise on their way through the unpickler and numpy.
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
    """The pickle names something that is not on the allow-list; the message is its dotted name."""


class OpaqueObject:
    """An object of another package that was not built: `state` is what it would have been built from."""

    state: Any = None

    def __setstate__(self, state: object) -> None:
        """Keep what the pickle hands over."""
        self.state = state


class _NdarrayPlaceholder:
    """Stands where a pickle names `numpy.ndarray`, which would take any bytes for pointers to objects."""


class _DtypePlaceholder:
    """A numpy type as a pickle describes it: a name and, after BUILD, its parts."""

    def __init__(self, name: object, *_: object) -> None:
        if not isinstance(name, str):
            raise pickle.UnpicklingError("a type of numpy has no name")
        self.name, self.parts = name, None

    def __setstate__(self, state: Any) -> None:
        """Keep what the pickle hands over."""
        self.parts = state

    @property
    def dtype(self) -> np.dtype:
        """The type that numpy itself makes of the parts, with its own flags; ValueError where the parts contradict."""
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
    """What `_reconstruct` does; the array gets its content by BUILD."""
    return np.empty(0)


def _checked_array_state(state: Any) -> tuple[Any, ...]:
    """What BUILD gives an array: of objects numpy would read on where the shape asks for more than there are."""
    version, shape, kind, is_fortran, content = state
    dtype = kind.dtype
    if dtype.hasobject and len(content) != math.prod(shape):
        raise pickle.UnpicklingError(f"the content of an array does not fill its shape {shape}")
    return version, shape, dtype, is_fortran, content


def _array_of_bytes(content: Any, kind: Any, shape: Any, order: Any) -> np.ndarray:
    """What `_frombuffer` does, of bytes alone: no other buffer stays where it is. ValueError for objects."""
    if not isinstance(content, bytes | bytearray):
        raise pickle.UnpicklingError("an array's content is no bytes")
    return np.frombuffer(content, kind.dtype).reshape(shape, order=order)


def _scalar(kind: Any, content: Any) -> Any:
    """What `scalar` does; Python 2's bytes are text by now."""
    return _array_of_bytes(content.encode("latin1") if isinstance(content, str) else content, kind, 1, "C")[0]


def _latin1_bytes(text: str, encoding: str) -> bytes:
    """What Python 3 names `_codecs.encode` for in protocol 2: bytes written as text."""
    if encoding not in ("latin1", "latin-1"):
        raise ValueError(f"bytes are stored as {encoding}, not as latin1")
    return text.encode("latin1")


def _reconstruct_opaque_object(kind: type, base: type, state: object) -> OpaqueObject:
    """What `copyreg._reconstructor` does in protocols 0 and 1, for records alone."""
    if not issubclass(kind, OpaqueObject) or base is not object or state is not None:
        raise ForbiddenGlobalError("copyreg._reconstructor")
    return kind()


# What numpy names when it pickles an array (protocols 0 to 4, and 5) and a scalar; its module moved in numpy 2.
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


# The unpickler in Python: that in C lets nobody look at what BUILD does. It reads no byte ahead, either.
_PythonUnpickler: Any = pickle._Unpickler


class RestrictedUnpickler(_PythonUnpickler):
    """Reads arrays and plain containers; `opaque_classes` are dotted names of classes that come back as
    `OpaqueObject`s.
    """

    def __init__(self, file: IO[bytes], opaque_classes: Iterable[str] = ()) -> None:
        super().__init__(file, encoding="latin1")
        # One class a load and name: a pickle may set attributes of classes, which must not outlive it.
        self._opaque_classes = {name: type(name.rpartition(".")[2], (OpaqueObject,), {}) for name in opaque_classes}

    def find_class(self, module_name: str, global_name: str) -> Any:
        """What the pickle may use under this name. Raises RefusedGlobalError for all else."""
        name = f"{module_name}.{global_name}"
        found = self._opaque_classes.get(name) or _ALLOWED_GLOBALS.get(name)
        if found is None:
            raise ForbiddenGlobalError(name)
        return found

    def load_build(self) -> None:
        """As in pickle, for what has a state here: it would set any attribute of anything else."""
        state, instance = self.stack[-1], self.stack[-2]
        if isinstance(instance, np.ndarray):
            self.stack[-1] = _checked_array_state(state)
        elif not isinstance(instance, _DtypePlaceholder | OpaqueObject):
            raise pickle.UnpicklingError(f"it gives a state to {type(instance).__name__}")
        super().load_build()

    dispatch = {**_PythonUnpickler.dispatch, pickle.BUILD[0]: load_build}


def load_pickle(path: Path, opaque_classes: Iterable[str] = ()) -> Any:
    """Read a pickle of numpy arrays and plain containers.

    Args:
        path: the file; protocols 0 to 5, of Python 2 or 3.
        records: dotted names of foreign classes to read as `OpaqueObject`, for example `chumpy.ch.Ch`.

    Raises:
        UserError: naming the file and what it asks for beyond that, or that it is damaged or absent.
    """
    with open_pickle(path) as file:
        return RestrictedUnpickler(file, opaque_classes).load()


def load_npy(path: Path) -> np.ndarray:
    """Read a `.npy` file; what an array of objects holds is read as by `load_pickle`. Raises UserError as it does."""
    with open_pickle(path) as file:
        is_first_version = np.lib.format.read_magic(file) == (1, 0)
        if is_first_version and np.lib.format.read_array_header_1_0(file)[2].hasobject:
            return np.asarray(RestrictedUnpickler(file).load())
        file.seek(0)
        return np.asarray(np.load(file, allow_pickle=False))


@contextmanager
def open_pickle(path: Path) -> Iterator[IO[bytes]]:
    """The open file; whatever unpickling from it can raise becomes a UserError that names it."""
    try:
        with path.open("rb") as file:
            yield file
    except FileNotFoundError:
        raise UserError(f"{path} does not exist; give a file of arrays") from None
    except ForbiddenGlobalError as refused:
        raise UserError(
            f"{path} is refused: it asks for `{refused}`, and only numpy arrays and plain containers are read; "
            "store the arrays as .npz"
        ) from None
    except _UNPICKLING_ERRORS as error:
        raise UserError(f"{path} cannot be read as pickled arrays ({error}); fetch or write it again") from None
