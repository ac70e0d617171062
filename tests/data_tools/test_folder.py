"""Folders are whole or absent."""

import pytest

from data_tools.folder import atomic_folder, require_absent
from pipeline.core.errors import UserError


def test_a_folder_appears_when_its_work_is_done(tmp_path):
    with atomic_folder(tmp_path / "a" / "out") as part:
        (part / "x").write_text("1")
        assert not (tmp_path / "a" / "out").exists()
    assert (tmp_path / "a" / "out" / "x").read_text() == "1"
    assert [path.name for path in (tmp_path / "a").iterdir()] == ["out"]


def test_what_broke_off_leaves_no_folder_and_does_not_mix_with_the_next(tmp_path):
    def half() -> None:
        with atomic_folder(tmp_path / "out") as part:
            (part / "old").write_text("1")
            raise ValueError("half")

    with pytest.raises(ValueError, match="half"):
        half()
    assert not (tmp_path / "out").exists()
    with atomic_folder(tmp_path / "out") as part:
        assert not any(part.iterdir())


def test_nothing_is_overwritten(tmp_path):
    (tmp_path / "out").write_text("precious")
    with pytest.raises(UserError, match="already exists"), atomic_folder(tmp_path / "out"):
        pass
    with pytest.raises(UserError, match="already exists"):
        require_absent(tmp_path / "out")
    assert (tmp_path / "out").read_text() == "precious"
