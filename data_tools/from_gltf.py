"""A synthetic capture of any rigged, textured person, who turns in A-pose or follows a motion capture.

python -m data_tools.from_gltf PERSON.glb OUT [--bvh MOTION.bvh --start 2.5 --in-place]
"""

import sys
from collections.abc import Sequence
from pathlib import Path

from data_tools.bvh import read_bvh
from data_tools.capture import write_capture
from data_tools.command import run_command
from data_tools.folder import refuse_existing
from data_tools.motion import turn_in_a_pose
from data_tools.options import assemble, capture_parser, check_options, recipe_of, stage_scene
from data_tools.retarget import resampled, retarget
from data_tools.rigged import read_rigged


def main(argv: Sequence[str]) -> None:
    """Make one capture."""
    parser = capture_parser("from_gltf", (__doc__ or "").splitlines()[0])
    parser.add_argument("person", type=Path, help="rigged, textured person (.glb, Mixamo joint names)")
    parser.add_argument("out", type=Path, help="folder to make: OUT/video for the pipeline, OUT/truth beside it")
    parser.add_argument("--bvh", type=Path, help="motion to follow instead of the turn")
    parser.add_argument("--start", type=float, default=0.0, help="where in the motion to start, seconds")
    parser.add_argument("--in-place", action="store_true", help="stay on the spot whatever the motion does")
    options = parser.parse_args(argv)
    check_options(options)
    refuse_existing(options.out)
    subject = read_rigged(options.person)
    scene = stage_scene(options, subject.body)
    if options.bvh:
        whole = retarget(read_bvh(options.bvh), subject.body, scene[1], options.in_place)
        motion = resampled(whole, options.start, options.frames, options.fps)
    else:
        motion = turn_in_a_pose(subject.body, options.frames, options.fps, scene[1], options.seed)
    capture, heldout = assemble(options, subject, motion, scene)
    names = {"person": options.person.name, "motion": options.bvh.name if options.bvh else "turn"}
    write_capture(options.out, capture, None, heldout, {"source": "gltf", **recipe_of(options), **names})
    print(f"{options.out}/video/video.mp4 and its truth in {options.out}/truth")


if __name__ == "__main__":
    raise SystemExit(run_command(main, sys.argv[1:]))
