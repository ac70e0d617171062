"""frames: from a recording to the pictures that matter, each with the person's mask and 33 landmarks."""

from collections.abc import Mapping, Sequence
from pathlib import Path

import numpy as np
from pydantic import Field

from pipeline.capture import frame_selection as selection
from pipeline.capture.capture import CONTACT_SHEET, FRAMES_NPZ, IMAGES_FOLDER, MASKS_FOLDER, Capture, save_capture
from pipeline.capture.contact_sheet import contact_sheet
from pipeline.capture.detection import Sightings, look_at_all, write_frames
from pipeline.capture.exif_focal import recorded_focal_px
from pipeline.capture.input_checks import refuse_bad_input, warn_of_gaps
from pipeline.capture.process_pool import start_workers
from pipeline.capture.user_files import Supplied, SuppliedSplit, find_supplied
from pipeline.capture.video import IMAGE_FOLDER_FPS, Source, open_source
from pipeline.core.cli import main
from pipeline.core.config import Config as BaseConfig
from pipeline.core.errors import UserError
from pipeline.core.stage import Stage
from pipeline.io.image import write_rgb

_COUNTED_FRAMES = 6


class Config(BaseConfig):
    """Options of the frames stage."""

    max_frames: int = Field(200, ge=16, le=2000, description="Most frames that are kept (held-out ones included).")
    min_frames: int = Field(16, ge=5, le=1000, description="Fewest frames with a person that a run goes on with.")
    max_looked_at: int = Field(900, ge=16, description="Most frames in which the person is looked for.")
    max_side_px: int = Field(1280, ge=64, le=8192, description="Longer side of the stored images at most this, pixels.")
    duplicate_noise: float = Field(
        3.0, ge=0.0, le=100.0, description="Frames nearer than this to the last kept one are dropped, times the noise."
    )
    fps: float | None = Field(
        None, gt=0.0, le=1000.0, description="Frames a second of a folder of images; null: 30. A video says its own."
    )
    workers: int = Field(2, ge=1, le=64, description="Processes that look for the person and sharpen masks.")


def run(inputs: Mapping[str, Path], out: Path, config: Config) -> Mapping[str, float]:
    """Find the person in all frames, choose frames, write images, masks, landmarks and a contact sheet."""
    source = open_source(inputs["video"], config.fps or IMAGE_FOLDER_FPS)
    if config.fps is not None and not source.files:
        raise UserError(f"{source.path} is a video, which says its own frames a second; leave frames.fps out")
    if source.n_frames < config.min_frames:
        raise UserError(f"{source.path} has {source.n_frames} frames, too few: give at least {config.min_frames}")
    supplied = find_supplied(inputs["video"], source)
    with start_workers(config.workers) as workers:
        looked_at = frames_to_look_at(source, supplied, config)
        sightings = look_at_all(source, supplied, looked_at, _COUNTED_FRAMES, config.max_side_px, workers)
        refuse_bad_input(sightings, source.path, config.min_frames)
        noise = selection.noise_level(sightings.grays)
        if supplied.split is None:
            chosen, n_duplicates = choose(sightings, source.path, config, noise)
        else:
            chosen, n_duplicates = keep_listed(sightings, supplied.split, source.path), 0
        # Colour noise of a small blurred patch is never below one level, whatever the small grey pictures say.
        write_frames(source, supplied, sightings, chosen, out, config.max_side_px, max(1.0, noise), workers)
    capture = make_capture(sightings, chosen, out, source, supplied)
    save_capture(capture)
    write_rgb(out / CONTACT_SHEET, contact_sheet(capture))
    unseen_rad = selection.largest_gap_rad(selection.body_yaw_rad(capture.landmarks_world_m))
    warn_of_gaps(sightings, unseen_rad, source.path)
    return {
        "frames": len(chosen),
        "masks_count": len(chosen),
        "frames_train": len(capture.positions(selection.TRAIN)),
        "frames_validation": len(capture.positions(selection.VALIDATION)),
        "frames_heldout": len(capture.positions(selection.HELDOUT)),
        "video_frames": source.n_frames,
        "dropped_no_person": int((~sightings.found).sum()),
        "dropped_duplicates": n_duplicates,
        "noise_levels": noise,
        "landmark_visibility": float(capture.landmarks_visibility.mean()),
        "hands_found": float((sightings.hands.own_side[chosen] > 0.0).mean()),
        "unseen_arc_deg": float(np.degrees(unseen_rad)),
        "scale": sightings.scale,
    }


