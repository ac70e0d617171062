"""How far do clips stretch the edges of the avatar?

`python -m tests.bench.bench_stretch RUN... --clips CLIP.bvh ...` plays each clip, and the motion of the video, on the
mesh of finished runs. It prints the 99.9th percentile, over all frames and edges longer than 2 mm in the A-pose, of
posed length over length in the A-pose, and that of the frame where it is largest. An edge that jumps between two limbs
has ratios of 4 and more: armpits and crotch are then torn.
"""

import argparse
import sys
from pathlib import Path

import numpy as np

from data_tools.pose import play_bvh
from pipeline.body.body import Motion, canonical_to_world
from pipeline.body.files import load_body, load_motion
from pipeline.capture.frame_selection import evenly_spaced
from pipeline.mesh.files import load_mesh
from pipeline.mesh.skin_relaxation import edge_stretch, long_edges

PERCENTILE = 99.9
MAX_FRAMES = 400
"""Longer clips are sampled evenly: ratios of 400 frames and 20,000 edges take 32 MB."""


def main(argv: list[str]) -> None:
    """Print one line for each run and clip."""
    parser = argparse.ArgumentParser(prog="python -m tests.bench.bench_stretch")
    parser.add_argument("runs", type=Path, nargs="+")
    parser.add_argument("--clips", type=Path, nargs="+", required=True)
    options = parser.parse_args(argv)
    print(f"{'run':24} {'clip':24} all frames  worst frame")
    for run in options.runs:
        body = load_body(run / "body" / "body.npz")
        print(f"{run.name:24} {'(video)':24} {_row(run, load_motion(run / 'mesh' / 'motion.npz'))}")
        for clip in options.clips:
            print(f"{run.name:24} {clip.stem:24} {_row(run, play_bvh(clip, body, 0.0))}")


def _row(run: Path, motion: Motion) -> str:
    worst, pooled = stretch_percentiles(run, motion)
    return f"{pooled:10.2f} {worst:12.2f}"


def stretch_percentiles(run: Path, motion: Motion) -> tuple[float, float]:
    """Return the percentile of the worst frame, and of all frames together."""
    body, skinned = load_body(run / "body" / "body.npz"), load_mesh(run / "mesh")
    rows = evenly_spaced(len(motion.time_s), MAX_FRAMES)
    poses = canonical_to_world(body, motion.select(rows))
    weights = skinned.dense_skin_weights(len(body.joint_names))
    stretch = edge_stretch(skinned.mesh, weights, long_edges(skinned.mesh), poses).numpy()
    return float(np.percentile(stretch, PERCENTILE, axis=1).max()), float(np.percentile(stretch, PERCENTILE))


if __name__ == "__main__":
    main(sys.argv[1:])
