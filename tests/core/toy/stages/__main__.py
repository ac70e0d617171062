"""`python -m stages` of the toy pipeline."""

from pipeline.core.cli import main_pipeline

from . import PIPELINE

if __name__ == "__main__":
    raise SystemExit(main_pipeline(PIPELINE, version="toy"))
