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
    before = torch.get_deterministic_debug_mode()
    options: Any = torch.utils.deterministic  # its attributes are hidden from type checkers
    filled = options.fill_uninitialized_memory
    torch.set_deterministic_debug_mode("warn")  # torch.use_deterministic_algorithms would import torch's compiler
    options.fill_uninitialized_memory = False
    try:
        yield
    finally:
        torch.set_deterministic_debug_mode(before)
        options.fill_uninitialized_memory = filled
