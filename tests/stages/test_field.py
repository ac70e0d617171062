"""The field stage's record of progress; its way from frames to artifacts is walked in tests/test_all.py."""

import csv

from stages.field import Progress


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
