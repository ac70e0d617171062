"""Sums of torch in an order that does not depend on the timing of threads."""

from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

import torch


@contextmanager
def deterministic_sums() -> Iterator[None]:
    """Make equal inputs give equal bits; also as a decorator.

    On a CPU one operation of torch adds in an arbitrary order: the gradient of indexing, from 32,768 elements and two
    threads on. The fixed order is not slower (docs/decisions/engineering.md). Operations of CUDA for which torch has no
    deterministic form warn and stay as they are.
    """
    before = torch.are_deterministic_algorithms_enabled(), torch.is_deterministic_algorithms_warn_only_enabled()
    options: Any = torch.utils.deterministic  # its attributes are hidden from type checkers
    filled = options.fill_uninitialized_memory
    torch.use_deterministic_algorithms(True, warn_only=True)
    options.fill_uninitialized_memory = False
    try:
        yield
    finally:
        torch.use_deterministic_algorithms(before[0], warn_only=before[1])
        options.fill_uninitialized_memory = filled
