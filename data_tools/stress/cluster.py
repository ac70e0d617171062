"""A batch on a real Slurm: eight videos, of which one is broken, and a node that is lost in the middle."""

import shutil
import subprocess
import sys
from collections.abc import Mapping
from pathlib import Path

from data_tools.stress.captures import make_capture
from data_tools.stress.interruption import differing_files
from data_tools.stress.row import CannotRunError
from data_tools.stress.slurm import NAMESPACE, SlurmCluster, node_cpus, slurm_cluster, wait_until
from pipeline.core.manifest import MANIFEST_FILE
from pipeline.core.measure import REPOSITORY_DIR
from stages import STAGES

PRESET = "smoke"
SET = "field.steps=40 mesh.steps=4"
CAPTURE = {"frames": 20, "size": 200, "texture": 256, "novel_views": 0, "novel_poses": 0}
KILLED_STAGE, DONE_BEFORE = "field", 3
"""The node is lost when so many videos are done and one of its jobs has begun this stage."""

GOOD = tuple(f"person{number}" for number in range(1, 8))
BROKEN = "broken"
BROKEN_BYTES = 2000

BATCH_TIMEOUT_S = 2400.0
STATUS_INTERVAL_S = 5
"""Snakemake asks Slurm for the states of its jobs so often; its default is 40 s."""


def cluster_scores(captures: Path, folder: Path, lost: str) -> dict[str, float]:
    """Run a batch on Slurm, lose a node, and run the same command again, with the broken video and with a mended one.

    Args:
        captures: folder of captures.
        folder: for videos and runs.
        lost: "node": a node with its jobs; "slurmd": only the slurmd of a node, its jobs go on.

    Returns:
        videos_left: good videos without an avatar after the command in which the node was lost.
        videos_left_again: the same after the same command; with `videos_left_mended`: of all videos, after the broken
            one was replaced.
        repeated_stages: finished stages that a later command ran again.
        differing_files: files that differ between the avatars, whose videos are equal.

    Raises:
        CannotRunError: Slurm or Snakemake is not installed, or this process is not root.
        RuntimeError: a command did not end in time.
    """
    require_snakemake()
    video = make_capture(captures, CAPTURE, {}) / "video" / "video.mp4"
    videos, runs = folder / "videos", folder / "runs"
    shutil.rmtree(folder, ignore_errors=True)
    videos.mkdir(parents=True)
    for name in GOOD:
        shutil.copy(video, videos / f"{name}.mp4")
    (videos / f"{BROKEN}.mp4").write_bytes(broken_video(video))
    with slurm_cluster() as cluster:
        batch = start_batch(cluster, videos, runs)
        try:
            lose_node(cluster, runs, batch, lost)
        except (RuntimeError, OSError, subprocess.CalledProcessError):
            end_batch(batch)
            raise
        wait_for_batch(batch)
        scores = {"videos_left": count_left(runs, GOOD)}
        before = stage_times_ns(runs)
        wait_for_batch(start_batch(cluster, videos, runs))
        scores["videos_left_again"] = count_left(runs, GOOD)
        shutil.copy(video, videos / f"{BROKEN}.mp4")
        if wait_for_batch(start_batch(cluster, videos, runs)) != 0:
            scores["videos_left_mended"] = count_left(runs, (*GOOD, BROKEN))
    scores.setdefault("videos_left_mended", 0.0)
    after = stage_times_ns(runs)
    scores["repeated_stages"] = float(sum(after.get(stage) != time_ns for stage, time_ns in before.items()))
    finished = [runs / name for name in (*GOOD, BROKEN) if is_done(runs / name)]
    differing = {file for run in finished[1:] for file in differing_files(finished[0], run)}
    return scores | {"differing_files": float(len(differing))}


def require_snakemake() -> None:
    """Raise CannotRunError if Snakemake is not installed."""
    if not (Path(sys.prefix) / "bin" / "snakemake").exists():
        raise CannotRunError("the trial needs Snakemake: make venv EXTRA=cluster")


def broken_video(video: Path) -> bytes:
    """Return the first bytes of a video, as of an upload that was cut off."""
    return video.read_bytes()[:BROKEN_BYTES]


def start_batch(cluster: SlurmCluster, videos: Path, runs: Path) -> "subprocess.Popen[bytes]":
    """Start `make batch CLUSTER=slurm`; its output goes to RUNS.log."""
    options = f"--slurm-init-seconds-before-status-checks {STATUS_INTERVAL_S} --set-threads avatar={node_cpus()}"
    command = [*NAMESPACE, "make", "batch", f"VIDEOS={videos.resolve()}", f"RUNS={runs.resolve()}", "CLUSTER=slurm"]
    command += [f"PRESET={PRESET}", f"SET={SET}", f"ARGS={options}"]
    with runs.with_name(f"{runs.name}.log").open("ab") as log:
        return subprocess.Popen(command, cwd=REPOSITORY_DIR, env=cluster.environment, stdout=log, stderr=log)


def lose_node(cluster: SlurmCluster, runs: Path, batch: "subprocess.Popen[bytes]", lost: str) -> None:
    """Wait until a job is in `KILLED_STAGE` after `DONE_BEFORE` videos, and kill its node or the slurmd of its node.

    Raises:
        RuntimeError: no job came so far.
    """
    found: list[str] = []

    def is_in_stage() -> bool:
        if batch.poll() is not None:
            raise RuntimeError(f"the batch ended with status {batch.returncode} before a node was lost: see {runs}.log")
        busy = {node: name for node, comment in cluster.running().items() for name in GOOD if comment.endswith(name)}
        found[:] = [node for node, name in busy.items() if (runs / name / f"{KILLED_STAGE}.part").exists()]
        return bool(found) and len(GOOD) - count_left(runs, GOOD) >= DONE_BEFORE

    wait_until(is_in_stage, BATCH_TIMEOUT_S, f"no job came to the stage {KILLED_STAGE}: see {runs}.log")
    if lost == "node":
        cluster.stop_node(found[0])
    else:
        cluster.kill_slurmd(found[0])


def wait_for_batch(batch: "subprocess.Popen[bytes]") -> int:
    """Wait for the end of the command and return its exit status. RuntimeError if it takes too long."""
    try:
        return batch.wait(BATCH_TIMEOUT_S)
    except subprocess.TimeoutExpired:
        end_batch(batch)
        raise RuntimeError(f"make batch CLUSTER=slurm did not end in {BATCH_TIMEOUT_S:.0f} s") from None


def end_batch(batch: "subprocess.Popen[bytes]") -> None:
    """Kill the command with all that it started."""
    batch.kill()
    batch.wait()


def is_done(run: Path) -> bool:
    """Return whether all stages of a run are finished."""
    return all((run / stage / MANIFEST_FILE).is_file() for stage in STAGES)


def count_left(runs: Path, names: tuple[str, ...]) -> float:
    """Return how many runs are not done."""
    return float(sum(not is_done(runs / name) for name in names))


def stage_times_ns(runs: Path) -> Mapping[str, int]:
    """Return when the folder of each finished stage of each run was made, ns."""
    folders = [runs / name / stage for name in GOOD for stage in STAGES]
    return {str(folder): folder.stat().st_ctime_ns for folder in folders if folder.is_dir()}
