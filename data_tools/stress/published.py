"""The tables that a document has, by row: a machine that has fewer results of a row than they show keeps them."""

import re
from collections.abc import Mapping
from dataclasses import dataclass

SECTION_START = re.compile(r"^`([a-z-]+)`[,:]", re.MULTILINE)
SUMMARY_LINE = re.compile(r"^\| `([a-z-]+)` \|.*\|$", re.MULTILINE)
ORIGIN = re.compile(r"^Commit [^,]+, (.+); `[^`]+`\.$", re.MULTILINE)
TRIALS = re.compile(r"\| (\d+) of \d+ \|")


@dataclass(frozen=True)
class PublishedRow:
    """A row as a document shows it.

    summary: its line of the summary table. section: its own table with what stands around it, to the next row.
    """

    summary: str
    section: str

    @property
    def trials(self) -> int:
        """Number of finished trials."""
        found = TRIALS.search(self.summary)
        return int(found.group(1)) if found else 0

    @property
    def commits(self) -> list[str]:
        """The commits of its trials, shortened."""
        return [commit.strip() for commit in self.summary.rsplit("|", 2)[1].split(";") if commit.strip()]


@dataclass(frozen=True)
class Published:
    """What a document shows.

    rows: by name. machines: of all trials, as one text; empty if it shows none.
    """

    rows: Mapping[str, PublishedRow]
    machines: str


def read_published(tables: str) -> Published:
    """Read the tables that `tables.write_document` wrote; what is not of their form is left out."""
    end = ORIGIN.search(tables)
    text = tables[: end.start()] if end else tables
    summaries = {found.group(1): found.group(0) for found in SUMMARY_LINE.finditer(text)}
    starts = list(SECTION_START.finditer(text))
    stops = [*(start.start() for start in starts[1:]), len(text)]
    sections = {
        start.group(1): text[start.start() : stop].rstrip() + "\n" for start, stop in zip(starts, stops, strict=False)
    }
    rows = {name: PublishedRow(summaries[name], sections[name]) for name in summaries.keys() & sections.keys()}
    return Published(rows, end.group(1) if end else "")
