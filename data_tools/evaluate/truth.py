"""Load the ground truth of a synthetic capture, and verify that rendering it reproduces the video.

python -m data_tools.evaluate.truth OUT [--meshes FOLDER]
"""

import argparse
import json
import sys
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from jaxtyping import UInt8

from data_tools.command import run_command
from data_tools.folder import atomic_folder
from data_tools.synthetic.person.noise import ValueNoise
from data_tools.synthetic.rig.subject import load_subject
from data_tools.synthetic.scene.backdrop import Room, floor_points
from data_tools.synthetic.scene.ball import Ball
from data_tools.synthetic.scene.capture import CAPTURE_VERSION, SyntheticCapture
from data_tools.synthetic.scene.renderer import Light, pose_vertices
from data_tools.synthetic.scene.walk_around import make_surroundings
from pipeline.avatar.obj import ObjMaps, write_obj
from pipeline.body.files import load_camera, load_motion
from pipeline.capture.video import open_frame_source, read_frames
from pipeline.core.command import format_module_command
from pipeline.core.errors import UserError
from pipeline.core.progress import track
from pipeline.geometry.mesh import Mesh
from pipeline.io.image import read_gray, read_rgb, to_float, write_rgb
from pipeline.metrics.images import foreground_mask, mask_iou, psnr_db

MIN_PSNR_DB, MIN_IOU = 45.0, 0.995

SAMPLE, _FROM_GLTF = "data_tools.sample", "data_tools.from_gltf"
"""Modules that make captures; `source` in the settings of a capture names the one that made it."""


@dataclass(frozen=True)
class GroundTruthCheck:
    """Agreement of the rendered ground truth with the video; each score is that of the worst frame."""

    frames: int
    psnr_full_db: float
    psnr_body_db: float
    mask_iou: float

    def passes(self) -> bool:
        """Return whether all scores are above their thresholds."""
        return min(self.psnr_full_db, self.psnr_body_db) > MIN_PSNR_DB and self.mask_iou > MIN_IOU


def load_ground_truth(out: Path) -> SyntheticCapture:
    """Load the capture in the folder `out`, so that it can be rendered again.

    Raises:
        UserError: the ground truth is absent, of another version, or one of its files is missing or damaged.
    """
    truth, settings = out / "truth", read_capture_settings(out)
    require_current_version(out, settings)
    camera = load_camera(truth / "camera.npz")
    try:
        ground_m = np.array(settings["ground_m"], dtype=np.float64).reshape(3)
        light = Light(**{name: _tuple_of(value) for name, value in settings["light"].items()})
        fps, samples = float(settings["fps"]), int(settings["samples"])
        hand_held_deg, distortion = float(settings["hand_held_deg"]), float(settings["distortion"])
        is_furnished, seed = settings["background"] == "busy", int(settings["seed"])
    except (KeyError, TypeError, ValueError):
        raise _damaged_settings_error(out) from None
    subject = load_subject(truth)
    is_carried = settings.get("walk_around", False)
    surroundings = make_surroundings(camera, ground_m, is_furnished, ValueNoise(seed)) if is_carried else None
    return SyntheticCapture(
        subject=subject,
        motion=load_motion(truth / "motion.npz"),
        camera=camera,
        light=light,
        room=Room(to_float(read_rgb(truth / "room.png")), floor_points(camera, ground_m)),
        ground_m=ground_m,
        fps=fps,
        samples=samples,
        ball=Ball(ground_m, subject.body.height_m()) if settings.get("ball") else None,
        hand_held_deg=hand_held_deg,
        surroundings=surroundings,
        distortion=distortion,
    )


def _tuple_of(value: Any) -> Any:
    """Return a tuple for a list of JSON, other values as they are."""
    return tuple(value) if isinstance(value, list) else value


def read_capture_settings(out: Path) -> dict[str, Any]:
    """Read the options and the version of a capture. UserError if the file is absent or damaged."""
    path = out / "truth" / "capture_settings.json"
    if not path.is_file():
        command = format_module_command(SAMPLE, out if not out.exists() else "NEW_FOLDER")
        raise UserError(f"{path.parent} holds no ground truth; name a synthetic capture, or make one: {command}")
    try:
        settings = json.loads(path.read_text(encoding="utf-8"))
    except ValueError:
        settings = None
    if not isinstance(settings, dict):
        raise _damaged_settings_error(out)
    return settings


