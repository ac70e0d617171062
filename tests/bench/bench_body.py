"""Accuracy of the stages frames and body on captures with ground truth: one row for each capture and known input.

python -m tests.bench.bench_body CAPTURE ... [--runs runs/bench-body]

Each capture is fitted three times: with its true focal length and stature, with its stature, and with neither. Images
of one camera do not determine the size of a person: a wrong stature increases the joint errors but does not change the
appearance of the avatar.
"""

import argparse
import math
import subprocess
import sys
import time
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path

from data_tools.command import run_command
from data_tools.evaluate.compare_body import compare_body, compare_masks, compare_surface
from data_tools.evaluate.truth import load_ground_truth
from data_tools.sweep.runs import find_video
from pipeline.body.files import load_body
from pipeline.core.errors import UserError
from stages import body
from tests.bench.machine import append_result

KNOWN_INPUTS = ("focal and stature", "stature", "nothing")
COLUMNS = {
    "joints": "joint_error_mm",
    "scaled": "scaled_joint_error_mm",
    "absolute": "absolute_joint_error_mm",
    "focal": "focal_ratio",
    "surface": "surface_median_mm",
    "swaps": "left_right_swapped_frames",
    "jitter": "acceleration_error_ratio",
    "mask": "mask_iou_median",
    "worst": "mask_iou_worst",
    "frames s": "frames_seconds",
    "body s": "body_seconds",
}
"""Title of each column, and its key in the results."""


def known_input_configs(capture: Path) -> Iterator[tuple[str, body.Config]]:
    """Yield the name of each known input and its options; stature only where the ground truth has a bare body."""
    camera, bare = load_ground_truth(capture).camera, capture / "truth" / "bare.npz"
    view_deg = math.degrees(2 * math.atan(0.5 * max(camera.width, camera.height) / camera.fx))
    height_m = load_body(bare).height_m() if bare.is_file() else None
    yield KNOWN_INPUTS[0], body.Config(field_of_view_deg=view_deg, height_m=height_m)
    if height_m:
        yield KNOWN_INPUTS[1], body.Config(height_m=height_m)
    yield KNOWN_INPUTS[2], body.Config()


def measure(capture: Path, run: Path) -> Iterator[dict[str, str | float]]:
    """Run both stages on the video of a capture; yield the results for each known input, with the seconds of both."""
    command = [sys.executable, "-m", "stages.frames", str(run), "--video", str(find_video(capture)), "--force"]
    start = time.monotonic()
    if subprocess.run(command, check=False).returncode:
        raise UserError(f"the frames stage failed on {capture}; its error is printed above")
    frames = {"frames_seconds": time.monotonic() - start} | compare_masks(capture, run / "frames")
    for known_inputs, config in known_input_configs(capture):
        out = run / f"body, known {known_inputs}"
        out.mkdir(parents=True, exist_ok=True)
        start = time.monotonic()
        body.run({"frames": run / "frames"}, out, config)
        seconds = {"body_seconds": time.monotonic() - start}
        errors = compare_body(capture, out) | compare_surface(capture, out)
        yield {"capture": capture.name, "known_inputs": known_inputs, **frames, **seconds, **errors}


def format_row(results: Mapping[str, str | float]) -> str:
    """Return a row of the table."""
    values = (results[name] for name in COLUMNS.values())
    return f"{results['capture']:24s} {results['known_inputs']:18s}" + "".join(f"{value:9.3g}" for value in values)


def main(argv: Sequence[str]) -> None:
    """Measure, print the table, append its rows to the results."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("captures", type=Path, nargs="+", help="captures with ground truth, made by data_tools")
    parser.add_argument("--runs", type=Path, default=Path("runs/bench-body"), help="folder for the runs")
    options = parser.parse_args(argv)
    rows = [row for capture in options.captures for row in measure(capture, options.runs / capture.name)]
    print(f"{'capture':24s} {'known_inputs':18s}" + "".join(f"{head:>9s}" for head in COLUMNS))
    for row in rows:
        print(format_row(row))
        table = append_result("body", row)
    print(f"lengths in mm; rows appended to {table}")


if __name__ == "__main__":
    sys.exit(run_command(main, sys.argv[1:]))
