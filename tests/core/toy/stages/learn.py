"""The second toy stage: a chain of steps that resumes from the checkpoint of its last step."""

import json
import os
import signal
import time
from collections.abc import Mapping
from pathlib import Path

from pydantic import Field

from pipeline.core.atomic import atomic_path
from pipeline.core.cli import main
from pipeline.core.config import Config
from pipeline.core.progress import track
from pipeline.core.stage import Stage

from . import CONFIG_DIR


class LearnConfig(Config):
    """Options of the second toy stage."""

    steps: int = Field(20, ge=1, description="steps of the chain")


def run(inputs: Mapping[str, Path], out: Path, config: LearnConfig) -> Mapping[str, float]:
    """Write trail/state.json. TOY_KILL_STEP: step that kills the process. TOY_SLEEP_S: duration of the first step."""
    checkpoint = out / "checkpoint.json"
    first, state = json.loads(checkpoint.read_text()) if checkpoint.exists() else (0, 1)
    numbers = [int(word) for word in (inputs["read"] / "numbers.txt").read_text().split()]
    for step in track(range(first + 1, config.steps + 1), "learning", config.steps, first):
        state = (state * 31 + sum(numbers) + step - 1) % 1_000_003
        with atomic_path(checkpoint) as path:
            path.write_text(json.dumps([step, state]))
        (out / f"stray-{step}.txt").write_text("left by a kill")
        if step == 1:
            time.sleep(float(os.environ.get("TOY_SLEEP_S", "0")))
        if step == int(os.environ.get("TOY_KILL_STEP", "-1")):
            os.kill(os.getpid(), signal.SIGKILL)
        (out / f"stray-{step}.txt").unlink()
    (out / "trail").mkdir()
    (out / "trail" / "state.json").write_text(json.dumps({"state": state, "steps": config.steps}))
    return {"first_step": first}


STAGE = Stage("learn", version=1, needs=("read",), makes=("trail",), config=LearnConfig, run=run, shows="trail")

if __name__ == "__main__":
    raise SystemExit(main(STAGE, config_dir=CONFIG_DIR))
