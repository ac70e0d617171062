"""Progress of long loops, and warnings about which the user should know although the run continues.

Both go to standard error. A listener receives the progress as well: the runner uses one to report to its caller.
"""

import sys
import time
from collections.abc import Callable, Iterable, Iterator, Sized
from contextlib import contextmanager
from typing import Any, TextIO, TypeVar

from tqdm import tqdm

Item = TypeVar("Item")
LoopListener = Callable[[str, int, int | None], None]
"""Called with the label of a loop, its finished items, and their total (None if unknown)."""

LOG_INTERVAL_S = 10.0
LISTENER_INTERVAL_S = 0.2

_warnings: list[str] = []
_listeners: list[LoopListener] = []


def track(iterable: Iterable[Item], label: str, total: int | None = None, initial: int = 0) -> Iterator[Item]:
    """Yield the items of `iterable` and show the progress: a bar on a terminal, a line every 10 s in a log file.

    Args:
        label: what the loop does, a few words.
        total: number of items; default `len(iterable)` where it exists.
        initial: items that were done before this loop, when work resumes from a checkpoint (counted in `total`).
    """
    if total is None and isinstance(iterable, Sized):
        total = initial + len(iterable)
    last_report_s = -LISTENER_INTERVAL_S
    for done, item in enumerate(_progress_bar(iterable, label, total, initial), start=initial + 1):
        yield item
        if _listeners and (done == total or time.monotonic() - last_report_s >= LISTENER_INTERVAL_S):
            last_report_s = time.monotonic()
            for listener in _listeners:
                listener(label, done, total)


def warn(message: str) -> None:
    """Print a warning, once for each text; the manifest of the stage records it as well."""
    if message in _warnings:
        return
    _warnings.append(message)
    tqdm.write(f"warning: {message}", file=sys.stderr)


def take_warnings() -> list[str]:
    """Return the warnings since the last call, and clear them."""
    messages = list(_warnings)
    _warnings.clear()
    return messages


@contextmanager
def listen(listener: LoopListener) -> Iterator[None]:
    """Report the loops of the block to `listener`, at most every `LISTENER_INTERVAL_S` and after the last item."""
    _listeners.append(listener)
    try:
        yield
    finally:
        _listeners.remove(listener)


class _LogLines:
    """File for tqdm that writes each state of the bar as a line of its own."""

    def __init__(self, file: TextIO) -> None:
        self._file = file

    def write(self, text: str) -> None:
        """Write the text without the characters that move the cursor."""
        line = text.strip()
        if line:
            self._file.write(f"{line}\n")

    def flush(self) -> None:
        """Flush the log."""
        self._file.flush()


def _progress_bar(iterable: Iterable[Item], label: str, total: int | None, initial: int) -> "tqdm[Item]":
    if sys.stderr.isatty():
        style: dict[str, Any] = {"dynamic_ncols": True}
    else:
        style = {
            "file": _LogLines(sys.stderr),
            "mininterval": LOG_INTERVAL_S,
            "delay": LOG_INTERVAL_S,
            "bar_format": "{desc}: {n_fmt}/{total_fmt} [{elapsed}<{remaining}]",
        }
    return tqdm(iterable, desc=label, total=total, initial=initial, leave=False, **style)
