"""Give every hostile file of one kind to its readers, with bounded memory and time, and count what goes wrong.

A reader may return or refuse the file with one sentence (UserError). Everything else is a fault: another exception,
more memory or time than the limits, a file that code in it made, the content of a foreign file.
"""

import resource
import sys
import time
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

from data_tools.stress.hostile.bombs import MARKER, SECRET, bombs
from data_tools.stress.hostile.mutations import MUTATIONS_PER_FILE, mutations
from data_tools.stress.hostile.readers import READERS, Reader
from data_tools.stress.hostile.valid_files import valid_files
from pipeline.core.errors import UserError
from pipeline.core.measure import peak_rss_mib

ADDRESS_SPACE_BYTES = 6 << 30
"""What a reader may map beyond what the process has mapped already; allocations above it fail."""

MAX_SECONDS, MAX_GROWTH_MIB = 20.0, 1024.0
"""Limits of one file; seconds of the processor, which do not depend on what else the machine does."""

SECRET_TEXT = b"the content of a foreign file"


@dataclass(frozen=True)
class Fault:
    """A file that a reader neither read nor refused in one sentence."""

    case: str
    problem: str


def hostile_scores(folder: Path, reader: str, count: int = MUTATIONS_PER_FILE) -> dict[str, float]:
    """Return the number of files, of refusals and of faults, seconds of the slowest file and growth of the memory.

    Faults are printed. The limits apply to this process, which should end afterwards.

    Args:
        folder: for the files.
        reader: name in `READERS`.
        count: damaged copies of the valid file.
    """
    folder.mkdir(parents=True, exist_ok=True)
    (folder / SECRET).write_bytes(SECRET_TEXT)
    kind, name, readers = READERS[reader]
    faults: list[Fault] = []
    valid = valid_files().get(kind, b"")
    # Before the limits, so that imports and caches are not growth.
    accepted = [not any(_attempt(read, folder / name, valid)) for read in readers]
    if valid and not any(accepted):
        faults.append(Fault("the valid file", "every reader refuses it, so the damaged ones test nothing"))
    _limit_address_space()
    start_mib, refused, slowest_s, cases = peak_rss_mib(), 0, 0.0, 0
    for case, content in hostile_files(kind, count):
        for read in readers:
            cases += 1
            start = time.process_time()
            problem, is_refused = _attempt(read, folder / name, content)
            seconds = time.process_time() - start
            refused, slowest_s = refused + is_refused, max(slowest_s, seconds)
            if seconds > MAX_SECONDS:
                problem = f"{seconds:.0f} s"
            if list(folder.rglob(MARKER)) or Path(MARKER).exists():
                problem = "its code was run"
            if problem:
                faults.append(Fault(f"{case}, {getattr(read, '__name__', 'reader')}", problem))
    for fault in faults:
        print(f"fault: {reader}, {fault.case}: {fault.problem}", file=sys.stderr)
    return {
        "files": float(cases),
        "refused": float(refused),
        "faults": float(len(faults)),
        "slowest_s": slowest_s,
        "growth_mib": max(0.0, peak_rss_mib() - start_mib),
    }


def hostile_files(kind: str, count: int) -> Iterator[tuple[str, bytes]]:
    """Yield name and content of all hostile files of a kind."""
    yield from bombs(kind)
    content = valid_files().get(kind)
    if content is not None:
        yield from mutations(content, count)


def _attempt(read: Reader, path: Path, content: bytes) -> tuple[str, bool]:
    """Return what is wrong (empty: nothing), and whether the file was refused."""
    path.write_bytes(content)
    try:
        read(path)
    except UserError as error:
        text = str(error)
        if SECRET_TEXT.decode() in text:
            return "the message shows a foreign file", True
        return ("" if "\n" not in text.strip() and len(text) < 2000 else "the message is no sentence"), True
    except Exception as error:  # noqa: BLE001 - every other exception is a fault, whatever its type
        return f"{type(error).__name__}: {str(error)[:200]}", False
    return "", False


def _limit_address_space() -> None:
    """Let allocations beyond `ADDRESS_SPACE_BYTES` fail, so that a claim cannot exhaust the machine. Linux only."""
    status = Path("/proc/self/statm")
    if status.is_file():
        mapped = int(status.read_text().split()[0]) * resource.getpagesize()
        resource.setrlimit(resource.RLIMIT_AS, (mapped + ADDRESS_SPACE_BYTES, resource.RLIM_INFINITY))
