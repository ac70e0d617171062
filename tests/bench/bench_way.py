"""Where the time of a run goes: seconds, CPU seconds, peak memory and bytes of each stage and of the parts of each.

python -m tests.bench.bench_way RUN [--stages frames body] [--json FILE]

The stages of a finished run are run again, each in a process of its own and into a temporary folder; the run is not
changed. Parts are the loops that a stage reports (`pipeline.core.progress.track`): a part begins where the loop before
it ended, so that all parts add up to the stage. The floor is the time in which the machine copies the bytes that the
stage reads and writes: what would be left if nothing were computed.
"""

import argparse
import json
import os
import resource
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path

from pipeline.core.config import Config
from pipeline.core.manifest import read_manifest
from pipeline.core.measure import peak_rss_mib
from pipeline.core.progress import listen
from pipeline.core.record import read_record
from pipeline.core.stage import VIDEO, Stage

START_UP, REST = "start-up and imports", "rest"
"""Parts that are no loops: the interpreter and its imports, and what follows the last loop."""


@dataclass(frozen=True)
class Clock:
    """Wall seconds and CPU seconds (of all threads, and of finished child processes) at one moment."""

    seconds: float
    cpu_seconds: float

    @classmethod
    def now(cls) -> "Clock":
        """Read both."""
        used = [resource.getrusage(who) for who in (resource.RUSAGE_SELF, resource.RUSAGE_CHILDREN)]
        return cls(time.monotonic(), sum(usage.ru_utime + usage.ru_stime for usage in used))


@dataclass(frozen=True)
class Part:
    """Cost of a part of a stage."""

    name: str
    seconds: float
    cpu_seconds: float


@dataclass(frozen=True)
class StageCost:
    """Cost of a stage: parts in order, which add up to it, peak memory (MiB), bytes read and written by the process.

    read_bytes counts what programs asked for, also from the page cache; 0 where the system does not tell.
    """

    stage: str
    parts: tuple[Part, ...]
    peak_mib: float
    read_bytes: int
    written_bytes: int

    @property
    def seconds(self) -> float:
        """Wall seconds of all parts."""
        return sum(part.seconds for part in self.parts)

    @property
    def cpu_seconds(self) -> float:
        """CPU seconds of all parts."""
        return sum(part.cpu_seconds for part in self.parts)


def io_bytes() -> tuple[int, int]:
    """Return the bytes that this process has read and written, see proc_pid_io(5); zeros on other systems."""
    path = Path("/proc/self/io")
    if not path.exists():
        return 0, 0
    fields = dict(line.split(": ") for line in path.read_text().splitlines())
    return int(fields["rchar"]), int(fields["wchar"])


def measure_stage(stage: Stage, inputs: Mapping[str, Path], out: Path, config: Config, start_up: Part) -> StageCost:
    """Run a stage in this process and return its cost; `start_up`: of the process so far."""
    marks: list[tuple[str, Clock]] = []

    def note(label: str, _: int, __: int | None) -> None:
        if marks[-1][0] == label:
            marks.pop()
        marks.append((label, Clock.now()))

    (read_before, written_before), begin = io_bytes(), Clock.now()
    marks.append(("", begin))
    with listen(note):
        stage.run(inputs, out, config)
    marks.append((REST, Clock.now()))
    (read_after, written_after), parts = io_bytes(), [start_up]
    for (_, before), (label, after) in zip(marks[:-1], marks[1:], strict=True):
        parts.append(Part(label, after.seconds - before.seconds, after.cpu_seconds - before.cpu_seconds))
    return StageCost(stage.name, tuple(parts), peak_rss_mib(), read_after - read_before, written_after - written_before)


