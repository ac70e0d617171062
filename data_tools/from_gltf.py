"""Render a synthetic capture of a rigged, textured person (.glb) who turns in A-pose or follows a motion capture.

python -m data_tools.from_gltf PERSON.glb OUT [--bvh MOTION.bvh --start 2.5 --in-place]
"""

import sys
from collections.abc import Sequence
from pathlib import Path

from data_tools.command import run_command
from data_tools.folder import require_absent
from data_tools.synthetic.rig.rigged import read_rigged_person
from data_tools.synthetic.scene.capture import write_capture
from data_tools.synthetic.scene.options import (
    build_capture,
    build_motion,
    build_scene,
    capture_parser,
    settings_from_options,
    validate_capture_options,
)


def main(argv: Sequence[str]) -> None:
    """Render one capture."""
    parser = capture_parser("from_gltf", (__doc__ or "").splitlines()[0])
    parser.add_argument("person", type=Path, help="rigged, textured person: .glb with Mixamo joint names")
    parser.add_argument(
        "out", type=Path, help="new folder: OUT/video for the pipeline, OUT/truth with the ground truth"
    )
    options = parser.parse_args(argv)
    validate_capture_options(options)
    require_absent(options.out)
    subject = read_rigged_person(options.person)
    scene = build_scene(options, subject.body)
    motion = build_motion(options, subject.body, scene)
    capture, heldout = build_capture(options, subject, motion, scene)
    settings = {"source": "gltf", **settings_from_options(options), "person": options.person.name}
    write_capture(options.out, capture, None, heldout, settings)
    print(f"{options.out}/video/video.mp4 and its ground truth in {options.out}/truth")


if __name__ == "__main__":
    raise SystemExit(run_command(main, sys.argv[1:]))
