"""Events that a stage process sends to the runner: progress of its loops, and its error message.

An event is a JSON text after the record separator (RFC 7464) on a line of standard output. All other lines are output
of the stage or of its libraries.
"""

import json
import os
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

from pipeline.core.progress import listen

EVENTS_VARIABLE = "AVATAR_EVENTS"
"""Environment variable of a process that sends events."""

_RECORD_SEPARATOR = "\x1e"


def send_event(**event: Any) -> None:
    """Send an event to the runner, if it listens."""
    if EVENTS_VARIABLE in os.environ:
        print(_RECORD_SEPARATOR + json.dumps(event), flush=True)


def parse_event(line: str) -> dict[str, Any] | None:
    """Return the event of a line of output, or None for a line that holds none."""
    if not line.startswith(_RECORD_SEPARATOR):
        return None
    event: dict[str, Any] = json.loads(line.removeprefix(_RECORD_SEPARATOR))
    return event


@contextmanager
def send_progress() -> Iterator[None]:
    """Send the progress of all loops of the block to the runner, if it listens."""
    if EVENTS_VARIABLE not in os.environ:
        yield
        return
    with listen(lambda label, done, total: send_event(label=label, done=done, total=total)):
        yield
