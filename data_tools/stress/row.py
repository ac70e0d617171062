"""A row of the stress test: one failure, a sweep of trials, and a pass line."""

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from typing import Any

Scores = Mapping[str, float]
Number = int | float

DONE, REFUSED, FAILED, MISSING = "done", "refused", "failed", "not run"
"""States of a trial: scores were measured; the program refused the input in one sentence; it failed in another way
(a fault of the program, never a pass); not run yet, or not possible on this machine."""

EXIT_CANNOT_RUN = 3
"""Exit status of the process of a trial that raised `CannotRunError`."""


class CannotRunError(Exception):
    """This machine lacks what a trial needs, which says nothing about the program; the message says what and how."""


@dataclass(frozen=True, eq=False)
class Trial:
    """One point of a sweep.

    Attributes:
        label: in the tables, with unit.
        x: position on the axis of the figure.
        procedure: name in `data_tools.stress.procedures.PROCEDURES`.
        settings: keyword arguments of the procedure; JSON values.
    """

    label: str
    x: Number
    settings: Mapping[str, Any] = field(default_factory=dict)
    procedure: str = "reconstruct"


@dataclass(frozen=True)
class TrialResult:
    """What a trial gave.

    Attributes:
        state: one of `DONE`, `REFUSED`, `FAILED`, `MISSING`.
        scores: by name; empty unless done.
        message: of a refusal or failure; one line.
        warnings: of all stages.
        seconds: of the trial, without the capture where that was made before.
        commit, machine: where it ran.
    """

    state: str
    scores: Scores = field(default_factory=dict)
    message: str = ""
    warnings: tuple[str, ...] = ()
    seconds: float = 0.0
    commit: str = ""
    machine: str = ""

    def warns_of(self, words: str) -> bool:
        """Return whether a warning or the refusal contains these words."""
        return any(words in text for text in (*self.warnings, self.message))


Results = Mapping[str, TrialResult]
"""Results by the label of the trial, in the order of the sweep."""


@dataclass(frozen=True, eq=False)
class Row:
    """One failure.

    Attributes:
        name: in the command, tables and figure.
        failure: what goes wrong, and the range of the sweep.
        line: the pass line in words.
        trials: the sweep; labels are distinct.
        crossed: returns a sentence for each trial that crosses the pass line; it sees only finished trials, and an
            input that was refused only if `may_refuse`.
        score, unit: score that is drawn, and its unit.
        preset: of all trials.
        may_refuse: whether a refusal in one sentence is a pass.
        missing: parts of the failure that have no trial, in words.
    """

    name: str
    failure: str
    line: str
    trials: tuple[Trial, ...]
    crossed: Callable[[Results], list[str]]
    score: str
    unit: str
    preset: str = "stress"
    may_refuse: bool = False
    missing: str = ""

    def verdict(self, results: Results) -> tuple[str, list[str]]:
        """Return pass, crossed or incomplete, and the sentences of what was crossed."""
        finished = {label: result for label, result in results.items() if result.state != MISSING}
        accepted = (DONE, REFUSED) if self.may_refuse else (DONE,)
        found = [f"{label}: {r.state}, {r.message}" for label, r in finished.items() if r.state not in accepted]
        judged = {label: result for label, result in finished.items() if result.state in accepted}
        found += self.crossed(judged) if judged else []
        if found:
            return "crossed", found
        if len(finished) < len(self.trials):
            return ("incomplete" if finished else MISSING), []
        return "pass", []


def bounded(score: str, low: float | None = None, high: float | None = None) -> Callable[[Results], list[str]]:
    """Return a pass line: the score of each trial is at least `low` and at most `high`."""

    def crossed(results: Results) -> list[str]:
        sentences = []
        for label, result in results.items():
            value = result.scores.get(score, float("nan"))
            if result.state == DONE and not _within(value, low, high):
                sentences.append(f"{label}: {score} {value:.4g}")
        return sentences

    return crossed


def bounded_change(
    reference: str, changes: Mapping[str, tuple[float | None, float | None]]
) -> Callable[..., list[str]]:
    """Return a pass line: each score minus that of the trial `reference` is within (low, high).

    changes: bounds by score; None: none.
    """

    def crossed(results: Results) -> list[str]:
        base = results.get(reference)
        if base is None or base.state != DONE:
            return []
        sentences = []
        for label, result in results.items():
            for score, (low, high) in changes.items():
                change = result.scores.get(score, float("nan")) - base.scores.get(score, float("nan"))
                if result.state == DONE and not _within(change, low, high):
                    sentences.append(f"{label}: {score} {change:+.3g} from {reference}")
        return sentences

    return crossed


def all_of(*lines: Callable[[Results], list[str]]) -> Callable[[Results], list[str]]:
    """Return a pass line that holds if all lines hold."""
    return lambda results: [sentence for line in lines for sentence in line(results)]


def _within(value: float, low: float | None, high: float | None) -> bool:
    """Return whether a value is in the range; nan is not."""
    return value == value and (low is None or value >= low) and (high is None or value <= high)
