"""Where the time of a training step goes: a clock at the seams of stage one, which stays as it is."""

import inspect
import threading
import time
from collections import defaultdict
from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass, field
from functools import partial, wraps
from typing import Any
from unittest import mock

from pipeline.body.pose_correction import PoseCorrection
from pipeline.field import trainer as train
from pipeline.field.field import _Decode
from pipeline.field.occupancy import OccupancyUpdate
from pipeline.field.trainer import Learning
from pipeline.field.volume_rendering import Placing
from pipeline.kernels.common.thread_pool import Parallel
from pipeline.kernels.hashgrid import cpu as hashgrid_cpu
from pipeline.kernels.inverse_skinning import _Newton, newton_cpu
from pipeline.kernels.volume_rendering import _Trace

OTHER = "other"
UPDATE = "occupancy_update"
REBAKE = "rebake"
SEAMS: tuple[tuple[str, Any, str], ...] = (
    (OTHER, Learning, "step"),
    (REBAKE, Learning, "_bake"),
    ("draw", Learning, "_draw"),
    ("draw", OccupancyUpdate, "should_be_empty"),
    ("place", Learning, "_placing"),
    ("place", Placing, "blended"),
    ("look", train, "look"),
    ("losses", train, "field_losses"),
    ("losses", PoseCorrection, "roughness"),
    ("losses", PoseCorrection, "size"),
    ("network_backward", _Decode, "backward"),
    ("network_backward", _Trace, "backward"),
    ("table_backward", hashgrid_cpu, "add_table_gradient"),
    ("positions_backward", hashgrid_cpu, "add_points_gradient"),
    ("positions_backward", _Newton, "backward"),
    ("positions_backward", newton_cpu, "pose_gradient"),
    ("rest_backward", Learning, "_gradients"),
    ("adam", train, "adam_step_"),
    ("occupancy_record", OccupancyUpdate, "record"),
    (UPDATE, OccupancyUpdate, "update"),
    ("skin_cut", Learning, "_follow_occupancy"),
)


@dataclass
class Tally:
    """What one thread has done: seconds of each part, those that run now, the innermost last, and since when."""

    seconds: dict[str, float] = field(default_factory=partial(defaultdict, float))
    running: list[str] = field(default_factory=list)
    since: float = 0.0


class Clock:
    """Seconds of each part. A moment counts for the innermost part that runs; only an update of the occupancy keeps the
    time of the kernels that it calls. What threads do at the same time shares the time that this takes.
    """

    def __init__(self, now: Callable[[], float] = time.perf_counter) -> None:
        self._now, self._of_thread = now, threading.local()
        self._tally = Tally()

    @property
    def _tally(self) -> Tally:
        return self._of_thread.tally

    @_tally.setter
    def _tally(self, tally: Tally) -> None:
        self._of_thread.tally = tally

    def timed(self, part: str, function: Callable[..., Any]) -> Callable[..., Any]:
        """The function, its time counted as that of `part`."""

        @wraps(function)
        def run(*arguments: Any, **named: Any) -> Any:
            if self._tally.running and self._tally.running[-1] == UPDATE:
                return function(*arguments, **named)
            self._turn()
            self._tally.running.append(part)
            try:
                return function(*arguments, **named)
            finally:
                self._turn()
                self._tally.running.pop()

        return run

    def shared(self, part: str, map_jobs: Callable[..., Any]) -> Callable[..., Any]:
        """`Parallel.map`, each job begun as `part`. Its whole time is divided as the jobs' own times are."""

        @wraps(map_jobs)
        def run(threads: Any, function: Callable[..., Any], *arguments: Any) -> Any:
            tallies: list[Tally] = []

            def job(*of_job: Any) -> Any:
                outside = getattr(self._of_thread, "tally", None)
                self._tally = Tally()
                tallies.append(self._tally)
                try:
                    return self.timed(part, function)(*of_job)
                finally:
                    self._tally = outside or Tally()

            self._turn()
            begun = self._tally.since
            answers = map_jobs(threads, job, *arguments)
            self._tally.since = self._now()
            own = sum(sum(tally.seconds.values()) for tally in tallies)
            for tally in tallies:
                for name, seconds in tally.seconds.items():
                    self._tally.seconds[name] += seconds * (self._tally.since - begun) / (own or 1.0)
            return answers

        return run

    def take(self) -> dict[str, float]:
        """Seconds of each part since the last call, in the thread that steps."""
        taken, self._tally.seconds = self._tally.seconds, defaultdict(float)
        return taken

    def _turn(self) -> None:
        tally, now = self._tally, self._now()
        if tally.running:
            tally.seconds[tally.running[-1]] += now - tally.since
        tally.since = now


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
        wrap(Parallel, "map", partial(clock.shared, OTHER))
        yield
