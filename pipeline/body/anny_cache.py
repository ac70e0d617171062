"""Construct Anny, whose arrays are built from a thousand text files once on a machine and cached.

The library writes its cache without a lock and straight to the final name, so that an interrupted first run leaves a
damaged file; and it parses numbers one by one, a minute of processor time. Here one process builds the cache, in a
folder beside the final one, with a parser that reads a file at once.
"""

import gzip
import hashlib
import json
import os
import shutil
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from importlib.metadata import version
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import torch
from filelock import FileLock
from jaxtyping import Float

from pipeline.core.errors import UserError
from pipeline.kernels.common.thread_pool import torch_threads

if TYPE_CHECKING:
    import anny

FOLDER_VARIABLE = "ANNY_CACHE_DIR"
"""Environment variable of the cache folder, which is the library's own."""
DEFAULT_FOLDER = Path(".cache") / "anny"
"""Below the home folder, as in the library."""
TARGET_COLUMNS = 4
"""Numbers in a line of a blend shape: index of the vertex and its displacement, in decimetres."""


def cache_folder() -> Path:
    """Return the folder of the cache."""
    named = os.environ.get(FOLDER_VARIABLE)
    return Path(named) if named else Path.home() / DEFAULT_FOLDER


def is_complete(options: Mapping[str, Any]) -> bool:
    """Return whether the cache has all that `construct_anny` reads."""
    return _marker(options).exists()


def construct_anny(options: Mapping[str, Any]) -> "anny.Anny":
    """Return `anny.Anny(**options)`; if its cache is not complete, build it, or wait for the process that does.

    Raises:
        UserError: the cache folder cannot be written, or a file in it is damaged.
    """
    import anny  # not at the top: the import takes seconds
    from anny.paths import set_anny_cache_path
    from safetensors import SafetensorError

    folder, marker = cache_folder(), _marker(options)
    set_anny_cache_path(folder)
    if not marker.exists():
        try:
            folder.mkdir(parents=True, exist_ok=True)
            with FileLock(folder / ".lock"):
                if not marker.exists():
                    _build(folder, options)
                    marker.touch()
        except OSError as error:
            raise UserError(
                f"{folder}: {error.strerror}: the body model is cached there: name another folder with "
                f"{FOLDER_VARIABLE}=FOLDER"
            ) from error
    try:
        return anny.Anny(**options)
    except SafetensorError as error:
        raise UserError(f"{folder} is damaged ({error}): remove this folder and run the same command again") from error


def _marker(options: Mapping[str, Any]) -> Path:
    digest = hashlib.sha256(json.dumps(options, sort_keys=True).encode()).hexdigest()[:16]
    return cache_folder() / f"complete-{version('anny')}-{digest}"


def _build(folder: Path, options: Mapping[str, Any]) -> None:
    """Build the cache in a folder of its own, and move the model to the cache when it is complete.

    What is written before the model are its parts, 780 MB that nothing reads afterwards. One thread builds it: the
    rounding of the library's singular value decomposition depends on their number, and every later run on the model.
    """
    import anny
    from anny.paths import set_anny_cache_path

    part = folder / "unfinished"
    shutil.rmtree(part, ignore_errors=True)
    part.mkdir()
    set_anny_cache_path(part)
    try:
        with _fast_parser(), torch_threads(1):
            anny.Anny(**options)
    finally:
        set_anny_cache_path(folder)
    model = max(part.rglob("*.safetensors"), key=lambda path: path.stat().st_mtime_ns)
    target = folder / model.relative_to(part)
    target.parent.mkdir(exist_ok=True)
    model.replace(target)
    shutil.rmtree(part)


@contextmanager
def _fast_parser() -> Iterator[None]:
    """Replace the library's parser of blend shapes inside the block."""
    from anny.models import full_model

    original = full_model.load_blend_shape
    full_model.load_blend_shape = load_blend_shape
    try:
        yield
    finally:
        full_model.load_blend_shape = original


def load_blend_shape(filename: str, vertices_count: int, world_transformation: Any, dtype: torch.dtype) -> torch.Tensor:
    """Read a blend shape as `anny.models.full_model.load_blend_shape`, which defines it, in a hundredth of the time.

    Args:
        filename: gzip of lines `vertex x y z`.
        world_transformation: `roma` transformation from decimetres of the file to metres of the model.

    Returns:
        Displacement of each vertex, m, [v, 3].

    Raises:
        ValueError: a line has not four numbers, or a vertex does not exist.
    """
    with gzip.open(filename, "rt") as archive:
        displacements_dm = parse_target(archive.read(), vertices_count, filename)
    moved: torch.Tensor = world_transformation.apply(torch.from_numpy(displacements_dm).to(dtype))
    return moved


def parse_target(text: str, vertices_count: int, source: str) -> Float[np.ndarray, "v 3"]:
    """Return the displacement of each vertex, in the unit of the text: lines `vertex x y z`, others do not move.

    source: of the text, for errors.

    Raises:
        ValueError: a line has not four numbers, or a vertex does not exist.
    """
    numbers = np.fromstring(text, sep=" ").reshape(-1, TARGET_COLUMNS)
    indices = numbers[:, 0].astype(np.int64)
    if len(indices) and not (indices.min() >= 0 and indices.max() < vertices_count):
        raise ValueError(f"{source} names a vertex that does not exist")
    displacements = np.zeros((vertices_count, 3))
    displacements[indices] = numbers[:, 1:]
    return displacements
