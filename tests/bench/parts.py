"""Where the time of a training step goes: a clock at the seams of stage one, which stays as it is."""

import inspect
import time
from collections import defaultdict
from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager
from dataclasses import replace
from functools import partial, wraps
from typing import Any
from unittest import mock

import torch

from pipeline.avatar import train
from pipeline.avatar.field import _Decode
from pipeline.avatar.occupancy import OccupancyUpdate
from pipeline.avatar.pose import PoseCorrection
from pipeline.avatar.train import Learning
from pipeline.kernels import hashgrid_cpu
from pipeline.kernels.composite import _Composite
from pipeline.kernels.hashgrid import _Encode
from pipeline.kernels.warp import _Newton

OTHER = "other"
UPDATE = "occupancy_update"
REBAKE = "rebake"
SEAMS: tuple[tuple[str, Any, str], ...] = (
    (OTHER, Learning, "step"),
    (REBAKE, Learning, "_bake"),
    ("draw", Learning, "_draw"),
    ("draw", Learning, "_empty_points"),
    ("place", Learning, "_place"),
    ("encode_forward", _Encode, "forward"),
    ("network_forward", _Decode, "forward"),
    ("composite", _Composite, "forward"),
    ("composite", _Composite, "backward"),
    ("losses", train, "field_losses"),
    ("losses", PoseCorrection, "roughness"),
    ("losses", PoseCorrection, "size"),
    ("network_backward", _Decode, "backward"),
    ("table_backward", hashgrid_cpu, "add_table_gradient"),
    ("positions_backward", hashgrid_cpu, "add_points_gradient"),
    ("positions_backward", _Newton, "backward"),
    ("rest_backward", torch.Tensor, "backward"),
    ("adam", train, "adam_step_"),
    ("occupancy_record", train, "light_before"),
    ("occupancy_record", OccupancyUpdate, "record"),
    (UPDATE, OccupancyUpdate, "update"),
    ("skin_cut", Learning, "_follow_occupancy"),
)


class Clock:
    """Seconds of each part. A moment counts for the innermost part that runs; only an update of the occupancy keeps the
    time of the kernels that it calls.
    """

    def __init__(self, now: Callable[[], float] = time.perf_counter) -> None:
        self._now, self._since = now, 0.0
        self._running: list[str] = []
        self._seconds: dict[str, float] = defaultdict(float)

    def timed(self, part: str, function: Callable[..., Any]) -> Callable[..., Any]:
        """The function, its time counted as that of `part`."""

        @wraps(function)
        def run(*arguments: Any, **named: Any) -> Any:
            if self._running and self._running[-1] == UPDATE:
                return function(*arguments, **named)
            self._turn()
            self._running.append(part)
            try:
                return function(*arguments, **named)
            finally:
                self._turn()
                self._running.pop()

        return run

    def take(self) -> dict[str, float]:
        """Seconds of each part since the last call."""
        taken, self._seconds = self._seconds, defaultdict(float)
        return taken

    def _turn(self) -> None:
        now = self._now()
        if self._running:
            self._seconds[self._running[-1]] += now - self._since
        self._since = now


@contextmanager
def watched(clock: Clock) -> Iterator[None]:
    """While it lasts, `clock` counts the parts of every step of a `Learning` that was begun in it."""
    with ExitStack() as stack:

        def wrap(owner: Any, name: str, change: Callable[[Any], Any]) -> None:
            is_static = isinstance(inspect.getattr_static(owner, name), staticmethod)
            changed = change(getattr(owner, name))
            stack.enter_context(mock.patch.object(owner, name, staticmethod(changed) if is_static else changed))

        for part, owner, name in SEAMS:
            wrap(owner, name, partial(clock.timed, part))
        wrap(train, "invert_motion", partial(_timed_march, clock))
        yield


def _timed_march(clock: Clock, invert: Callable[..., Any]) -> Callable[..., Any]:
    def invert_and_watch(*arguments: Any) -> Any:
        inverse = invert(*arguments)
        return replace(inverse, sample=clock.timed("march", inverse.sample))

    return invert_and_watch
