"""The built-in sample: a clothed person, generated from the embedded body, turns once before a camera.

python -m data_tools.sample OUT [--frames 96 --size 540 --seed 0 --legwear skirt --bvh MOTION.bvh ...]
"""

import sys
from collections.abc import Sequence
from pathlib import Path

from data_tools.command import run_command
from data_tools.folder import require_absent
from data_tools.synthetic.person.outfit import LEGWEAR
from data_tools.synthetic.person.person import make_person
from data_tools.synthetic.scene.capture import write_capture
from data_tools.synthetic.scene.options import (
    build_capture,
    build_motion,
    build_scene,
    capture_parser,
    recipe_from_options,
    validate_capture_options,
)


def main(argv: Sequence[str]) -> None:
    """Make one capture."""
    parser = capture_parser("sample", (__doc__ or "").splitlines()[0])
    parser.add_argument("out", type=Path, help="folder to make: OUT/video for the pipeline, OUT/truth beside it")
    parser.add_argument("--texture", type=int, default=2048, help="side of the true texture in pixels")
    parser.add_argument("--legwear", choices=LEGWEAR, default=LEGWEAR[0], help="trousers, or a skirt over bare legs")
    options = parser.parse_args(argv)
    validate_capture_options(options)
    require_absent(options.out)
    subject, bare = make_person(options.seed, options.texture, options.legwear)
    scene = build_scene(options, subject.body)
    motion = build_motion(options, subject.body, scene[1])
    capture, heldout = build_capture(options, subject, motion, scene)
    write_capture(options.out, capture, bare, heldout, {"source": "sample", **recipe_from_options(options)})
    print(f"{options.out}/video/video.mp4 and its truth in {options.out}/truth")


if __name__ == "__main__":
    raise SystemExit(run_command(main, sys.argv[1:]))
