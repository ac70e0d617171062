"""Similarity transforms: a known one is recovered from points and inverted."""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from pipeline.geometry.similarity import SimilarityTransform, fit_similarity

TRUE_TRANSFORM = SimilarityTransform(
    1.07, Rotation.from_rotvec([0.1, -0.2, 0.15]).as_matrix(), np.array([0.3, -0.1, 2.0])
)


@pytest.fixture
def rng() -> np.random.Generator:
    return np.random.default_rng(0)


def test_the_fit_recovers_the_transform_of_corresponding_points(rng: np.random.Generator):
    points = rng.normal(size=(40, 3))
    found = fit_similarity(points, TRUE_TRANSFORM(points))
    assert found.scale == pytest.approx(TRUE_TRANSFORM.scale)
    assert found.rotation == pytest.approx(TRUE_TRANSFORM.rotation)
    assert found.translation_m == pytest.approx(TRUE_TRANSFORM.translation_m)
    mirrored = fit_similarity(points, points * [-1.0, 1.0, 1.0])
    assert np.linalg.det(mirrored.rotation) == pytest.approx(1.0)  # a reflection is not a rotation


def test_without_scale_the_scale_is_one(rng: np.random.Generator):
    points = rng.normal(size=(40, 3))
    found = fit_similarity(points, TRUE_TRANSFORM(points), with_scale=False)
    assert found.scale == 1.0
    assert found.rotation == pytest.approx(TRUE_TRANSFORM.rotation)


def test_inverse_inverts(rng: np.random.Generator):
    points = rng.normal(size=(5, 3))
    assert TRUE_TRANSFORM.inverse()(TRUE_TRANSFORM(points)) == pytest.approx(points)
