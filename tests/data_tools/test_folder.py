"""Output folders are created atomically."""

import pytest

from data_tools.folder import atomic_folder, require_absent
from pipeline.core.errors import UserError


def test_folder_appears_when_the_block_ends(tmp_path):
    with atomic_folder(tmp_path / "a" / "out") as part:
        (part / "x").write_text("1")
        assert not (tmp_path / "a" / "out").exists()
    assert (tmp_path / "a" / "out" / "x").read_text() == "1"
    assert [path.name for path in (tmp_path / "a").iterdir()] == ["out"]


def test_failed_block_leaves_no_folder_and_no_remains(tmp_path):
    def half() -> None:
        with atomic_folder(tmp_path / "out") as part:
            (part / "old").write_text("1")
            raise ValueError("half")

    with pytest.raises(ValueError, match="half"):
        half()
    assert not (tmp_path / "out").exists()
    with atomic_folder(tmp_path / "out") as part:
        assert not any(part.iterdir())


def test_existing_paths_are_errors(tmp_path):
    (tmp_path / "out").write_text("precious")
    with pytest.raises(UserError, match="already exists"), atomic_folder(tmp_path / "out"):
        pass
    with pytest.raises(UserError, match="already exists"):
        require_absent(tmp_path / "out")
    assert (tmp_path / "out").read_text() == "precious"
