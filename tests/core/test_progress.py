"""Progress: all items pass; a terminal shows a bar, a log lines, a listener the counts."""

import pytest

from pipeline.core import progress


def test_all_items_pass_unchanged() -> None:
    assert list(progress.track([3, 1, 2], "counting")) == [3, 1, 2]
    assert list(progress.track(iter("abc"), "spelling")) == ["a", "b", "c"]


def test_a_log_gets_lines_with_the_remaining_time(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr(progress, "LOG_INTERVAL_S", 0.0)
    assert len(list(progress.track(range(2), "fitting", total=5, initial=3))) == 2
    first, *_, last = capsys.readouterr().err.splitlines()
    assert first.startswith("fitting: 3/5 [")
    assert last == "fitting: 5/5 [00:00<00:00]"


def test_a_listener_gets_the_counts() -> None:
    calls: list[tuple[str, int, int | None]] = []
    with progress.listen(lambda *call: calls.append(call)):
        list(progress.track(range(2), "fitting", total=5, initial=3))
    list(progress.track(range(2), "fitting"))
    assert calls == [("fitting", 4, 5), ("fitting", 5, 5)]


def test_a_quick_loop_says_nothing(capsys: pytest.CaptureFixture[str]) -> None:
    list(progress.track(range(100), "quick"))
    assert capsys.readouterr().err == ""


def test_a_terminal_gets_a_bar(monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> None:
    monkeypatch.setattr(progress.sys.stderr, "isatty", lambda: True, raising=False)
    assert list(progress.track(range(3), "drawing")) == [0, 1, 2]
    assert "drawing" in capsys.readouterr().err


def test_warnings_are_printed_and_collected(capsys: pytest.CaptureFixture[str]) -> None:
    progress.take_warnings()
    progress.warn("2 frames are dark and are left out")
    assert "warning: 2 frames are dark and are left out" in capsys.readouterr().err
    assert progress.take_warnings() == ["2 frames are dark and are left out"]
    assert progress.take_warnings() == []
