"""JSON of users: bounded in size and depth."""

from pathlib import Path

import pytest

from pipeline.core import json_file
from pipeline.core.json_file import load_json, parse_json


def test_values_come_back(tmp_path: Path) -> None:
    (tmp_path / "a.json").write_text('{"a": [1, 2.5, null, "ä"]}', encoding="utf-8")
    assert load_json(tmp_path / "a.json") == {"a": [1, 2.5, None, "ä"]}


@pytest.mark.parametrize("text", [b"", b"{", b"[" * 1_000_000, b'{"a":' * 1_000_000, b"\xff\xfe{}", b"9" * 5000])
def test_other_content_is_a_value_error(text: bytes) -> None:
    with pytest.raises(ValueError, match=r"."):
        parse_json(text)


def test_a_large_file_is_refused_before_it_is_read(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    (tmp_path / "a.json").write_text("[1, 2, 3]")
    monkeypatch.setattr(json_file, "MAX_JSON_BYTES", 8)
    with pytest.raises(ValueError, match="at most 8"):
        load_json(tmp_path / "a.json")


def test_a_missing_file_is_an_os_error(tmp_path: Path) -> None:
    with pytest.raises(FileNotFoundError):
        load_json(tmp_path / "a.json")
