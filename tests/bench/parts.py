"""Timers for the parts of a training step: functions of the field are wrapped while it runs, without changing it."""

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
from pipeline.field import optimiser as optimiser_module
from pipeline.field import trainer as trainer_module
from pipeline.field.baked_inverse_skinning import BakedInverseSkinning
from pipeline.field.field import _RadianceMlp
from pipeline.field.occupancy import OccupancyGrid
from pipeline.field.optimiser import FieldOptimiser
from pipeline.field.ray_batches import RaySampler
from pipeline.field.trainer import Trainer
from pipeline.kernels.common.thread_pool import ThreadPool
from pipeline.kernels.hashgrid import cpu as hashgrid_cpu
from pipeline.kernels.inverse_skinning import _NewtonStep
from pipeline.kernels.volume_rendering import _CpuRenderer

OTHER = "other"
UPDATE = "occupancy_update"
REBAKE = "rebake"
TIMED_FUNCTIONS: tuple[tuple[str, Any, str], ...] = (
    (OTHER, Trainer, "step"),
    (REBAKE, BakedInverseSkinning, "bake"),
    ("pixel_sampling", RaySampler, "sample_rays"),
    ("pixel_sampling", OccupancyGrid, "sample_empty_points"),
    ("poses", BakedInverseSkinning, "pose_batch"),
    ("render_rays", trainer_module, "render_rays"),
    ("render_rays", trainer_module, "render_rays_with_gradients"),
    ("losses", trainer_module, "field_losses"),
    ("losses", trainer_module, "field_loss_gradients"),
    ("losses", PoseCorrection, "temporal_roughness"),
    ("losses", PoseCorrection, "mean_square_correction"),
    ("render_backward", _RadianceMlp, "backward"),
    ("render_backward", _CpuRenderer, "backward_pass"),
    ("render_backward", hashgrid_cpu, "add_points_gradient"),
    ("render_backward", _NewtonStep, "backward"),
    ("table_backward", hashgrid_cpu, "add_table_gradient"),
    ("rest_backward", FieldOptimiser, "gradients"),
    ("adam", optimiser_module, "adam_step_"),
    ("occupancy_record", OccupancyGrid, "record_observations"),
    (UPDATE, OccupancyGrid, "update"),
    ("skin_grid_crop", BakedInverseSkinning, "crop_skin_grid"),
)


@dataclass
class ThreadTimes:
    """Times of one thread: seconds of each part, the running parts (innermost last), and the last time stamp."""

    seconds: dict[str, float] = field(default_factory=partial(defaultdict, float))
    running: list[str] = field(default_factory=list)
    since: float = 0.0


class PartTimer:
    """Measures the seconds of each part. Time is charged to the innermost running part.

    Exceptions: an update of the occupancy includes the kernels that it calls; parts that threads run concurrently
    share the elapsed time.
    """

    def __init__(self, now: Callable[[], float] = time.perf_counter) -> None:
        self._now, self._thread_local = now, threading.local()
        self._thread_times = ThreadTimes()

    @property
    def _thread_times(self) -> ThreadTimes:
        return self._thread_local.times

    @_thread_times.setter
    def _thread_times(self, times: ThreadTimes) -> None:
        self._thread_local.times = times

    def timed(self, part: str, function: Callable[..., Any]) -> Callable[..., Any]:
        """Return the function with its time charged to `part`."""

        @wraps(function)
        def run(*arguments: Any, **named: Any) -> Any:
            if self._thread_times.running and self._thread_times.running[-1] == UPDATE:
                return function(*arguments, **named)
            self._charge_elapsed()
            self._thread_times.running.append(part)
            try:
                return function(*arguments, **named)
            finally:
                self._charge_elapsed()
                self._thread_times.running.pop()

        return run

    def timed_parallel_map(self, part: str, map_jobs: Callable[..., Any]) -> Callable[..., Any]:
        """Return `ThreadPool.map` with its elapsed time divided in proportion to the times of its jobs."""

        @wraps(map_jobs)
        def run(threads: Any, function: Callable[..., Any], *arguments: Any) -> Any:
            thread_times: list[ThreadTimes] = []

            def job(*job_arguments: Any) -> Any:
                outside = getattr(self._thread_local, "times", None)
                self._thread_times = ThreadTimes()
                thread_times.append(self._thread_times)
                try:
                    return self.timed(part, function)(*job_arguments)
                finally:
                    self._thread_times = outside or ThreadTimes()

            self._charge_elapsed()
            start_seconds = self._thread_times.since
            results = map_jobs(threads, job, *arguments)
            self._thread_times.since = self._now()
            total_job_seconds = sum(sum(times.seconds.values()) for times in thread_times)
            for times in thread_times:
                for name, seconds in times.seconds.items():
                    self._thread_times.seconds[name] += (
                        seconds * (self._thread_times.since - start_seconds) / (total_job_seconds or 1.0)
                    )
            return results

        return run

    def pop_seconds(self) -> dict[str, float]:
        """Return the seconds of each part since the last call, in the calling thread."""
        taken, self._thread_times.seconds = self._thread_times.seconds, defaultdict(float)
        return taken

    def _charge_elapsed(self) -> None:
        times, now = self._thread_times, self._now()
        if times.running:
            times.seconds[times.running[-1]] += now - times.since
        times.since = now


@contextmanager
def timed_parts(clock: PartTimer) -> Iterator[None]:
    """Within this context `clock` measures the parts of every step of a `Trainer` that is created in it."""
    with ExitStack() as stack:

        def wrap(target: Any, name: str, change: Callable[[Any], Any]) -> None:
            is_static = isinstance(inspect.getattr_static(target, name), staticmethod)
            changed = change(getattr(target, name))
            stack.enter_context(mock.patch.object(target, name, staticmethod(changed) if is_static else changed))

        for part, target, name in TIMED_FUNCTIONS:
            wrap(target, name, partial(clock.timed, part))
        wrap(ThreadPool, "map", partial(clock.timed_parallel_map, OTHER))
        yield
