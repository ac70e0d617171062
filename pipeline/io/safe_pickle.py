"""Pickles from strangers, read without running anything: arrays and plain containers, everything else is refused.

A pickle is a program that may call any function it names. Here it may name only those that make numpy arrays and plain
containers. Objects of other packages (chumpy, scipy) are read as `Record`s when the caller asks for it by name, so that
the packages are neither needed nor run. Python 2's pickles are read too; their byte strings come back as Latin-1 text.
"""

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
_DAMAGE = (
    pickle.UnpicklingError,
    ArithmeticError,
    AttributeError,
    EOFError,
    ImportError,
    LookupError,
    MemoryError,
    TypeError,
    ValueError,
    struct.error,
)


class RefusedGlobalError(pickle.UnpicklingError):
    """The pickle names something that is not on the allow-list; the message is its dotted name."""


class Record:
    """An object of another package that was not built: `state` is what it would have been built from."""

    state: Any = None

    def __setstate__(self, state: object) -> None:
        """Keep what the pickle hands over."""
        self.state = state


def _latin1_bytes(text: str, encoding: str) -> bytes:
    """What Python 3 names `_codecs.encode` for in protocol 2: bytes written as text."""
    if encoding not in ("latin1", "latin-1"):
        raise ValueError(f"bytes are stored as {encoding}, not as latin1")
    return text.encode("latin1")


def _empty_record(kind: type, base: type, state: object) -> Record:
    """What `copyreg._reconstructor` does in protocols 0 and 1, for records alone."""
    if not issubclass(kind, Record) or base is not object or state is not None:
        raise RefusedGlobalError("copyreg._reconstructor")
    return kind()


# What numpy itself names when it pickles an array (protocols 0 to 4, and 5) and a scalar; its module moved in numpy 2.
_NUMPY_BUILDERS: dict[str, Any] = {
    "multiarray._reconstruct": np.zeros(1).__reduce__()[0],
    "multiarray.scalar": np.float32(0).__reduce__()[0],
    "numeric._frombuffer": np.zeros(1).__reduce_ex__(5)[0],
}

_ALLOWED: dict[str, Callable[..., Any]] = {
    "numpy.ndarray": np.ndarray,
    "numpy.dtype": np.dtype,
    **{f"numpy.{core}.{name}": builder for core in ("core", "_core") for name, builder in _NUMPY_BUILDERS.items()},
    "_codecs.encode": _latin1_bytes,
    "collections.OrderedDict": OrderedDict,
    "copy_reg._reconstructor": _empty_record,
    "copyreg._reconstructor": _empty_record,
    **{
        f"{module}.{kind.__name__}": kind
        for module in ("__builtin__", "builtins")
        for kind in (bytearray, complex, frozenset, object, set)
    },
}


class RestrictedUnpickler(pickle.Unpickler):
    """Reads arrays and plain containers; `records` are dotted names of classes that come back as `Record`s."""

    def __init__(self, file: IO[bytes], records: Iterable[str] = ()) -> None:
        super().__init__(file, encoding="latin1")
        # One class a load and name: a pickle may set attributes of classes, which must not outlive it.
        self._records = {name: type(name.rpartition(".")[2], (Record,), {}) for name in records}

    def find_class(self, module_name: str, global_name: str) -> Any:
        """What the pickle may use under this name. Raises RefusedGlobalError for all else."""
        name = f"{module_name}.{global_name}"
        found = self._records.get(name) or _ALLOWED.get(name)
        if found is None:
            raise RefusedGlobalError(name)
        return found


def load_pickle(path: Path, records: Iterable[str] = ()) -> Any:
    """Read a pickle of numpy arrays and plain containers.

    Args:
        path: the file; protocols 0 to 5, of Python 2 or 3.
        records: dotted names of foreign classes to read as `Record`, for example `chumpy.ch.Ch`.

    Raises:
        UserError: naming the file and what it asks for beyond that, or that it is damaged or absent.
    """
    with opened(path) as file:
        return RestrictedUnpickler(file, records).load()


def load_npy(path: Path) -> np.ndarray:
    """Read a `.npy` file; what an array of objects holds is read as by `load_pickle`. Raises UserError as it does."""
    with opened(path) as file:
        is_first_version = np.lib.format.read_magic(file) == (1, 0)
        if is_first_version and np.lib.format.read_array_header_1_0(file)[2].hasobject:
            return np.asarray(RestrictedUnpickler(file).load())
        file.seek(0)
        return np.asarray(np.load(file, allow_pickle=False))


@contextmanager
def opened(path: Path) -> Iterator[IO[bytes]]:
    """The open file; whatever unpickling from it can raise becomes a UserError that names it."""
    try:
        with path.open("rb") as file:
            yield file
    except FileNotFoundError:
        raise UserError(f"{path} does not exist; give a file of arrays") from None
    except RefusedGlobalError as refused:
        raise UserError(
            f"{path} is refused: it asks for `{refused}`, and only numpy arrays and plain containers are read; "
            "store the arrays as .npz"
        ) from None
    except _DAMAGE as error:
        raise UserError(f"{path} cannot be read as pickled arrays ({error}); fetch or write it again") from None
