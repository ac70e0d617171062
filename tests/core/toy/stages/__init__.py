"""A three-stage pipeline on numbers, for the tests of the runner: the same shape as the real `stages`."""

from importlib import import_module
from pathlib import Path

from pipeline.core.stage import Stage

STAGES = ("read", "learn", "tell")
CONFIG_DIR = Path(__file__).resolve().parents[1] / "configs"


def load(name: str) -> Stage:
    """Import one toy stage."""
    stage: Stage = import_module(f"stages.{name}").STAGE
    return stage
