"""Arrays as npz files without pickles; equal arrays give equal bytes."""

from __future__ import annotations

import lzma
import math
import tokenize
import zipfile
import zlib
from collections.abc import Collection, Mapping
from pathlib import Path
from typing import Any

import numpy as np

from pipeline.core.errors import UserError

MAX_NPZ_BYTES = 4 << 30
"""Arrays of one file together: 2,000 masks of 1080 x 1920 px. More is refused before memory is allocated for it."""

_ZIP_EPOCH = (1980, 1, 1, 0, 0, 0)
_SUFFIX = ".npy"
_HEADER_READERS = {(1, 0): np.lib.format.read_array_header_1_0, (2, 0): np.lib.format.read_array_header_2_0}
_MAX_REASON_LENGTH = 160

# What zipfile, its decompressors and numpy raise for damaged files; RuntimeError: encrypted; TokenError: header.
_DAMAGE = (
    OSError,
    ValueError,
    EOFError,
    KeyError,
    RuntimeError,
    NotImplementedError,
    OverflowError,
    zipfile.BadZipFile,
    zlib.error,
    lzma.LZMAError,
    tokenize.TokenError,
)


def save_npz(path: Path, arrays: Mapping[str, np.ndarray]) -> None:
    """Write arrays by name. (`numpy.savez` would store the current time in the archive.)"""
    with zipfile.ZipFile(path, "w") as archive:
        for name in sorted(arrays):
            info = zipfile.ZipInfo(f"{name}{_SUFFIX}", _ZIP_EPOCH)
            info.compress_type = zipfile.ZIP_DEFLATED  # the archive's own applies to no member that comes with its info
            with archive.open(info, "w", force_zip64=True) as member:
                np.lib.format.write_array(member, np.asarray(arrays[name], order="C"), allow_pickle=False)


def load_npz(path: Path) -> dict[str, np.ndarray]:
    """Read all arrays into memory; members of the archive that are no `.npy` files are ignored.

    Raises:
        UserError: as `read_npz` raises ValueError.
    """
    try:
        return read_npz(path)
    except ValueError as error:
        raise UserError(
            f"{path} cannot be read as npz arrays ({error}); run the stage that writes it again, or write it again "
            "with numpy.savez"
        ) from error


def read_npz(path: Path, names: Collection[str] | None = None) -> dict[str, np.ndarray]:
    """Read the named arrays, those that exist; None: all.

    The size that the header of an array claims must be that of its member, so that a few bytes cannot claim gigabytes.

    Raises:
        ValueError: the file is missing or damaged, is not an npz archive, or these arrays are pickled objects or larger
            than `MAX_NPZ_BYTES`; the message is a short reason.
    """
    try:
        with zipfile.ZipFile(path) as archive:
            found = {info.filename.removesuffix(_SUFFIX): info for info in archive.infolist() if _is_array(info)}
            chosen = {name: info for name, info in found.items() if names is None or name in names}
            total = sum(info.file_size for info in chosen.values())
            if total > MAX_NPZ_BYTES:
                raise ValueError(f"its arrays have {total} bytes, at most {MAX_NPZ_BYTES} are read")
            return {name: _read_member(archive, info) for name, info in chosen.items()}
    except _DAMAGE as error:
        raise ValueError(" ".join(str(error).split())[:_MAX_REASON_LENGTH]) from error


def _is_array(info: zipfile.ZipInfo) -> bool:
    return info.filename.endswith(_SUFFIX)


def _read_member(archive: zipfile.ZipFile, info: zipfile.ZipInfo) -> np.ndarray:
    with archive.open(info) as file:
        _check_claim(file, info)
    with archive.open(info) as file:
        array: np.ndarray = np.lib.format.read_array(file, allow_pickle=False)
        return array


def _check_claim(file: Any, info: zipfile.ZipInfo) -> None:
    """Raise ValueError if the header of an array does not claim the bytes that follow it."""
    version = np.lib.format.read_magic(file)
    if version not in _HEADER_READERS:
        raise ValueError(f"{info.filename} is of version {version}")
    shape, _, dtype = _HEADER_READERS[version](file)
    _require_plain(dtype, info.filename)
    claimed, held = math.prod(shape) * dtype.itemsize, info.file_size - file.tell()
    if min(shape, default=0) < 0 or claimed != held:
        raise ValueError(f"{info.filename} claims shape {shape}, which does not fit its {held} bytes")


def _require_plain(dtype: np.dtype[Any], name: str) -> None:
    if dtype.hasobject:
        raise ValueError(f"{name} holds pickled objects")
