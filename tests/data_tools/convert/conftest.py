"""Warnings of one test are not seen by the next."""

from collections.abc import Iterator

import pytest

from pipeline.core.progress import take_warnings


@pytest.fixture(autouse=True)
def clear_warnings() -> Iterator[None]:
    """Forget what was warned of before and in the test."""
    take_warnings()
    yield
    take_warnings()
