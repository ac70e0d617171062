"""The rows of the stress test, by subject. A row needs about ten lines: see `data_tools.stress.rows.light`."""

from data_tools.stress.row import Row
from data_tools.stress.rows.light import LIGHT_ROWS
from data_tools.stress.rows.motion import MOTION_ROWS
from data_tools.stress.rows.robustness import ROBUSTNESS_ROWS
from data_tools.stress.rows.shape import SHAPE_ROWS

ROWS: dict[str, Row] = {row.name: row for row in (*MOTION_ROWS, *SHAPE_ROWS, *LIGHT_ROWS, *ROBUSTNESS_ROWS)}
"""All rows by name, in the order of the tables."""
