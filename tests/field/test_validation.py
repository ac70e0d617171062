import numpy as np
import pytest

from pipeline.body.body import canonical_to_world
from pipeline.field.rendering import render_field
from pipeline.field.trainer import Learning
from pipeline.field.validation import Judge
from pipeline.metrics.images import on_white, premultiplied_on_white
from tests.field.scene import painted_scene
from tests.field.test_trainer import begin

HELD = np.array([2, 5])


@pytest.fixture(scope="module")
def scene():
    return painted_scene(12, 110)


@pytest.fixture(scope="module")
def learning(scene) -> Learning:
    learning = begin(scene, steps=60, pose_refinement=False)
    for _ in range(60):
        learning.step()
    return learning


@pytest.fixture(scope="module")
def judge(scene) -> Judge:
    return Judge(scene.motion.select(HELD), scene.camera, [(scene.images[row], scene.masks[row]) for row in HELD])


def test_thinned_pictures_are_pixels_of_the_whole_ones(judge: Judge, learning: Learning):
    thin = judge.thinned()
    poses = judge.pose(learning, refined=False)
    whole, few = judge.render(learning, poses)[0], thin.render(learning, poses)[0]
    sides = few.shape[:2]
    picked = whole[2::5, 2::5][: sides[0], : sides[1]].astype(int)
    assert np.array_equal(thin.truths[0][0], judge.truths[0][0][2::5, 2::5][: sides[0], : sides[1]])
    # The same rays but for rounding; a sample that falls to the other side of a cell's wall changes a pixel or two.
    assert np.quantile(np.abs(few - picked), 0.99) <= 2


def test_a_thinned_score_is_that_of_the_pixels_it_keeps(judge: Judge, learning: Learning):
    thin = judge.thinned()
    poses = judge.pose(learning, refined=False)
    kept = [render[2::5, 2::5][: thin.camera.height, : thin.camera.width] for render in judge.render(learning, poses)]
    assert thin.score(thin.render(learning, poses)) == pytest.approx(thin.score(kept), abs=0.2)


def test_frames_share_their_poses_and_not_their_pictures(scene, judge: Judge, learning: Learning):
    poses, skin = judge.pose(learning, refined=False), learning.scene.skin
    for row, render in enumerate(judge.render(learning, poses)):
        alone = Judge(judge.motion.select(np.array([row])), judge.camera, judge.truths[row : row + 1])
        assert np.array_equal(alone.render(learning, alone.pose(learning, refined=False))[0], render)
        pose = canonical_to_world(scene.body, judge.motion)[row]
        drawn = render_field(learning.field, learning.occupancy.grid(), scene.body, pose, scene.camera, skin)
        assert np.array_equal(premultiplied_on_white(drawn.numpy()), render)


def test_the_truth_itself_scores_without_end_and_nothing_scores_nan(judge: Judge):
    assert judge.score([on_white(*truth) for truth in judge.truths]) == (np.inf, np.inf)
    assert all(np.isnan(Judge(judge.motion.select(np.zeros(0, int)), judge.camera, []).score([])))
