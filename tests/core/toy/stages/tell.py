"""The last toy stage: one sentence from both before it."""

import json
from collections.abc import Mapping
from pathlib import Path

from pydantic import Field

from pipeline.core.cli import main
from pipeline.core.config import Config
from pipeline.core.stage import Stage
from stages import CONFIG_DIR


class TellConfig(Config):
    """Options of the toy's last stage."""

    word: str = Field("state", min_length=1, description="the word before the number")


def run(inputs: Mapping[str, Path], out: Path, config: TellConfig) -> Mapping[str, float]:
    """Write story.txt."""
    state = json.loads((inputs["learn"] / "trail" / "state.json").read_text())["state"]
    count = len((inputs["read"] / "numbers.txt").read_text().split())
    (out / "story.txt").write_text(f"{count} numbers, {config.word} {state}\n")
    return {}


STAGE = Stage("tell", version=1, needs=("read", "learn"), makes=("story.txt",), config=TellConfig, run=run)

if __name__ == "__main__":
    raise SystemExit(main(STAGE, config_dir=CONFIG_DIR))
