"""The last toy stage: one line of text from both earlier stages."""

import json
from collections.abc import Mapping
from pathlib import Path

from pydantic import Field

from pipeline.core.cli import main
from pipeline.core.config import Config
from pipeline.core.errors import UserError
from pipeline.core.stage import Stage

from . import CONFIG_DIR


class SummariseConfig(Config):
    """Options of the last toy stage."""

    word: str = Field("state", min_length=1, description="word before the number")


def run(inputs: Mapping[str, Path], out: Path, config: SummariseConfig) -> Mapping[str, float]:
    """Write summary.txt; refuse a word with other characters than letters, which the configuration allows."""
    if not config.word.isalpha():
        raise UserError(f"summarise.word = {config.word} is not a word: choose letters")
    state = json.loads((inputs["learn"] / "trail" / "state.json").read_text())["state"]
    count = len((inputs["read"] / "numbers.txt").read_text().split())
    (out / "summary.txt").write_text(f"{count} numbers, {config.word} {state}\n")
    return {}


STAGE = Stage("summarise", version=1, needs=("read", "learn"), makes=("summary.txt",), config=SummariseConfig, run=run)

if __name__ == "__main__":
    raise SystemExit(main(STAGE, config_dir=CONFIG_DIR))
