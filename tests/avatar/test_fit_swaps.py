import itertools

import numpy as np
import pytest

from pipeline.avatar.body import load_anny
from pipeline.avatar.fit_landmarks import PAIRS, POSE_LANDMARKS, mirror_permutation
from pipeline.avatar.fit_swaps import (
    LIMBS,
    exchange_bodies,
    exchange_limbs,
    exchanged_bodies,
    exchanged_limbs,
    two_label_path,
)
from tests.avatar.acting import Act, act
from tests.avatar.test_fit_init import rest_landmarks


@pytest.fixture
def scene() -> Act:
    return act(load_anny(), 40, noise_m=0.01)


def test_path_equals_exhaustive_search() -> None:
    random = np.random.default_rng(0)
    unary, same, other = random.random((7, 2)), random.random(6), random.random(6)

    def cost(labels: tuple[int, ...]) -> float:
        steps = sum((same, other)[int(a != b)][k] for k, (a, b) in enumerate(itertools.pairwise(labels)))
        return steps + sum(unary[k, label] for k, label in enumerate(labels))

    best = min(itertools.product((0, 1), repeat=7), key=cost)
    assert two_label_path(unary, same, other).tolist() == [bool(label) for label in best]


def test_nothing_is_exchanged_in_a_clean_full_turn(scene: Act) -> None:
    observations = scene.observations(scene.camera)
    assert not exchanged_bodies(observations, rest_landmarks()).any()
    for limb in LIMBS:
        assert not exchanged_limbs(observations, limb).any()


@pytest.mark.parametrize("wrong", [slice(14, 19), slice(23, 27)])
def test_a_body_seen_the_wrong_way_round_is_found_and_mended(scene: Act, wrong: slice) -> None:
    truth = scene.observations(scene.camera)
    order = mirror_permutation(PAIRS)[:POSE_LANDMARKS]
    scene.landmarks_px[wrong] = scene.landmarks_px[wrong][:, order]
    scene.landmarks_world_m[wrong] = scene.landmarks_world_m[wrong][:, order] * [1.0, 1.0, -1.0]
    observations = scene.observations(scene.camera)
    exchanged = exchanged_bodies(observations, rest_landmarks())
    assert np.flatnonzero(exchanged).tolist() == list(range(wrong.start, wrong.stop))
    mended = exchange_bodies(observations, exchanged)
    assert np.allclose(mended.landmarks_px, truth.landmarks_px)
    assert np.allclose(mended.directions_m, truth.directions_m)


@pytest.mark.parametrize("limb", list(LIMBS))
def test_exchanged_limbs_are_found_and_mended(scene: Act, limb: str) -> None:
    truth = scene.observations(scene.camera)
    order = mirror_permutation(LIMBS[limb][0])[:POSE_LANDMARKS]
    wrong = slice(0, 4)
    scene.landmarks_px[wrong] = scene.landmarks_px[wrong][:, order]
    scene.landmarks_world_m[wrong] = scene.landmarks_world_m[wrong][:, order]
    observations = scene.observations(scene.camera)
    exchanged = exchanged_limbs(observations, limb)
    assert np.flatnonzero(exchanged).tolist() == [0, 1, 2, 3]
    assert np.allclose(exchange_limbs(observations, exchanged, limb).landmarks_px, truth.landmarks_px)
