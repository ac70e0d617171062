"""The first toy stage: reads numbers from a text file and refuses words."""

from collections.abc import Mapping
from pathlib import Path

from pydantic import Field

from pipeline.core.cli import main
from pipeline.core.config import Config
from pipeline.core.errors import UserError
from pipeline.core.progress import warn
from pipeline.core.stage import Stage

from . import CONFIG_DIR


class ReadConfig(Config):
    """Options of the first toy stage."""

    modulus: int = Field(1000, ge=2, le=10_000, description="numbers are taken modulo this")


def run(inputs: Mapping[str, Path], out: Path, config: ReadConfig) -> Mapping[str, float]:
    """Write numbers.txt, all numbers reduced."""
    (out / "half.txt").write_text("unfinished")
    words = inputs["video"].read_text().split()
    bad = [word for word in words if not word.isdigit()]
    if bad:
        raise UserError(f"{inputs['video']} holds {bad[0]}, which is not a number: remove it")
    if not words:
        warn("the file is empty")
    (out / "half.txt").unlink()
    (out / "numbers.txt").write_text(" ".join(str(int(word) % config.modulus) for word in words) + "\n")
    return {"count": len(words)}


STAGE = Stage("read", version=1, needs=("video",), makes=("numbers.txt",), config=ReadConfig, run=run)

if __name__ == "__main__":
    raise SystemExit(main(STAGE, config_dir=CONFIG_DIR))
