"""Edge padding keeps what is known and adds no foreign colours."""

import numpy as np
from hypothesis import given, settings
from hypothesis import strategies as st

from pipeline.texture.edge_padding import fill_unknown_texels


@settings(max_examples=25)
@given(st.integers(0, 2**31), st.integers(3, 40), st.integers(3, 40))
def test_known_texels_stay_and_bound_the_others(seed: int, height: int, width: int) -> None:
    random = np.random.default_rng(seed)
    image = random.uniform(0.2, 0.8, (height, width, 3)).astype(np.float32)
    known = random.uniform(size=(height, width)) < 0.2
    known[random.integers(height), random.integers(width)] = True
    filled = fill_unknown_texels(np.where(known[..., None], image, 7.0).astype(np.float32), known)
    np.testing.assert_array_equal(filled[known], image[known])
    assert np.all(filled >= image[known].min(axis=0) - 1e-4)
    assert np.all(filled <= image[known].max(axis=0) + 1e-4)


def test_texels_next_to_a_chart_take_its_colour() -> None:
    image, known = np.zeros((64, 64, 3), dtype=np.float32), np.zeros((64, 64), dtype=bool)
    image[:, :20], image[:, 40:] = (1.0, 0.0, 0.0), (0.0, 0.0, 1.0)
    known[:, :20] = known[:, 40:] = True
    filled = fill_unknown_texels(image, known)
    np.testing.assert_allclose(filled[:, 20:22], np.broadcast_to([1.0, 0.0, 0.0], (64, 2, 3)), atol=1e-6)
    np.testing.assert_allclose(filled[:, 38:40], np.broadcast_to([0.0, 0.0, 1.0], (64, 2, 3)), atol=1e-6)
    assert 0.2 < filled[32, 30, 0] < 0.8
