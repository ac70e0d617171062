"""Variables of `make` reach the commands as they are written."""

import shlex
import subprocess
from pathlib import Path

import pytest

REPOSITORY_DIR = Path(__file__).resolve().parents[1]


@pytest.mark.parametrize("target", ["all", "mesh", "chart", "batch"])
def test_values_with_characters_of_the_shell_are_one_word(target: str) -> None:
    url, note, preset = "export.licence_url=https://x.org/l?a=1&b=2;c", "export.author=O'Neil", "my presets/a&b.yaml"
    variables = [f"SET={url} {note}", f"PRESET={preset}", "RUN=runs/a", "VIDEOS=videos"]
    done = subprocess.run(
        ["make", "-n", target, *variables], cwd=REPOSITORY_DIR, capture_output=True, text=True, timeout=60, check=True
    )
    words = shlex.split(done.stdout.splitlines()[-1], posix=True)
    assert [words[place + 1] for place, word in enumerate(words) if word == "--set"] == [url, note]
    if target != "chart":  # its PRESETS are a list of names
        assert words[words.index("--preset") + 1] == preset


def test_the_options_of_a_workflow_are_one_word_with_the_quotes_of_its_shell() -> None:
    command = ["make", "-n", "batch", "CLUSTER=local", "VIDEOS=videos", "SET=a.b=1&2$$x", "PRESET=a b"]
    done = subprocess.run(command, cwd=REPOSITORY_DIR, capture_output=True, text=True, timeout=60, check=True)
    words = shlex.split(done.stdout.replace("\\\n", " ").splitlines()[-1])
    options = next(word for word in words if word.startswith("options="))
    assert shlex.split(options.removeprefix("options=")) == ["--preset", "a b", "--set", "a.b=1&2$x"]
