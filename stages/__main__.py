"""Command `instant-human-mesh`, also `python -m stages`: run the whole pipeline on one video, or one stage of a run."""

import os

from pipeline.core.cli import main_pipeline
from pipeline.core.command import COMMAND_VARIABLE
from stages import PIPELINE, __version__


def console_main() -> int:
    """Run the console command; return the exit status."""
    os.environ.setdefault(COMMAND_VARIABLE, "instant-human-mesh")
    return main_pipeline(PIPELINE, version=__version__)


if __name__ == "__main__":
    raise SystemExit(main_pipeline(PIPELINE, version=__version__))
