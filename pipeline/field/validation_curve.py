"""PSNR of the validation frames over the training time."""

import csv
import shutil
from pathlib import Path

from pipeline.core.manifest import PROGRESS_FILE

MEAN_COLUMNS = ("step", "seconds", "validation_psnr_db", "validation_psnr_body_db")


class ValidationCurve:
    """Table of `MEAN_COLUMNS` and the PSNR of each validation frame (dB), one row per measurement.

    It is kept as a checkpoint file, of which `progress.csv` is a copy at the end.
    """

    def __init__(self, out: Path, completed_steps: int) -> None:
        """Read the rows up to `completed_steps`, the step of the checkpoint that the training resumes from."""
        self.checkpoint_path, self.output_path = out / f"checkpoint_{PROGRESS_FILE}", out / PROGRESS_FILE
        self.rows: list[tuple[float, ...]] = []
        if self.checkpoint_path.exists():
            with self.checkpoint_path.open(newline="", encoding="utf-8") as file:
                rows = [tuple(float(value) for value in row) for row in list(csv.reader(file))[1:]]
            self.rows = [row for row in rows if row[0] <= completed_steps]

    def add(self, step: int, seconds: float, *psnr_db: float) -> None:
        """Add a row: the training time in seconds; mean PSNR of images, of body pixels; PSNR of each frame."""
        self.rows.append((step, round(seconds, 3), *(round(value, 4) for value in psnr_db)))
        frames = range(len(self.rows[0]) - len(MEAN_COLUMNS))
        with self.checkpoint_path.open("w", newline="", encoding="utf-8") as file:
            csv.writer(file).writerows([(*MEAN_COLUMNS, *(f"frame_{frame}_db" for frame in frames)), *self.rows])

    def finish(self) -> None:
        """Write `progress.csv`, if there are rows; the checkpoint file stays, for a stage that is killed after this."""
        if self.rows:
            shutil.copyfile(self.checkpoint_path, self.output_path)
