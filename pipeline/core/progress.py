"""Progress on long loops and warnings that a run goes on with; both go to standard error."""

import sys
import time
from collections.abc import Iterable, Iterator, Sized
from typing import TypeVar

from tqdm import tqdm

Item = TypeVar("Item")

LOG_INTERVAL_S = 10.0

_warnings: list[str] = []


def track(iterable: Iterable[Item], label: str, total: int | None = None, initial: int = 0) -> Iterator[Item]:
    """Yield the items of `iterable` while showing how far the loop is.

    label: what the loop does, a few words.
    total: number of items; taken from `len(iterable)` where that exists.
    initial: items done before this loop, when work goes on from a checkpoint (counted in `total`).

    A terminal sees a bar; a log file sees a line every ten seconds.
    """
    if total is None and isinstance(iterable, Sized):
        total = initial + len(iterable)
    if sys.stderr.isatty():
        yield from tqdm(iterable, desc=label, total=total, initial=initial, leave=False, dynamic_ncols=True)
    else:
        yield from _track_to_log(iterable, label, total, initial)


def _track_to_log(iterable: Iterable[Item], label: str, total: int | None, initial: int) -> Iterator[Item]:
    """Yield the items; print a line when `LOG_INTERVAL_S` have passed since the last one."""
    start = last = time.monotonic()
    for done, item in enumerate(iterable, start=1):
        yield item
        now = time.monotonic()
        if now - last >= LOG_INTERVAL_S:
            last = now
            count = f"{initial + done}/{total}" if total else f"{initial + done}"
            remaining_text = f", {(now - start) / done * (total - initial - done):.0f} s left" if total else ""
            print(f"{label}: {count}{remaining_text}", file=sys.stderr, flush=True)


def warn(message: str) -> None:
    """Say what the run goes on without; the message also goes into the stage's manifest."""
    _warnings.append(message)
    tqdm.write(f"warning: {message}", file=sys.stderr)


def take_warnings() -> list[str]:
    """Return the warnings since the last call, and forget them."""
    messages = list(_warnings)
    _warnings.clear()
    return messages
