"""Each recording that must be refused, and each that may pass with a warning, as numbers."""

import dataclasses
from pathlib import Path

import numpy as np
import pytest

from pipeline.avatar.hands import no_hands
from pipeline.core.errors import UserError
from pipeline.core.progress import take_warnings
from pipeline.io.screening import refuse_bad_input, warn_of_gaps
from pipeline.io.sightings import Sightings

PATH = Path("clip.mp4")


@pytest.fixture
def good() -> Sightings:
    n = 20
    return Sightings(
        frame_index=np.arange(n, dtype=np.int32),
        time_s=np.arange(n) / 30,
        found=np.ones(n, bool),
        n_people=np.where(np.arange(n) % 4 == 0, 1, -1).astype(np.int32),
        grays=np.full((n, 20, 20), 100, np.uint8),
        persons=np.ones((n, 20, 20), bool),
        landmarks_px=np.full((n, 33, 2), 50, np.float32),
        landmarks_visibility=np.ones((n, 33), np.float32),
        landmarks_world_m=np.zeros((n, 33, 3), np.float32),
        hands=no_hands(n),
        masks_png=(b"",) * n,
        width=100,
        height=100,
        scale=1.0,
    )


def changed(good: Sightings, name: str, where, value) -> Sightings:
    array = getattr(good, name).copy()
    array[where] = value
    return dataclasses.replace(good, **{name: array})


def test_a_good_recording_passes_without_a_word(good):
    refuse_bad_input(good, PATH, 16)
    warn_of_gaps(good, 0.5, PATH)
    assert take_warnings() == []


@pytest.mark.parametrize(
    ("name", "where", "value", "message"),
    [
        ("grays", slice(None), 3, "all frames of clip.mp4 are black"),
        ("n_people", [4, 8], 3, r"several people \(for example in frame 4\)"),
        ("found", slice(None), False, "no person was found"),
        ("found", slice(5, None), False, "only 5 of 20 frames"),
        ("landmarks_px", (slice(0, 11), [27, 28], 1), 120.0, "cut off above the feet in 11 of 20 frames"),
        ("landmarks_visibility", (slice(3, 20), [27, 28]), 0.01, "cut off .* in 17 of 20 frames .frame 3 first"),
    ],
)
def test_what_makes_no_avatar_is_refused(good, name, where, value, message):
    with pytest.raises(UserError, match=message):
        refuse_bad_input(changed(good, name, where, value), PATH, 16)


@pytest.mark.parametrize(
    ("name", "where", "value"),
    [
        ("n_people", 4, 2),
        ("found", slice(17, None), False),
        ("landmarks_px", (slice(0, 9), [27, 28], 1), 120.0),
        ("landmarks_px", (slice(None), 27, 1), 120.0),
        ("grays", slice(0, 19), 0),
    ],
)
def test_what_is_bearable_passes(good, name, where, value):
    refuse_bad_input(changed(good, name, where, value), PATH, 16)


@pytest.mark.parametrize(
    ("name", "where", "value", "unseen_rad", "message"),
    [
        ("found", [2, 3], False, 0.5, "2 of 20 frames of clip.mp4 show no person"),
        ("landmarks_px", (slice(0, 4), 31, 1), 101.0, 0.5, "feet are cut off in 4 frames"),
        ("found", [], False, np.pi, "never seen from 180 degrees"),
    ],
)
def test_what_the_run_goes_on_without_is_said(good, name, where, value, unseen_rad, message):
    warn_of_gaps(changed(good, name, where, value), unseen_rad, PATH)
    assert [message in warning for warning in take_warnings()] == [True]
