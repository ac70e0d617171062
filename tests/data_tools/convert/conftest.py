"""Clear the warnings before each test."""

from collections.abc import Iterator

import pytest

from pipeline.core.progress import take_warnings


@pytest.fixture(autouse=True)
def clear_warnings() -> Iterator[None]:
    """Clear the warnings before and after the test."""
    take_warnings()
    yield
    take_warnings()
