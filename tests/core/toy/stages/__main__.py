"""`python -m stages` of the toy pipeline."""

from pipeline.core.cli import main_all
from stages import CONFIG_DIR, STAGES, load

if __name__ == "__main__":
    raise SystemExit(main_all(STAGES, load, config_dir=CONFIG_DIR))
