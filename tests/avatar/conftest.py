"""The built-in body in its default shape."""

import pytest

from pipeline.body.body import Body, load_anny


@pytest.fixture(scope="session")
def bare() -> Body:
    model = load_anny()
    return model.at_shape(model.shape_defaults)
