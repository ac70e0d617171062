"""Rows about broken input and broken machines: numbers, files, kills, full disks; and the real videos."""

from data_tools.stress.hostile.readers import READERS
from data_tools.stress.interruption import MAX_LOST_S
from data_tools.stress.row import DONE, Results, Row, Trial, all_of, bounded
from data_tools.stress.rows.captures import TURN

NO_FAULT = all_of(bounded("faults", high=0.0), bounded("slowest_s", high=20.0), bounded("growth_mib", high=1024.0))
REAL_VIDEOS = {
    "real turn": "../shared/data/real/dakse/video.mp4",
    "self-capture": "../shared/data/real/hjk",
    "juggler": "../shared/data/real/juggle",
    "skirt, front only": "../shared/data/real/skirt",
    "no feet": "../shared/data/error/no_feet.mp4",
    "several people": "../shared/data/error/several_people.mp4",
}
REFUSED_VIDEOS = ("no feet", "several people")
FIELD_RATES = {"field.settings.table_learning_rate": 1.0, "field.settings.network_learning_rate": 0.2}
CLUSTER_SCORES = ("videos_left", "videos_left_again", "videos_left_mended", "repeated_stages", "differing_files")
EMPTY_GRID = {"field.settings.occupancy_threshold": 0.999, "field.settings.occupancy_warmup_steps": 0}


def right_videos_are_refused(results: Results) -> list[str]:
    """Pass: the two bad videos are refused in one sentence, the four good ones become avatars of finite numbers."""
    wrong = [label for label, result in results.items() if (result.state == DONE) == (label in REFUSED_VIDEOS)]
    return [f"{label}: {results[label].state}" for label in wrong] + bounded("files_with_nan", high=0.0)(results)


def kills_destroy_little(results: Results) -> list[str]:
    """Pass: no kill destroys more than `MAX_LOST_S` of work."""
    killed = {label: result for label, result in results.items() if "repeated_seconds" in result.scores}
    return bounded("repeated_seconds", high=MAX_LOST_S)(killed)


ROBUSTNESS_ROWS = (
    Row(
        name="broken-numbers",
        failure="learning rates × 10, an empty occupancy grid, all-black masks, a nan pixel",
        line="no value that is not finite reaches a file; what cannot be used is refused in one sentence",
        trials=(
            Trial("learning rates × 10", 0, {"capture": TURN, "overrides": FIELD_RATES, "measure": "files"}),
            Trial("empty grid", 1, {"capture": TURN, "overrides": EMPTY_GRID, "measure": "files"}),
            Trial("black masks", 2, {"capture": TURN, "corruption": {"black": 1}, "measure": "files"}),
            Trial("nan pixel", 3, {"capture": TURN, "corruption": {"nan_pixel": 1}, "measure": "files"}),
        ),
        crossed=bounded("files_with_nan", high=0.0),
        score="files_with_nan",
        unit="files with a value that is not finite",
        may_refuse=True,
    ),
    Row(
        name="real-videos",
        failure="the real clips and the two bad ones of ../shared/data",
        line="good ones become avatars of finite numbers; bad ones are refused in one sentence",
        trials=tuple(
            Trial(label, x, {"video": path, "measure": "files", "overrides": {"frames.max_frames": 60}})
            for x, (label, path) in enumerate(REAL_VIDEOS.items())
        ),
        crossed=right_videos_are_refused,
        score="files_with_nan",
        unit="files with a value that is not finite",
        may_refuse=True,
    ),
    Row(
        name="interruption",
        failure="kill -9 at 50 random times over all seven stages, ten of them at two threads, a full disk, two runs "
        "on one folder",
        line=f"the same bytes as without, nothing lost; a kill destroys at most {MAX_LOST_S:.0f} s of work of one core",
        trials=(
            *(
                Trial(f"ten kills, seed {seed}", seed, {"kind": "kills", "seed": seed}, "interruption")
                for seed in range(4)
            ),
            Trial("ten kills, two threads", 4, {"kind": "kills", "seed": 4, "threads": 2}, "interruption"),
            Trial("full disk", 5, {"kind": "full disk", "count": 1}, procedure="interruption"),
            Trial("two runs", 6, {"kind": "two runs", "count": 1}, procedure="interruption"),
        ),
        crossed=all_of(bounded("differing_files", high=0.0), kills_destroy_little),
        score="differing_files",
        unit="files that differ",
        preset="smoke",
        missing="captures of real size, of which a kill destroys more: see above",
    ),
    Row(
        name="cluster",
        failure="a batch of eight videos on a real Slurm of two nodes: one video is broken, one node is lost",
        line="all others are done; the same command goes on, repeats nothing, and ends with the same bytes for all",
        trials=(
            Trial("node lost", 0, {"lost": "node"}, procedure="cluster"),
            Trial("slurmd killed", 1, {"lost": "slurmd"}, procedure="cluster"),
        ),
        crossed=all_of(*(bounded(score, high=0.0) for score in CLUSTER_SCORES)),
        score="videos_left",
        unit="good videos without an avatar",
        preset="smoke",
    ),
    Row(
        name="hostile",
        failure="damaged and malicious files for every reader: truncated, flipped, huge claims, bombs, code, paths",
        line="read, or refused in one sentence; no code run, at most 1 GiB and 20 s a file",
        trials=tuple(Trial(reader, x, {"reader": reader}, procedure="hostile") for x, reader in enumerate(READERS)),
        crossed=NO_FAULT,
        score="faults",
        unit="faults",
        preset="none",
    ),
)