def measure_here(name: str, run: Path, out: Path, started_s: float) -> StageCost:
    """Run one stage of a finished run with the configuration of its manifest, in this process.

    started_s: when this process was started, `time.monotonic`.
    """
    from stages import load_stage  # here: its time counts

    stage, manifest = load_stage(name), read_manifest(run / name)
    if manifest is None:
        raise SystemExit(f"{run / name} has no manifest: finish the run first")
    names = stage.config.model_fields.keys() & manifest.config.keys()  # an older run may have other options
    config = stage.config(**{key: manifest.config[key] for key in names})
    video = read_record(run).video_path if VIDEO in stage.needs else None
    inputs = {need: video if need == VIDEO and video is not None else run / need for need in stage.needs}
    now = Clock.now()
    return measure_stage(stage, inputs, out, config, Part(START_UP, now.seconds - started_s, now.cpu_seconds))


def measure_run(run: Path, stages: Sequence[str]) -> Iterator[StageCost]:
    """Measure stages of a finished run, each in a new process."""
    for name in stages:
        with tempfile.TemporaryDirectory(dir=run) as folder:
            # The report's title is the name of the folder around its own.
            out = Path(folder) / name
            out.mkdir()
            figures = Path(folder) / "cost.json"
            command = [sys.executable, "-m", "tests.bench.bench_way", str(run), "--one", name, str(out), str(figures)]
            environment = os.environ | {"BENCH_WAY_STARTED_S": repr(time.monotonic())}
            subprocess.run(command, check=True, env=environment)
            values = json.loads(figures.read_text(encoding="utf-8"))
            yield StageCost(**values | {"parts": tuple(Part(**part) for part in values["parts"])})


def format_table(costs: Sequence[StageCost], copy_gb_s: float) -> str:
    """Return the table: a row for each stage and, indented, for each part that takes a hundredth of it or more."""
    lines = [f"{'':34s}{'s':>8s}{'CPU s':>8s}{'MiB':>8s}{'read MB':>9s}{'floor s':>9s}"]
    for cost in costs:
        floor_s = (cost.read_bytes + cost.written_bytes) / (copy_gb_s * 1e9)
        lines.append(
            f"{cost.stage:34s}{cost.seconds:8.1f}{cost.cpu_seconds:8.1f}{cost.peak_mib:8.0f}"
            f"{cost.read_bytes / 1e6:9.0f}{floor_s:9.2f}"
        )
        lines += [
            f"  {part.name:32s}{part.seconds:8.1f}{part.cpu_seconds:8.1f}"
            for part in cost.parts
            if part.seconds >= 0.01 * cost.seconds
        ]
    total_s, total_cpu_s = (sum(values) for values in zip(*((c.seconds, c.cpu_seconds) for c in costs), strict=True))
    peak_mib = max(cost.peak_mib for cost in costs)
    return "\n".join([*lines, f"{'total':34s}{total_s:8.1f}{total_cpu_s:8.1f}{peak_mib:8.0f}"])


def main(argv: Sequence[str]) -> None:
    """Measure the stages of a run, print the table, write its figures."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("run", type=Path, help="folder of a finished run")
    parser.add_argument("--stages", nargs="+", help="stages to measure; default: all")
    parser.add_argument("--json", type=Path, help="file for the figures")
    parser.add_argument("--one", nargs=3, help=argparse.SUPPRESS)
    options = parser.parse_args(argv)
    if options.one:
        name, out, figures = options.one
        started_s = float(os.environ["BENCH_WAY_STARTED_S"])
        cost = measure_here(name, options.run, Path(out), started_s)
        Path(figures).write_text(json.dumps(asdict(cost)), encoding="utf-8")
        return
    from stages import STAGES
    from tests.bench.machine import memory_gb_s

    costs = list(measure_run(options.run, options.stages or STAGES))
    print(format_table(costs, memory_gb_s(repeats=3)))
    if options.json:
        options.json.write_text(json.dumps([asdict(cost) for cost in costs], indent=2) + "\n", encoding="utf-8")


if __name__ == "__main__":
    main(sys.argv[1:])
