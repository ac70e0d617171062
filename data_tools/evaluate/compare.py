"""Compare a run of the pipeline with the ground truth of its synthetic capture.

python -m data_tools.evaluate.compare OUT RUN

Prints the scores of the finished stages. If the report is finished, RUN/compare/truth.json and truth.html are written.
"""

import argparse
import sys
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from data_tools.command import run_command
from data_tools.evaluate.compare_body import compare_body, compare_masks, compare_surface
from data_tools.evaluate.page import write_comparison
from data_tools.evaluate.truth import read_capture_settings, require_current_version
from pipeline.core.command import format_command
from pipeline.core.errors import UserError
from pipeline.core.manifest import (
    MANIFEST_FILE,
    digest_file,
    digest_json,
    digest_video,
    read_manifest,
    require_matching_stages,
)
from stages import STAGES


def main(argv: Sequence[str]) -> None:
    """Compare one run and print the scores."""
    parser = argparse.ArgumentParser(
        prog="python -m data_tools.evaluate.compare", description=(__doc__ or "").splitlines()[0]
    )
    parser.add_argument("out", type=Path, help="folder of the synthetic capture")
    parser.add_argument("run", type=Path, help="run folder of the pipeline on OUT/video")
    options = parser.parse_args(argv)
    finished = [stage for stage in ("frames", "body", "report") if (options.run / stage / MANIFEST_FILE).is_file()]
    require_current_version(options.out, read_capture_settings(options.out))
    if not finished:
        command = format_command("--run", options.run, "--video", options.out / "video")
        raise UserError(f"{options.run} has no finished stage; run {command}")
    require_video_of(options.out, options.run)
    require_matching_stages(options.run, STAGES if "report" in finished else finished)
    sections: dict[str, Any] = {}
    if "frames" in finished:
        sections["masks"] = compare_masks(options.out, options.run / "frames")
    if "body" in finished:
        sections["body"] = compare_body(options.out, options.run / "body")
        sections["body"] |= compare_surface(options.out, options.run / "body")
    if "report" in finished:
        sections = write_comparison(options.out, options.run, sections)
    for name, scores in sections.items():
        _print_scores(name, scores)
    if sections.get("light", "flat") != "flat":
        print(f"light: {sections['light']}")


def require_video_of(out: Path, run: Path) -> None:
    """Raise UserError if a run was made from another recording than that of the capture in `out`, wherever it lies.

    The run may have read the video file, or a folder with the file alone or with what is in its folder now.
    """
    manifest, folder = read_manifest(run / "frames"), out / "video"
    if manifest is None or "video" not in manifest.inputs:
        return
    video = folder / "video.mp4"
    if not video.is_file():
        raise UserError(f"{video} does not exist; remove {out} and make the capture again")
    digest = digest_file(video)
    if manifest.inputs["video"] not in (digest, digest_json({video.name: digest}), digest_video(folder)):
        raise UserError(
            f"{run} was not made from {video} as it is now: compare it with the capture of its video, or, if this "
            f"capture was made again, make the run again: {format_command('--run', run, '--video', folder, '--force')}"
        )


def _print_scores(path: str, scores: Any) -> None:
    """Print each score with the path of its keys; texts are left out."""
    if isinstance(scores, Mapping):
        for name, value in scores.items():
            _print_scores(f"{path}.{name}", value)
    elif isinstance(scores, float):
        print(f"{path:40}{scores:10.4f}")


if __name__ == "__main__":
    raise SystemExit(run_command(main, sys.argv[1:]))
