"""The field stage's record of progress; its way from frames to artifacts is walked in tests/test_all.py."""

import csv
from unittest import mock

import numpy as np
import pytest

from pipeline.avatar.field_config import FieldConfig
from pipeline.avatar.judge import Judge
from pipeline.avatar.train import Learning
from stages.field import Progress, learn


def rows_of(path):
    with path.open(newline="", encoding="utf-8") as file:
        return list(csv.DictReader(file))


def test_progress_goes_on_where_the_checkpoint_is(tmp_path):
    first = Progress(tmp_path, done=0)
    first.add(10, 1.5, 20.0, 15.0)
    first.add(20, 3.0, 22.0, 16.0)
    # Killed after step 20; the checkpoint is of step 15, so that step 20 is made and scored again.
    second = Progress(tmp_path, done=15)
    second.add(20, 0.7, 22.5, 16.5)
    second.add(40, 4.0, 24.0, 18.0)
    second.finish()
    rows = rows_of(tmp_path / "progress.csv")
    assert [float(row["step"]) for row in rows] == [10, 20, 40]
    assert [float(row["seconds"]) for row in rows] == [1.5, 2.2, 5.5]
    assert [float(row["validation_psnr_db"]) for row in rows] == [20.0, 22.5, 24.0]
    assert [path.name for path in tmp_path.iterdir()] == ["progress.csv"]


def test_without_scores_there_is_no_file(tmp_path):
    Progress(tmp_path, done=0).finish()
    assert not list(tmp_path.iterdir())


def curve(folder, *looks):
    """A record whose looks come every 100 steps; each is the score of every frame."""
    progress = Progress(folder, done=0)
    for index, frames in enumerate(looks):
        progress.add(100 * (index + 1), float(index), float(np.mean(frames)), 0.0, *frames)
    return progress


def test_a_curve_settles_when_two_gains_drown_in_their_noise(tmp_path):
    flat = [30.0, 28.0, 31.0], [30.1, 27.9, 31.0], [30.0, 28.05, 30.95]
    assert curve(tmp_path, *flat).has_settled(100)
    assert not curve(tmp_path, *flat).has_settled(200)
    assert not curve(tmp_path, *flat[:2]).has_settled(0)
    # Small gains, but of every frame; and one large gain among two.
    assert not curve(tmp_path, *flat[:2], [30.13, 27.94, 31.03]).has_settled(0)
    assert not curve(tmp_path, [29.0, 27.0, 30.0], *flat[:2]).has_settled(0)
    # A look that found less than the one before counts as no gain.
    assert curve(tmp_path, *flat[:2], [29.5, 27.5, 30.5]).has_settled(0)
    # Noise as of a sample: a tenth of a decibel is less than 0.19 / sqrt(3).
    assert curve(tmp_path, [30.0, 28.0, 31.0], [30.29, 27.91, 31.1], [30.58, 27.82, 31.2]).has_settled(0)
    # One frame says nothing of noise.
    assert not curve(tmp_path, [30.0], [30.0], [30.0]).has_settled(0)


def test_a_settled_curve_is_known_after_a_restart(tmp_path):
    looks = [30.0, 28.0], [30.1, 27.9], [30.0, 28.05]
    curve(tmp_path, *looks)
    assert Progress(tmp_path, done=300).has_settled(100)
    rows = rows_of(tmp_path / "checkpoint_progress.csv")
    assert [float(rows[1][f"frame_{frame}_db"]) for frame in range(2)] == [30.1, 27.9]


@pytest.mark.parametrize(("early_stop", "steps"), [(True, 24), (False, 32)])
def test_learning_ends_once_it_has_settled(tmp_path, early_stop, steps):
    learning = mock.MagicMock(
        spec=Learning, done=0, refines_poses=True, config=FieldConfig(steps=32, early_stop=early_stop)
    )

    def step():
        learning.done += 1

    learning.step.side_effect = step
    judge = mock.MagicMock(spec=Judge, truths=[None, None])
    judge.thinned.return_value = judge
    judge.score.return_value, judge.frame_scores.return_value = (30.0, 25.0), [29.0, 31.0]
    learn(learning, judge, tmp_path)
    # Looks after a half, five and six eighths: two that found nothing new.
    assert learning.done == steps
    assert [float(row["step"]) for row in rows_of(tmp_path / "progress.csv")][-1] == steps
