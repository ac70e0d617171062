"""The captures that the rows share: small ones, so that a trial costs about a minute."""

from collections.abc import Mapping
from typing import Any

from data_tools.stress.row import Number, Trial

TURN: Mapping[str, Any] = {"frames": 48, "size": 288, "texture": 1024, "novel_views": 4, "novel_poses": 4}
"""One full turn of the generated person; the novel poses are arms up, a stride, a squat and a wave."""


def turn_trial(label: str, x: Number, options: Mapping[str, Any] | None = None, **settings: Any) -> Trial:
    """Return a trial on `TURN` with other options of the capture, and settings of `procedures.reconstruct`."""
    return Trial(label, x, {"capture": {**TURN, **(options or {})}, **settings})
