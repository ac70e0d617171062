"""Deterministic damage of a valid file: truncation, changed, removed, repeated and inserted bytes."""

from collections.abc import Iterator

import numpy as np

MUTATIONS_PER_FILE = 40
MAX_CHANGED_BYTES = 24
_INTERESTING = (0x00, 0x01, 0x7F, 0x80, 0xFF)


def mutations(content: bytes, count: int = MUTATIONS_PER_FILE, seed: int = 0) -> Iterator[tuple[str, bytes]]:
    """Yield name and content of damaged copies; equal arguments give equal copies."""
    random = np.random.default_rng([seed, len(content)])
    kinds = (_truncate, _flip, _flip_header, _zero_block, _repeat_block, _insert)
    for number in range(count):
        kind = kinds[number % len(kinds)]
        yield f"{kind.__name__.strip('_')} {number}", kind(content, random)


def _truncate(content: bytes, random: np.random.Generator) -> bytes:
    return content[: int(random.integers(0, max(len(content), 1)))]


def _flip(content: bytes, random: np.random.Generator, end: int | None = None) -> bytes:
    """Replace some bytes anywhere, or before `end`."""
    changed = bytearray(content)
    for position in random.integers(0, max(end or len(content), 1), int(random.integers(1, MAX_CHANGED_BYTES))):
        if position < len(changed):
            is_special = random.random() < 0.5
            changed[position] = int(random.choice(_INTERESTING)) if is_special else int(random.integers(0, 256))
    return bytes(changed)


def _flip_header(content: bytes, random: np.random.Generator) -> bytes:
    return _flip(content, random, min(len(content), 256))


def _zero_block(content: bytes, random: np.random.Generator) -> bytes:
    start, size = _block(content, random)
    return content[:start] + bytes(size) + content[start + size :]


def _repeat_block(content: bytes, random: np.random.Generator) -> bytes:
    start, size = _block(content, random)
    return content[: start + size] + content[start:]


def _insert(content: bytes, random: np.random.Generator) -> bytes:
    start, size = _block(content, random)
    return content[:start] + random.bytes(size) + content[start:]


def _block(content: bytes, random: np.random.Generator) -> tuple[int, int]:
    start = int(random.integers(0, max(len(content), 1)))
    return start, int(random.integers(1, max(2, min(512, len(content) - start + 1))))
