"""Variables of `make` reach the commands as they are written."""

import os
import shlex
import subprocess
from pathlib import Path

import pytest

REPOSITORY_DIR = Path(__file__).resolve().parents[1]


def planned_command(*arguments: str) -> list[str]:
    """The words of the last command that `make` would run, whatever `make` runs this test."""
    environment = {name: value for name, value in os.environ.items() if not name.startswith(("MAKE", "MFLAGS"))}
    done = subprocess.run(
        ["make", "-n", *arguments],
        cwd=REPOSITORY_DIR,
        env=environment,
        capture_output=True,
        text=True,
        timeout=60,
        check=True,
    )
    return shlex.split(done.stdout.replace("\\\n", " ").splitlines()[-1])


@pytest.mark.parametrize("target", ["all", "mesh", "chart", "batch"])
def test_values_with_characters_of_the_shell_are_one_word(target: str) -> None:
    url, note, preset = "export.licence_url=https://x.org/l?a=1&b=2;c", "export.author=O'Neil", "my presets/a&b.yaml"
    words = planned_command(target, f"SET={url} {note}", f"PRESET={preset}", "RUN=runs/a", "VIDEOS=videos")
    assert [words[place + 1] for place, word in enumerate(words) if word == "--set"] == [url, note]
    if target != "chart":  # its PRESETS are a list of names
        assert words[words.index("--preset") + 1] == preset


def test_the_options_of_a_workflow_are_one_word_with_the_quotes_of_its_shell() -> None:
    words = planned_command("batch", "CLUSTER=local", "VIDEOS=videos", "SET=a.b=1&2$$x", "PRESET=a b")
    options = next(word for word in words if word.startswith("options="))
    assert shlex.split(options.removeprefix("options=")) == ["--preset", "a b", "--set", "a.b=1&2$x"]
