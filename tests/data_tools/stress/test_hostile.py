"""Every reader of user files refuses damaged and malicious files in one sentence, in bounded time and memory."""

from pathlib import Path

import pytest

from data_tools.stress.hostile import run
from data_tools.stress.hostile.bombs import MARKER, SECRET
from data_tools.stress.hostile.mutations import mutations
from data_tools.stress.hostile.readers import READERS
from data_tools.stress.hostile.run import SECRET_TEXT, hostile_files
from data_tools.stress.hostile.valid_files import valid_files
from pipeline.core.errors import UserError

SLOW_READERS = ("pickle", "smpl-model", "people-snapshot")
"""Their bombs have a million nested lists; `tests/io/test_safe_pickle.py` has the short ones."""

NAMES = [pytest.param(name, marks=pytest.mark.slow if name in SLOW_READERS else ()) for name in READERS]


@pytest.mark.parametrize("name", NAMES)
def test_hostile_files_are_refused_in_one_sentence(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, name: str) -> None:
    monkeypatch.chdir(tmp_path)
    (tmp_path / SECRET).write_bytes(SECRET_TEXT)
    kind, file, readers = READERS[name]
    faults = {
        case: problem
        for case, content in hostile_files(kind, count=12)
        for read in readers
        if (problem := run._attempt(read, tmp_path / file, content)[0])
    }
    assert faults == {}
    assert not list(tmp_path.rglob(MARKER))


@pytest.mark.parametrize("name", [name for name, (kind, _, _) in READERS.items() if kind in valid_files()])
def test_the_valid_file_is_read(tmp_path: Path, name: str) -> None:
    """Otherwise the damaged ones test nothing."""
    kind, file, (read, *_) = READERS[name]
    assert run._attempt(read, tmp_path / file, valid_files()[kind]) == ("", False)


def test_mutations_are_reproducible_and_differ() -> None:
    content = bytes(range(256)) * 4
    first, second = (dict(mutations(content, 24)) for _ in range(2))
    assert first == second
    assert len(set(first.values()) | {content}) > 20


def test_faults_are_counted(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def broken(path: Path) -> None:
        if path.stat().st_size == 0:
            raise KeyError("empty")
        raise UserError("no")

    monkeypatch.setattr(run, "READERS", {"broken": ("none", "file", (broken,))})
    monkeypatch.setattr(run, "_limit_address_space", lambda: None)
    scores = run.hostile_scores(tmp_path, "broken", count=2)
    assert (scores["files"], scores["refused"], scores["faults"]) == (2.0, 1.0, 1.0)


@pytest.mark.parametrize("error", [UserError("one\ntwo"), UserError("x" * 3000), UserError(SECRET_TEXT.decode())])
def test_a_message_is_one_short_sentence_without_foreign_content(tmp_path: Path, error: UserError) -> None:
    def refuse(path: Path) -> None:
        raise error

    assert run._attempt(refuse, tmp_path / "a", b"")[0]
