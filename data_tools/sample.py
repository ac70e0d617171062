"""Render a synthetic capture of a generated clothed person who turns in A-pose or follows a motion capture.

python -m data_tools.sample OUT [--frames 96 --size 540 --seed 0 --legwear skirt --bvh MOTION.bvh ...]
"""

import sys
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

from data_tools.command import run_command
from data_tools.folder import require_absent
from data_tools.synthetic.person.attachment import ATTACHMENTS
from data_tools.synthetic.person.outfit import HEM_FLARE_M, LEGWEAR, choose_outfit
from data_tools.synthetic.person.person import make_person
from data_tools.synthetic.scene.capture import write_capture
from data_tools.synthetic.scene.options import (
    build_capture,
    build_motion,
    build_scene,
    capture_parser,
    settings_from_options,
    validate_capture_options,
)
from pipeline.core.errors import UserError

PHENOTYPES = ("age", "weight")
"""Of the person's shape; a child has an age of 1/3, an adult one of 2/3."""


def main(argv: Sequence[str]) -> None:
    """Render one capture."""
    parser = capture_parser("sample", (__doc__ or "").splitlines()[0])
    parser.add_argument(
        "out", type=Path, help="new folder: OUT/video for the pipeline, OUT/truth with the ground truth"
    )
    parser.add_argument("--texture", type=int, default=2048, help="side of the texture in pixels")
    parser.add_argument("--legwear", choices=LEGWEAR, default=LEGWEAR[0], help="clothing of the legs")
    parser.add_argument(
        "--flare-m", type=float, help="widening of the skirt from waist to hem in metres; 0.07 if absent"
    )
    parser.add_argument("--hem-m", type=float, help="height of the hem of the skirt, metres; above the knees if absent")
    parser.add_argument("--sleeve-flare-m", type=float, default=0.0, help="widening of the sleeves to the hem, metres")
    parser.add_argument(
        "--trouser-flare-m", type=float, default=0.0, help="widening of the trousers to the hem, metres"
    )
    parser.add_argument("--jacket-m", type=float, default=0.0, help="thickness of a padded jacket, metres; 0: a shirt")
    parser.add_argument("--heel-m", type=float, default=0.0, help="height of the heels, metres")
    parser.add_argument("--finger-mm", type=float, help="width of the fingers, mm; that of the person if absent")
    parser.add_argument("--attachment", choices=sorted(ATTACHMENTS), help="what stands off the person")
    for name in PHENOTYPES:
        parser.add_argument(f"--{name}", type=float, help=f"Anny's {name}, 0 to 1; that of the seed if absent")
    options = parser.parse_args(argv)
    validate_capture_options(options)
    if options.legwear != "skirt" and (options.flare_m is not None or options.hem_m is not None):
        raise UserError("--flare-m and --hem-m are of a skirt; add --legwear skirt")
    if options.legwear != "trousers" and options.trouser_flare_m:
        raise UserError(f"--trouser-flare-m is of trousers; remove it, or --legwear {options.legwear}")
    require_absent(options.out)
    finger_m = None if options.finger_mm is None else 1e-3 * options.finger_mm
    phenotypes = {name: vars(options)[name] for name in PHENOTYPES if vars(options)[name] is not None}
    outfit = replace(
        choose_outfit(options.seed, options.legwear),
        hem_flare_m=HEM_FLARE_M if options.flare_m is None else options.flare_m,
        hem_m=options.hem_m,
        sleeve_flare_m=options.sleeve_flare_m,
        trouser_flare_m=options.trouser_flare_m,
        jacket_m=options.jacket_m,
        heel_m=options.heel_m,
        attachment=options.attachment,
    )
    subject, bare = make_person(options.seed, options.texture, outfit, finger_m, phenotypes)
    scene = build_scene(options, subject.body)
    motion = build_motion(options, subject.body, scene)
    capture, heldout = build_capture(options, subject, motion, scene)
    write_capture(options.out, capture, bare, heldout, {"source": "sample", **settings_from_options(options)})
    print(f"{options.out}/video/video.mp4 and its ground truth in {options.out}/truth")


if __name__ == "__main__":
    raise SystemExit(run_command(main, sys.argv[1:]))
