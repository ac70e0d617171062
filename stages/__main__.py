"""`python -m stages`: run the whole pipeline on one video."""

from pipeline.core.cli import main_all
from stages import STAGES, load

if __name__ == "__main__":
    raise SystemExit(main_all(STAGES, load))
