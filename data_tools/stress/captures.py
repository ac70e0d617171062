"""Captures of trials: rendered once for each set of options, damaged in a copy that shares the ground truth."""

import os
import shutil
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
from av.video.reformatter import Colorspace

from data_tools.evaluate.truth import load_ground_truth, load_true_mask
from data_tools.folder import atomic_folder
from data_tools.sample import main as make_sample
from data_tools.stress.image_corruption import IMAGE_CORRUPTIONS, Images
from data_tools.stress.mask_corruption import MASK_CORRUPTIONS
from data_tools.stress.row import Number
from data_tools.synthetic.scene.capture import CAPTURE_VERSION, SyntheticCapture
from data_tools.synthetic.scene.movie import LOSSLESS, Encoding, write_video
from pipeline.capture.video import open_frame_source, read_frames
from pipeline.core.manifest import digest_json
from pipeline.io.image import to_float, write_gray, write_rgb

BITRATE = "bitrate_mbps"
"""Name of the compression among the corruptions: H.264 as telephones write it, 4:2:0, at this average rate."""

NAN_PIXEL = "nan_pixel"
"""Name of the corruption that stores the frames as OpenEXR and sets so many pixels of one of them to nan."""

Options = Mapping[str, Any]


def make_capture(folder: Path, options: Options, corruption: Mapping[str, Number]) -> Path:
    """Return the folder of a capture with these options of `data_tools.sample` and this damage; made only once.

    Args:
        folder: of all captures.
        options: by name; True is a flag.
        corruption: value by name in `IMAGE_CORRUPTIONS`, `MASK_CORRUPTIONS`, or `BITRATE` or `NAN_PIXEL`; applied in
            this order.
    """
    clean = folder / f"clean-{_digest(options)}"
    if not clean.exists():
        make_sample([str(clean), *option_arguments(options)])
    if not corruption:
        return clean
    damaged = folder / f"damaged-{_digest({'options': dict(options), 'corruption': dict(corruption)})}"
    if not damaged.exists():
        with atomic_folder(damaged) as part:
            _write_damaged(part, clean, corruption)
    return damaged


def option_arguments(options: Options) -> list[str]:
    """Return options as command-line arguments."""
    arguments: list[str] = []
    for name, value in options.items():
        if value is not False:
            arguments += [f"--{name.replace('_', '-')}"] + ([] if value is True else [str(value)])
    return arguments


def _write_damaged(out: Path, clean: Path, corruption: Mapping[str, Number]) -> None:
    """Write `video/` with damaged images and masks, and link `truth/`."""
    capture = load_ground_truth(clean)
    images = [frame.rgb for frame in read_frames(open_frame_source(clean / "video"), lambda _: True, 1 << 30)]
    for name, value in corruption.items():
        if name in IMAGE_CORRUPTIONS:
            images = IMAGE_CORRUPTIONS[name](images, capture, float(value))
    (out / "video").mkdir()
    if NAN_PIXEL in corruption:
        _write_exr(out / "video", images, int(corruption[NAN_PIXEL]))
    else:
        encoding = h264_at(float(corruption[BITRATE])) if BITRATE in corruption else LOSSLESS
        write_video(out / "video" / "video.mp4", images, capture.fps, encoding)
    masks = {name: value for name, value in corruption.items() if name in MASK_CORRUPTIONS}
    if masks:
        _write_masks(out / "video" / "masks", clean, capture, masks)
    # Its parent is renamed when it is complete, so that a relative link stays valid.
    try:
        (out / "truth").symlink_to(os.path.relpath(clean / "truth", out), target_is_directory=True)
    except OSError:
        shutil.copytree(clean / "truth", out / "truth")


def _write_masks(folder: Path, clean: Path, capture: SyntheticCapture, corruption: Mapping[str, Number]) -> None:
    folder.mkdir()
    for frame in range(len(capture.motion.frame_index)):
        mask = load_true_mask(clean, frame)
        for name, value in corruption.items():
            mask = MASK_CORRUPTIONS[name](mask, capture, frame, float(value))
        write_gray(folder / f"{frame:06d}.png", mask)


def _write_exr(folder: Path, images: Images, count: int) -> None:
    """Write the images as OpenEXR; `count` pixels in the middle of the middle one are nan."""
    for index, image in enumerate(images):
        pixels = to_float(image)
        if index == len(images) // 2:
            row, column = pixels.shape[0] // 2, pixels.shape[1] // 2
            pixels[row, column : column + count] = np.nan
        write_rgb(folder / f"{index:06d}.exr", pixels)


def h264_at(megabits_per_s: float) -> Encoding:
    """Return an encoding at an average bit rate."""
    bits = round(1e6 * megabits_per_s)
    options = {"b": str(bits), "maxrate": str(2 * bits), "bufsize": str(2 * bits), "preset": "veryfast", "threads": "1"}
    return Encoding("yuv420p", Colorspace.DEFAULT, options)


def true_view_deg(capture: Path) -> float:
    """Return the true field of view along the longer side, degrees."""
    camera = load_ground_truth(capture).camera
    return float(np.degrees(2.0 * np.arctan(0.5 * max(camera.width, camera.height) / camera.fx)))


def _digest(value: Options) -> str:
    return digest_json({"version": CAPTURE_VERSION, "value": dict(value)})[:12]