def require_current_version(out: Path, settings: Mapping[str, Any]) -> None:
    """Raise UserError if the capture in `out` was made by another version of the program."""
    if "version" not in settings:
        raise _damaged_settings_error(out)
    if settings["version"] != CAPTURE_VERSION:
        module = _FROM_GLTF if settings.get("source") == "gltf" else SAMPLE
        raise UserError(
            f"{out} is a capture of version {settings['version']}, this program reads version {CAPTURE_VERSION}; "
            f"remove {out} and make it again: {format_module_command(module, out)} with the options in "
            f"{out / 'truth' / 'capture_settings.json'}"
        )


def _damaged_settings_error(out: Path) -> UserError:
    return UserError(
        f"{out / 'truth' / 'capture_settings.json'} is damaged; remove {out} and make the capture again: "
        f"{format_module_command(SAMPLE, out)}"
    )


def load_true_mask(out: Path, frame_index: int, size_px: tuple[int, int] | None = None) -> UInt8[np.ndarray, "h w"]:
    """Read the coverage by the person, 0 to 255, in one frame of a camera that stands still.

    size_px: width and height of the result, such as those of a run's frames; None: those of the capture.
    """
    mask = read_gray(out / "truth" / "masks" / f"{frame_index:06d}.png")
    return mask if size_px is None else cv2.resize(mask, size_px, interpolation=cv2.INTER_AREA)


def verify_ground_truth(out: Path, frame_stride: int = 1) -> GroundTruthCheck:
    """Render the ground truth and compare it with the decoded video and the stored masks.

    frame_stride: compare every n-th frame.

    Raises:
        UserError: a file is missing or damaged, or the numbers of frames differ.
    """
    capture = load_ground_truth(out)
    source = open_frame_source(out / "video")
    if source.n_frames != len(capture.motion.frame_index):
        raise UserError(
            f"{source.path} has {source.n_frames} frames, its ground truth {len(capture.motion.frame_index)}; "
            f"remove {out} and make the capture again"
        )
    scores = []
    longer_side_px = max(capture.camera.width, capture.camera.height)
    for frame in read_frames(source, lambda index: index % frame_stride == 0, longer_side_px):
        image, mask = (capture.as_filmed(still, frame.index) for still in capture.render_frame(frame.index))
        stored = foreground_mask(capture.as_filmed(load_true_mask(out, frame.index), frame.index))
        full, body = psnr_db(image, frame.rgb), psnr_db(image, frame.rgb, stored)
        scores.append((full, body, mask_iou(foreground_mask(mask), stored)))
    return GroundTruthCheck(len(scores), *(float(worst) for worst in np.min(scores, axis=0)))


def write_meshes(out: Path, folder: Path) -> int:
    """Write the clothed person of each frame as `000000.obj`, ... (world, metres, with UV); return their number.

    Raises:
        UserError: there is no ground truth, or `folder` exists.
    """
    capture = load_ground_truth(out)
    subject = capture.subject
    with atomic_folder(folder) as part:
        write_rgb(part / "texture.png", subject.texture)
        for index, pose in enumerate(track(capture.canonical_to_world, "meshes")):
            mesh = Mesh(pose_vertices(subject, pose).numpy(), subject.body.faces)
            normals = mesh.vertex_normals()
            write_obj(part / f"{index:06d}.obj", mesh, subject.uv, subject.faces_uv, normals, ObjMaps("texture.png"))
    return len(capture.canonical_to_world)


def _main(argv: Sequence[str]) -> None:
    parser = argparse.ArgumentParser(
        prog="python -m data_tools.evaluate.truth", description=(__doc__ or "").splitlines()[0]
    )
    parser.add_argument("out", type=Path, help="folder of a synthetic capture")
    parser.add_argument("--frame-stride", type=int, default=8, help="compare every n-th frame (default 8)")
    parser.add_argument("--meshes", type=Path, help="new folder for the person of each frame as .obj")
    options = parser.parse_args(argv)
    if options.frame_stride < 1:
        raise UserError(f"--frame-stride {options.frame_stride} is too small; choose at least 1")
    if options.meshes:
        count = write_meshes(options.out, options.meshes)
        print(f"{count} meshes in {options.meshes}")
        return
    result = verify_ground_truth(options.out, options.frame_stride)
    print(
        f"{result.frames} frames, worst: {result.psnr_full_db:.1f} dB full image, "
        f"{result.psnr_body_db:.1f} dB body pixels, mask IoU {result.mask_iou:.4f}"
    )
    if not result.passes():
        raise UserError(
            f"{options.out} does not match its ground truth (needs {MIN_PSNR_DB} dB and IoU {MIN_IOU}); make it again"
        )


if __name__ == "__main__":
    raise SystemExit(run_command(_main, sys.argv[1:]))
