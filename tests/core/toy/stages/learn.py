"""A long stage: a chain of steps with a checkpoint after each; it goes on from the last one."""

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
from pipeline.core.stage import Stage
from stages import CONFIG_DIR


class LearnConfig(Config):
    """Options of the toy's second stage."""

    steps: int = Field(20, ge=1, description="steps of the chain")


def run(inputs: Mapping[str, Path], out: Path, config: LearnConfig) -> Mapping[str, float]:
    """Write trail/state.json. TOY_KILL_STEP: the step to be killed at. TOY_SLEEP_S: how long the first step takes."""
    checkpoint = out / "checkpoint.json"
    step, state = json.loads(checkpoint.read_text()) if checkpoint.exists() else (0, 1)
    first = step
    numbers = [int(word) for word in (inputs["read"] / "numbers.txt").read_text().split()]
    while step < config.steps:
        state = (state * 31 + sum(numbers) + step) % 1_000_003
        step += 1
        with atomic_path(checkpoint) as path:
            path.write_text(json.dumps([step, state]))
        (out / f"stray-{step}.txt").write_text("what a kill leaves behind")
        if step == 1:
            time.sleep(float(os.environ.get("TOY_SLEEP_S", "0")))
        if step == int(os.environ.get("TOY_KILL_STEP", "-1")):
            os.kill(os.getpid(), signal.SIGKILL)
        (out / f"stray-{step}.txt").unlink()
    (out / "trail").mkdir()
    (out / "trail" / "state.json").write_text(json.dumps({"state": state, "steps": step}))
    return {"first_step": first}


STAGE = Stage("learn", version=1, needs=("read",), makes=("trail",), config=LearnConfig, run=run)

if __name__ == "__main__":
    raise SystemExit(main(STAGE, config_dir=CONFIG_DIR))
