"""Alignment of free frames to outlines, on a capsule with a hand in known poses."""

from dataclasses import replace

import numpy as np
import pytest
import torch

from pipeline.body.body import Body, Motion
from pipeline.mesh.outline_alignment import align_outlines
from pipeline.mesh.pose_alignment import AlignedSurface
from pipeline.mesh.pose_selection import merge_poses
from pipeline.mesh.skin_transfer import transfer_skin
from pipeline.mesh.views import PosedView
from tests.mesh.capsule import capsule_body
from tests.mesh.swaying_capsule import FRAMES, disturbed, render_views, swaying_motion

IS_KNOWN = np.arange(FRAMES) % 3 != 1


@pytest.fixture(scope="module")
def body() -> Body:
    return capsule_body()


@pytest.fixture(scope="module")
def surface(body: Body) -> AlignedSurface:
    return AlignedSurface.without_colours(torch.from_numpy(body.vertices), transfer_skin(body.mesh(), body))


@pytest.fixture(scope="module")
def true_motion(body: Body) -> Motion:
    return swaying_motion(body)


@pytest.fixture(scope="module")
def free_views(body: Body, surface: AlignedSurface, true_motion: Motion) -> list[PosedView]:
    views = render_views(body, surface.skin, true_motion)
    return [view for view, known in zip(views, IS_KNOWN, strict=True) if not known]


@pytest.fixture(scope="module")
def motions(true_motion: Motion) -> tuple[Motion, Motion]:
    """Disturbed poses, and the same with the true poses of known frames."""
    fitted, _, _ = disturbed(true_motion)
    return fitted, merge_poses(IS_KNOWN, true_motion, fitted)


def hand_angle_rad(motion: Motion) -> np.ndarray:
    """Turn of the hand about the line of sight in free frames."""
    return 2.0 * np.arcsin(motion.rotations_wxyz[~IS_KNOWN, 1, 3])


def root_xy_m(motion: Motion) -> np.ndarray:
    """Place of the root across the line of sight in free frames."""
    return motion.root_translation_m[~IS_KNOWN, :2]


def test_free_frames_are_moved_to_their_outlines(
    body: Body,
    surface: AlignedSurface,
    free_views: list[PosedView],
    true_motion: Motion,
    motions: tuple[Motion, Motion],
) -> None:
    start = motions[1]
    found = align_outlines(surface, body, motions, IS_KNOWN, free_views)
    for measure, share in ((root_xy_m, 0.2), (hand_angle_rad, 0.7)):
        wanted, before, after = (measure(motion) for motion in (true_motion, start, found))
        assert np.abs(after - wanted).max() < share * np.abs(before - wanted).max(), measure.__name__
    np.testing.assert_array_equal(found.rotations_wxyz[IS_KNOWN], start.rotations_wxyz[IS_KNOWN])
    np.testing.assert_array_equal(found.root_translation_m[IS_KNOWN], start.root_translation_m[IS_KNOWN])


def test_colours_do_not_count(
    body: Body,
    surface: AlignedSurface,
    free_views: list[PosedView],
    motions: tuple[Motion, Motion],
) -> None:
    other_colours = [replace(view, image=255 - view.image) for view in free_views]
    found, again = (align_outlines(surface, body, motions, IS_KNOWN, shown) for shown in (free_views, other_colours))
    np.testing.assert_array_equal(found.rotations_wxyz, again.rotations_wxyz)
    np.testing.assert_array_equal(found.root_translation_m, again.root_translation_m)


def test_without_free_frames_nothing_is_done(body: Body, surface: AlignedSurface, true_motion: Motion) -> None:
    known = np.ones(FRAMES, dtype=bool)
    assert align_outlines(surface, body, (true_motion, true_motion), known, []) is true_motion
