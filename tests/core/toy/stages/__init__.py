"""A three-stage pipeline on numbers for the tests of the runner, with the same structure as the real `stages`."""

from pathlib import Path

from pipeline.core.pipeline import Pipeline
from pipeline.core.stage import Stage

STAGES = ("read", "learn", "summarise")
CONFIG_DIR = Path(__file__).resolve().parents[1] / "configs"
PIPELINE = Pipeline(__name__, STAGES, CONFIG_DIR)


def load_stage(name: str) -> Stage:
    """Import one toy stage."""
    return PIPELINE.load_stage(name)
