"""A run of the pipeline against the truth of its synthetic capture.

python -m data_tools.compare OUT RUN
"""

import argparse
import sys
from collections.abc import Sequence
from pathlib import Path

import numpy as np
import torch
from jaxtyping import Float

from data_tools.command import run_command
from data_tools.truth import load_truth, true_mask
from pipeline.avatar.body import Body, Motion, canonical_to_world
from pipeline.core.errors import UserError
from pipeline.geometry.camera import project
from pipeline.io.image import read_gray
from pipeline.io.npz import load_body, load_camera, load_motion, load_npz
from pipeline.metrics.images import body_pixels, mask_iou
from pipeline.metrics.surfaces import joint_error_m

MAIN_JOINTS = (
    *("Hips", "Spine", "Spine1", "Spine2", "Neck", "Head"),
    *(f"{side}{part}" for side in ("Left", "Right") for part in ("Arm", "ForeArm", "Hand", "UpLeg", "Leg", "Foot")),
)


def compare_masks(out: Path, frames: Path) -> dict[str, float]:
    """IoU of the masks of the `frames` stage with the true coverage, both cut at one half: mean and worst frame."""
    scores = [
        mask_iou(body_pixels(read_gray(frames / "masks" / f"{index:06d}.png")), body_pixels(true_mask(out, index)))
        for index in load_npz(frames / "frames.npz")["frame_index"].tolist()
    ]
    return {"mask_iou_mean": float(np.mean(scores)), "mask_iou_worst": float(np.min(scores))}


def compare_body(out: Path, body_folder: Path) -> dict[str, float]:
    """Joint errors of the `body` stage, mean over frames and joints, and how far focal length and height are off.

    joint_error_mm is measured after the hips are laid over each other, with the fitted scale; scaled_joint_error_mm
    after the fitted skeleton is scaled to the true distance of neck and hips as well; joint_error_px in the picture.
    Joints that the true rig lacks are left out.

    Raises:
        UserError: a chosen frame is not in the truth.
    """
    truth = load_truth(out)
    body, motion = load_body(body_folder / "body.npz"), load_motion(body_folder / "motion.npz")
    camera = load_camera(body_folder / "camera.npz")
    if motion.frame_index.max() >= len(truth.motion.frame_index):
        raise UserError(f"{body_folder} speaks of frame {motion.frame_index.max()}, {out} has fewer; is it its run?")
    names = [name for name in MAIN_JOINTS if name in truth.subject.body.joint_names and name in body.joint_names]
    fitted = joint_positions(body, motion, names)
    true = joint_positions(truth.subject.body, truth.motion.select(motion.frame_index), names)
    from_hips, true_from_hips = fitted - fitted[:, :1], true - true[:, :1]
    neck = names.index("Neck") if "Neck" in names else names.index("Head")
    scale = np.linalg.norm(true_from_hips[:, neck], axis=1).mean() / np.linalg.norm(from_hips[:, neck], axis=1).mean()
    fitted_px, true_px = (
        project(torch.from_numpy(places).float(), seen_by)[0].numpy()
        for places, seen_by in ((fitted, camera), (true, truth.camera))
    )
    size_ratio = camera.width / truth.camera.width
    return {
        "joint_error_mm": 1000.0 * joint_error_m(from_hips, true_from_hips),
        "scaled_joint_error_mm": 1000.0 * joint_error_m(scale * from_hips, true_from_hips),
        "joint_error_px": float(np.linalg.norm(fitted_px / size_ratio - true_px, axis=2).mean()),
        "focal_ratio": camera.fx / size_ratio / truth.camera.fx,
        "scale_ratio": float(1.0 / scale),
    }


def joint_positions(body: Body, motion: Motion, names: Sequence[str]) -> Float[np.ndarray, "n k 3"]:
    """World positions of the named joints in every frame, metres."""
    joints = [body.joint(name) for name in names]
    transforms = canonical_to_world(body, motion)[:, joints].double()
    places = torch.from_numpy(body.joints_m[joints]).double()
    return ((transforms[..., :3, :3] @ places[:, :, None]).squeeze(-1) + transforms[..., :3, 3]).numpy()


def _main(argv: Sequence[str]) -> None:
    parser = argparse.ArgumentParser(prog="python -m data_tools.compare", description=(__doc__ or "").splitlines()[0])
    parser.add_argument("out", type=Path, help="folder of the synthetic capture")
    parser.add_argument("run", type=Path, help="run folder of the pipeline on OUT/video")
    options = parser.parse_args(argv)
    found = [stage for stage in ("frames", "body") if (options.run / stage / "manifest.json").is_file()]
    if not found:
        raise UserError(f"{options.run} holds no finished stage; run python -m stages --video {options.out}/video")
    if "frames" in found:
        _print(compare_masks(options.out, options.run / "frames"))
    if "body" in found:
        _print(compare_body(options.out, options.run / "body"))


def _print(figures: dict[str, float]) -> None:
    for name, value in figures.items():
        print(f"{name:24}{value:10.4f}")


if __name__ == "__main__":
    raise SystemExit(run_command(_main, sys.argv[1:]))
