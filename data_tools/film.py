"""Render a film of the avatar of a finished run: its turntable, one of its clips, or motion capture.

python -m data_tools.film RUN [--clip capture|idle|CLIP.bvh] [--in-place] [--name NAME]

Writes RUN/film/NAME/film.mp4: 24 frames a second, 1280 x 720, H.264.
"""

import argparse
import sys
from collections.abc import Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import numpy as np
from jaxtyping import UInt8

from data_tools.command import run_command
from data_tools.folder import result_folder
from data_tools.pose import EXPORTED_CLIPS, check_folder_name, export_config, play_bvh
from data_tools.synthetic.scene.movie import FOR_PLAYERS, write_video
from pipeline.avatar.film import FPS, render_film, turntable_motion
from pipeline.avatar.finished_run import load_textured_avatar
from pipeline.avatar.motion.idle import idle_motion
from pipeline.avatar.placement import resample_uniformly
from pipeline.body.body import Motion
from pipeline.core.errors import UserError
from pipeline.core.progress import track
from pipeline.io.bvh import require_bvh_file
from stages import export
from stages.export import Scene, load_scene

TURNTABLE = "turntable"
CLIPS = (TURNTABLE, *EXPORTED_CLIPS)
"""What every avatar can be filmed with."""
MIN_FRAMES = 2


def main(argv: Sequence[str]) -> None:
    """Render one film."""
    options = _parse_options(argv)
    name = check_folder_name(options.name) if options.name else _default_name(options.clip)
    _check_clip(options.clip)
    inputs = {name: options.run / name for name in export.STAGE.needs}
    # The film shows the captured surface: five seconds for a face that moves would be for nothing.
    scene = load_scene(inputs, export_config(options.run).model_copy(update={"face": False}))
    motion = film_motion(options.clip, scene, options.in_place)
    avatar = load_textured_avatar(inputs["mesh"], inputs["texture"])
    with result_folder(options.run / "film" / name) as out:
        frames = render_film(avatar, scene.body, motion)
        write_video(out / "film.mp4", _ahead(track(frames, "frames of the film", len(motion.time_s))), FPS, FOR_PLAYERS)
    print(f"{options.run / 'film' / name / 'film.mp4'}: {len(motion.time_s) / FPS:.1f} s, {len(motion.time_s)} frames")


def film_motion(clip: str | None, scene: Scene, in_place: bool = False) -> Motion:
    """Return the motion of a film at `FPS`, on the floor at y = 0.

    clip: name of an animation of avatar.glb, path of a .bvh file, or None for the turntable.

    Raises:
        UserError: there is no such clip, its file cannot be played, or it is shorter than two frames.
    """
    _check_clip(clip)
    if clip is None or clip == TURNTABLE:
        return turntable_motion(scene.body, scene.floor_y_m)
    if clip == "capture":
        motion = scene.motion
    elif clip == "idle":
        motion = idle_motion(scene.body, scene.floor_y_m)
    else:
        motion = play_bvh(Path(clip), scene.body, scene.floor_y_m, in_place)
    resampled = resample_uniformly(motion, FPS)
    if len(resampled.time_s) < MIN_FRAMES:
        length_s = motion.time_s[-1] - motion.time_s[0]
        raise UserError(f"the clip {clip} lasts {length_s:.3f} s; a film needs at least {MIN_FRAMES / FPS:.2f} s")
    return resampled


def _check_clip(clip: str | None) -> None:
    """Raise UserError for a clip that does not exist, before anything is read."""
    if clip is None or clip in CLIPS:
        return
    if Path(clip).suffix.lower() != ".bvh":
        raise UserError(f"there is no clip {clip}; choose capture, idle or {TURNTABLE}, or name a .bvh file")
    require_bvh_file(Path(clip))


def _default_name(clip: str | None) -> str:
    """Return the name of the clip, or of its file. UserError if a file has that of a clip that every avatar has."""
    name = Path(clip or TURNTABLE).stem
    if clip not in (None, *CLIPS) and name in CLIPS:
        raise UserError(f"{name} is the name of a film that every avatar has; name that of {clip} with --name")
    return name


def _ahead(frames: Iterator[UInt8[np.ndarray, "h w 3"]]) -> Iterator[UInt8[np.ndarray, "h w 3"]]:
    """Yield the frames while the next one is rendered in a thread, next to the encoder."""
    with ThreadPoolExecutor(1) as pool:
        following = pool.submit(next, frames, None)
        while (frame := following.result()) is not None:
            following = pool.submit(next, frames, None)
            yield frame


def _parse_options(argv: Sequence[str]) -> argparse.Namespace:
    parser = argparse.ArgumentParser(prog="python -m data_tools.film", description=(__doc__ or "").splitlines()[0])
    parser.add_argument("run", type=Path, help="run folder with a finished export")
    parser.add_argument("--clip", help="animation of avatar.glb or a .bvh file; default: a turntable of the A-pose")
    parser.add_argument("--in-place", action="store_true", help="remove the horizontal movement of a .bvh file")
    parser.add_argument("--name", help="of the folder RUN/film/NAME; default: that of the clip")
    return parser.parse_args(argv)


if __name__ == "__main__":
    raise SystemExit(run_command(main, sys.argv[1:]))