def frames_to_look_at(source: Source, supplied: Supplied, config: Config) -> Sequence[int]:
    """Indices of the frames in which the person is looked for: all that a supplied split lists, else evenly spread.

    Raises:
        UserError: the split lists more frames than may be kept.
    """
    if supplied.split is None:
        return range(0, source.n_frames, looking_stride(source.n_frames, config.max_looked_at))
    listed: list[int] = supplied.split.frame_index.tolist()
    if len(listed) > config.max_frames:
        raise UserError(
            f"split.json of {source.path} lists {len(listed)} frames, frames.max_frames is {config.max_frames}; "
            f"list fewer, or allow them with --set frames.max_frames={len(listed)}"
        )
    return listed


def looking_stride(n_frames: int, max_looked_at: int) -> int:
    """The smallest odd step that looks at few enough frames; odd, so that every index modulo 8 occurs as often."""
    stride = -(-n_frames // max_looked_at)
    return stride + 1 - stride % 2


def choose(sightings: Sightings, path: Path, config: Config, noise: float) -> tuple[list[int], int]:
    """Positions of the frames to keep, and how many were dropped as near-duplicates."""
    found = np.flatnonzero(sightings.found)
    threshold = config.duplicate_noise * noise
    distinct, way = selection.distinct_frames(sightings.grays[found], sightings.persons[found], threshold)
    kept = found[distinct]
    chosen = kept[selection.choose_frames(sightings.frame_index[kept], way[distinct], config.max_frames)]
    n_splits = len(np.unique(selection.split_of(sightings.frame_index[chosen])))
    if len(chosen) < config.min_frames or n_splits < 3:
        raise UserError(
            f"{path} has only {len(chosen)} frames in which the person has moved, {config.min_frames} are needed; "
            "film a slow full turn, or lower frames.duplicate_noise"
        )
    return [int(position) for position in chosen], int((~distinct).sum())


def keep_listed(sightings: Sightings, split: SuppliedSplit, path: Path) -> list[int]:
    """Positions of the frames that a supplied split lists and that show the person."""
    kept = np.flatnonzero(sightings.found)
    if len(np.unique(split.of(sightings.frame_index[kept]))) < 3:
        raise UserError(f"no person was found in any frame of one kind in split.json of {path}; list other frames")
    return [int(position) for position in kept]


def make_capture(sightings: Sightings, chosen: list[int], out: Path, source: Source, supplied: Supplied) -> Capture:
    """Gather what is known about the chosen frames."""
    frame_index = sightings.frame_index[chosen]
    return Capture(
        folder=out,
        frame_index=frame_index,
        time_s=sightings.time_s[chosen],
        split=selection.split_of(frame_index) if supplied.split is None else supplied.split.of(frame_index),
        fps=source.fps,
        width=sightings.width,
        height=sightings.height,
        landmarks_px=sightings.landmarks_px[chosen],
        landmarks_visibility=sightings.landmarks_visibility[chosen],
        landmarks_world_m=sightings.landmarks_world_m[chosen],
        camera=None
        if supplied.camera is None
        else supplied.camera.at(sightings.scale, sightings.width, sightings.height),
        mask_source=supplied.mask_source or "detector",
        n_video_frames=source.n_frames,
        scale=sightings.scale,
        recorded_focal_px=recorded_focal_px(source, sightings.width, sightings.height),
        hands=sightings.hands.rows(chosen),
        smpl_poses=None if supplied.smpl_poses is None else supplied.smpl_poses.of(frame_index),
    )


STAGE = Stage(
    "frames",
    version=9,
    needs=("video",),
    makes=(FRAMES_NPZ, IMAGES_FOLDER, MASKS_FOLDER, CONTACT_SHEET),
    config=Config,
    run=run,
)

if __name__ == "__main__":
    raise SystemExit(main(STAGE))
