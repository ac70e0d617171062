"""A file appears complete or not at all."""

from pathlib import Path

import numpy as np
import pytest

from pipeline.core.atomic import atomic_path


def test_the_file_appears_at_the_end(tmp_path: Path) -> None:
    target = tmp_path / "state.json"
    with atomic_path(target) as path:
        path.write_text("new")
        assert not target.exists()
    assert target.read_text() == "new"
    assert list(tmp_path.iterdir()) == [target]


def test_a_failure_leaves_the_old_file(tmp_path: Path) -> None:
    target = tmp_path / "state.json"
    target.write_text("old")

    def write_half() -> None:
        with atomic_path(target) as path:
            path.write_text("half")
            raise ZeroDivisionError

    with pytest.raises(ZeroDivisionError):
        write_half()
    assert target.read_text() == "old"
    assert list(tmp_path.iterdir()) == [target]


def test_the_suffix_is_kept_for_the_writer(tmp_path: Path) -> None:
    with atomic_path(tmp_path / "checkpoint.npz") as path:
        np.savez(path, step=3)
    assert np.load(tmp_path / "checkpoint.npz")["step"] == 3
