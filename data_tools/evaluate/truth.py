"""The truth beside a synthetic capture: load it, and check that it explains the video.

python -m data_tools.evaluate.truth OUT [--meshes FOLDER]
"""

import argparse
import json
import sys
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import UInt8

from data_tools.command import run_command
from data_tools.folder import atomic_folder
from data_tools.synthetic.rig.subject import load_subject
from data_tools.synthetic.scene.backdrop import Room, floor_points
from data_tools.synthetic.scene.ball import Ball
from data_tools.synthetic.scene.capture import SyntheticCapture
from data_tools.synthetic.scene.renderer import Light, pose_vertices
from pipeline.avatar.obj import write_obj
from pipeline.body.files import load_camera, load_motion
from pipeline.capture.video import open_frame_source, read_frames
from pipeline.core.errors import UserError
from pipeline.core.progress import track
from pipeline.geometry.mesh import Mesh
from pipeline.io.image import read_gray, read_rgb, to_float, write_rgb
from pipeline.metrics.images import foreground_mask, mask_iou, psnr_db

MIN_PSNR_DB, MIN_IOU = 45.0, 0.995


@dataclass(frozen=True)
class GroundTruthCheck:
    """How well the truth explains the video: the worst frame of each figure."""

    frames: int
    psnr_full_db: float
    psnr_body_db: float
    mask_iou: float

    def passes(self) -> bool:
        """Whether the truth may be trusted."""
        return min(self.psnr_full_db, self.psnr_body_db) > MIN_PSNR_DB and self.mask_iou > MIN_IOU


def load_ground_truth(out: Path) -> SyntheticCapture:
    """The capture that was written to `out`, ready to be rendered again.

    Raises:
        UserError: there is no truth, or a file of it is missing or damaged.
    """
    truth, recipe = out / "truth", read_recipe(out)
    camera = load_camera(truth / "camera.npz")
    try:
        ground_m = np.array(recipe["ground_m"], dtype=np.float64).reshape(3)
        light = Light(**{**recipe["light"], "key_direction": tuple(recipe["light"]["key_direction"])})
        fps, samples = float(recipe["fps"]), int(recipe["samples"])
    except (KeyError, TypeError, ValueError):
        raise _damaged_recipe_error(out) from None
    subject = load_subject(truth)
    return SyntheticCapture(
        subject=subject,
        motion=load_motion(truth / "motion.npz"),
        camera=camera,
        light=light,
        room=Room(to_float(read_rgb(truth / "room.png")), floor_points(camera, ground_m)),
        ground_m=ground_m,
        fps=fps,
        samples=samples,
        ball=Ball(ground_m, subject.body.height_m()) if recipe.get("ball") else None,
    )


def read_recipe(out: Path) -> dict[str, Any]:
    """With which options, by which version a capture was made. UserError where it is absent or damaged."""
    path = out / "truth" / "recipe.json"
    if not path.is_file():
        raise UserError(f"{path.parent} holds no truth; make a capture with python -m data_tools.sample {out}")
    try:
        recipe = json.loads(path.read_text(encoding="utf-8"))
    except ValueError:
        recipe = None
    if not isinstance(recipe, dict):
        raise _damaged_recipe_error(out)
    return recipe


def _damaged_recipe_error(out: Path) -> UserError:
    return UserError(f"{out / 'truth' / 'recipe.json'} is damaged; remove {out} and make the capture again")


def load_true_mask(out: Path, frame: int) -> UInt8[np.ndarray, "h w"]:
    """Coverage by the person, 0 to 255, of one frame (by its index in the video)."""
    return read_gray(out / "truth" / "masks" / f"{frame:06d}.png")


def verify_ground_truth(out: Path, every: int = 1) -> GroundTruthCheck:
    """Render the stored truth again and compare it with the decoded video and the stored masks.

    every: look at each `every`-th frame.

    Raises:
        UserError: a file is missing or damaged, or the video has not as many frames as the truth.
    """
    capture = load_ground_truth(out)
    source = open_frame_source(out / "video")
    if source.n_frames != len(capture.motion.frame_index):
        raise UserError(
            f"{source.path} has {source.n_frames} frames, its truth {len(capture.motion.frame_index)}; "
            f"remove {out} and make the capture again"
        )
    scores = []
    longer_side_px = max(capture.camera.width, capture.camera.height)
    for frame in read_frames(source, lambda index: index % every == 0, longer_side_px):
        picture, coverage = capture.frame(frame.index)
        stored = foreground_mask(load_true_mask(out, frame.index))
        full, body = psnr_db(picture, frame.rgb), psnr_db(picture, frame.rgb, stored)
        scores.append((full, body, mask_iou(foreground_mask(coverage), stored)))
    return GroundTruthCheck(len(scores), *(float(worst) for worst in np.min(scores, axis=0)))


def write_meshes(out: Path, folder: Path) -> int:
    """Write the clothed person of every frame as `000000.obj`, ... (world, metres, with UV); return their number.

    Raises:
        UserError: there is no truth, or something at `folder`.
    """
    capture = load_ground_truth(out)
    subject = capture.subject
    with atomic_folder(folder) as part:
        write_rgb(part / "texture.png", subject.texture)
        for index, pose in enumerate(track(capture.canonical_to_world, "meshes")):
            mesh = Mesh(pose_vertices(subject, pose).numpy(), subject.body.faces)
            normals = mesh.vertex_normals()
            write_obj(part / f"{index:06d}.obj", mesh, subject.uv, subject.faces_uv, normals, "texture.png", None)
    return len(capture.canonical_to_world)


def _main(argv: Sequence[str]) -> None:
    parser = argparse.ArgumentParser(
        prog="python -m data_tools.evaluate.truth", description=(__doc__ or "").splitlines()[0]
    )
    parser.add_argument("out", type=Path, help="folder of a synthetic capture")
    parser.add_argument("--every", type=int, default=8, help="look at each n-th frame (default 8)")
    parser.add_argument("--meshes", type=Path, help="folder to make: the person of every frame as .obj")
    options = parser.parse_args(argv)
    if options.every < 1:
        raise UserError(f"--every {options.every} is too few; give at least 1")
    if options.meshes:
        count = write_meshes(options.out, options.meshes)
        print(f"{count} meshes in {options.meshes}")
        return
    result = verify_ground_truth(options.out, options.every)
    print(
        f"{result.frames} frames, worst: {result.psnr_full_db:.1f} dB in all, "
        f"{result.psnr_body_db:.1f} dB on the body, mask IoU {result.mask_iou:.4f}"
    )
    if not result.passes():
        raise UserError(
            f"{options.out} contradicts its truth (wanted {MIN_PSNR_DB} dB and IoU {MIN_IOU}); make it again"
        )


if __name__ == "__main__":
    raise SystemExit(run_command(_main, sys.argv[1:]))
