"""Scores of trials against the ground truth, from the artifacts of a run up to some stage.

Each measure takes the capture and the run and returns numbers by name; `MEASURES` tells the last stage that it needs.
Images are scored on clean renders of the truth (novel views and poses), never on the damaged frames.
"""

import json
from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from jaxtyping import Float, Int, UInt8

from data_tools.evaluate.compare_avatar import (
    compare_labelled_surfaces,
    compare_novel_poses,
    compare_novel_views,
    compare_rest_surfaces,
    compare_texture,
)
from data_tools.evaluate.compare_body import compare_body, compare_surface, joint_positions
from data_tools.evaluate.comparison import Comparison, ImagePair, load_comparison
from data_tools.evaluate.truth import load_ground_truth
from data_tools.stress.image_corruption import flicker_gains
from pipeline.body.body import Body, canonical_to_world
from pipeline.body.files import load_body, load_motion
from pipeline.capture.capture import load_capture
from pipeline.capture.frame_selection import TRAIN
from pipeline.core.manifest import list_files
from pipeline.geometry.colour import linear_to_srgb, srgb_to_linear
from pipeline.geometry.mesh import Mesh
from pipeline.geometry.surface import closest_points_on_mesh
from pipeline.io.image import to_float
from pipeline.io.npz import load_npz
from pipeline.io.tensors import load_tensors
from pipeline.metrics.images import composite_on_white, composite_premultiplied_on_white, foreground_mask, psnr_db
from pipeline.metrics.surfaces import sample_surface
from pipeline.texture.files import load_texture

LIMBS = (
    ("LeftArm", "LeftForeArm"),
    ("LeftForeArm", "LeftHand"),
    ("RightArm", "RightForeArm"),
    ("RightForeArm", "RightHand"),
    ("LeftUpLeg", "LeftLeg"),
    ("LeftLeg", "LeftFoot"),
    ("RightUpLeg", "RightLeg"),
    ("RightLeg", "RightFoot"),
)
"""Start and end joint of each limb whose volume is measured."""

LIMB_MIDDLE = (0.15, 0.85)
"""Part of the bone whose volume counts; at its ends the surface belongs to joints and trunk."""

MIN_EDGE_M = 0.002
STRETCH_PERCENTILE = 99.9
RECALL_M = 0.005
HAND_POINTS = 20_000


@dataclass(frozen=True)
class Measure:
    """A set of scores, and the last stage that it reads."""

    last_stage: str
    scores: Callable[[Path, Path], Mapping[str, float]]


def body_scores(capture: Path, run: Path) -> dict[str, float]:
    """Return joint errors (mm), the ratio of the focal length to the true one, and the surface error (mm)."""
    return {**compare_body(capture, run / "body"), **compare_surface(capture, run / "body")}


def avatar_scores(capture: Path, run: Path) -> dict[str, float]:
    """Return shape, colour, skinning and image scores of the avatar.

    psnr_body_db: novel views after one gain an image, see `gained_psnr_db`. posed_psnr_body_db: novel poses.
    stretch: see `edge_stretch`. limb_volume_low, limb_volume_high: see `limb_volumes`. gain_error: largest error of the
    exposure of a frame, if the capture flickers.
    """
    comparison = load_comparison(capture, run)
    rest = compare_rest_surfaces(comparison)
    scores = {name: rest[name] for name in ("chamfer_mm", "hausdorff95_mm", "far_area_share", "normal_angle_deg")}
    scores |= {"scale_to_truth": rest["scale_to_truth"], **compare_texture(comparison)}
    scores["psnr_body_db"] = mean_gained_psnr_db(compare_novel_views(comparison))
    surfaces, posed = compare_novel_poses(comparison)
    scores["posed_psnr_body_db"] = mean_gained_psnr_db(posed)
    scores["posed_far_area_share"] = surfaces["novel_poses_matched"]["far_area_share"]
    scores["stretch"] = posed_stretch(comparison)
    volumes = [ratio for ratio in limb_volume_ratios(comparison).values() if np.isfinite(ratio)]
    scores |= {"limb_volume_low": min(volumes), "limb_volume_high": max(volumes)}
    for part, values in compare_labelled_surfaces(comparison).items():
        scores[f"{part}_chamfer_mm"] = values["chamfer_mm"]
    texture = load_texture(run / "texture")
    scores["hand_recall"] = hand_recall(comparison)
    scores["specular_mean"] = float(texture.specular.mean())
    return scores | file_scores(run) | body_scores(capture, run)


def gain_scores(capture: Path, run: Path) -> dict[str, float]:
    """Return the scores of the avatar and the largest error of the estimated exposure of a training frame."""
    return avatar_scores(capture, run) | {"gain_error": gain_error(run)}


def refined_pose_scores(capture: Path, run: Path) -> dict[str, float]:
    """Return the joint errors (mm) of the training frames before and after the refinement of the poses."""
    frames = load_capture(run / "frames").split == TRAIN
    scores = {}
    for name, folder in (("fitted", "body"), ("refined", "field")):
        motion = load_motion(run / folder / "motion.npz")
        scores[f"{name}_joint_error_mm"] = joint_error_mm(capture, run, motion.frame_index[frames], folder)
    return scores


def joint_error_mm(capture: Path, run: Path, frames: Int[np.ndarray, "k"], folder: str) -> float:
    """Return the mean distance of the joints from the true ones, hips aligned, after one scale for the person."""
    truth, body = load_ground_truth(capture), load_body(run / "body" / "body.npz")
    true_body = truth.subject.body
    motion = load_motion(run / folder / "motion.npz")
    rows = np.isin(motion.frame_index, frames)
    names = [name for name, _ in LIMBS] + [name for _, name in LIMBS]
    names = ["Hips", *dict.fromkeys(names)]
    found = joint_positions(body, motion.select(rows), names)
    true = joint_positions(true_body, truth.motion.select(motion.frame_index[rows]), names)
    found, true = found - found[:, :1], true - true[:, :1]
    scale = float((found * true).sum() / (found**2).sum())
    return 1000.0 * float(np.linalg.norm(scale * found - true, axis=2).mean())


def mean_gained_psnr_db(pairs: list[ImagePair]) -> float:
    """Return the mean of `gained_psnr_db`; nan without images."""
    return float(np.mean([gained_psnr_db(pair.truth, pair.avatar) for pair in pairs])) if pairs else float("nan")


def gained_psnr_db(truth: UInt8[np.ndarray, "h w 4"], avatar: Float[np.ndarray, "h w 4"]) -> float:
    """Return the PSNR of body pixels after the linear gain of the render that fits them best.

    truth: straight RGBA. avatar: premultiplied RGBA in [0, 1].
    """
    body = foreground_mask(truth[..., 3])
    image = composite_on_white(np.ascontiguousarray(truth[..., :3]), np.ascontiguousarray(truth[..., 3]))
    both = body & (avatar[..., 3] > 0.99)
    shown, wanted = (srgb_to_linear(np.asarray(c, np.float64)[both]) for c in (avatar[..., :3], to_float(image)))
    gain = float((shown * wanted).sum() / max((shown**2).sum(), 1e-9))
    alpha = avatar[..., 3:]
    straight = np.where(alpha > 0, avatar[..., :3] / np.maximum(alpha, 1e-6), 0.0)
    exposed = np.clip(linear_to_srgb(np.clip(gain * srgb_to_linear(straight), 0.0, 1.0)), 0.0, 1.0)
    render = composite_premultiplied_on_white(np.concatenate([exposed * alpha, alpha], axis=2).astype(np.float32))
    return psnr_db(render, image, body)


def posed_stretch(comparison: Comparison) -> float:
    """Return the 99.9th percentile of `edge_stretch` over all novel poses."""
    motion = load_motion(comparison.folder / "novel_poses" / "motion.npz")
    poses = canonical_to_world(comparison.run.body, comparison.rigs.match(motion))
    rest = comparison.run.avatar.mesh()
    posed = [comparison.run.avatar.pose_vertices(pose).numpy() for pose in poses]
    ratios = np.concatenate([edge_stretch(rest, vertices) for vertices in posed])
    return float(np.percentile(ratios, STRETCH_PERCENTILE))


def edge_stretch(rest: Mesh, posed_vertices: Float[np.ndarray, "v 3"]) -> Float[np.ndarray, "e"]:
    """Return the length of each edge over its length in the rest mesh, for edges longer than `MIN_EDGE_M` there."""
    edges = np.unique(np.sort(rest.faces[:, [[0, 1], [1, 2], [2, 0]]].reshape(-1, 2), axis=1), axis=0)
    before, after = (
        np.linalg.norm(vertices[edges[:, 0]] - vertices[edges[:, 1]], axis=1)
        for vertices in (rest.vertices, posed_vertices)
    )
    return after[before > MIN_EDGE_M] / before[before > MIN_EDGE_M]


def limb_volume_ratios(comparison: Comparison) -> dict[str, float]:
    """Return the volume of each limb of the avatar over the true one, both over the cube of their stature."""
    body, true_body = comparison.run.body, comparison.truth.subject.body
    avatar = comparison.run.avatar
    weights = np.zeros((len(avatar.vertices), len(body.joint_names)))
    np.put_along_axis(weights, avatar.joint_indices.numpy(), avatar.joint_weights.numpy(), axis=1)
    own = replace(body, vertices=avatar.vertices.numpy(), faces=avatar.faces.numpy(), skin_weights=weights)
    found, true = limb_volumes_m3(own), limb_volumes_m3(true_body)
    cube = (own.height_m() / true_body.height_m()) ** 3
    return {name: found[name] / (cube * true[name]) if true[name] > 0 else float("nan") for name in found}


def limb_volumes_m3(body: Body) -> dict[str, float]:
    """Return the volume within the surface of each limb over the middle of its bone.

    A tube that planes cut at right angles to its axis holds half the integral of the radial vector times the normal
    over its side (divergence theorem; the planes add nothing).
    """
    corners = body.vertices[body.faces].astype(np.float64)
    area_normal = 0.5 * np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    centre, joint = corners.mean(axis=1), body.skin_weights[body.faces].sum(axis=1).argmax(axis=1)
    volumes = {}
    for start, end in LIMBS:
        origin = body.joints_m[body.joint(start)].astype(np.float64)
        bone = body.joints_m[body.joint(end)] - origin
        length = float(np.linalg.norm(bone))
        axis = bone / length
        along = (centre - origin) @ axis / length
        chosen = (along > LIMB_MIDDLE[0]) & (along < LIMB_MIDDLE[1]) & (joint == body.joint(start))
        offset = centre[chosen] - origin
        radial = offset - (offset @ axis)[:, None] * axis
        volumes[start] = 0.5 * float((radial * area_normal[chosen]).sum())
    return volumes


def hand_recall(comparison: Comparison) -> float:
    """Return the share of the true hands' area within 5 mm of the avatar, both in the true A-pose."""
    body = comparison.truth.subject.body
    hands = [index for index, name in enumerate(body.joint_names) if "Hand" in name]
    is_hand = np.isin(body.skin_weights[body.faces].sum(axis=1).argmax(axis=1), hands)
    points, _ = sample_surface(Mesh(body.vertices, body.faces[is_hand]), HAND_POINTS)
    avatar = comparison.alignment.transform_mesh(comparison.rest_mesh)
    return float((closest_points_on_mesh(points, avatar)[0] <= RECALL_M).mean())


def gain_error(run: Path, amplitude: float | None = None) -> float:
    """Return the largest relative error of the estimated gains of the training frames, after one common gain.

    amplitude: of the flicker; None: that of `FLICKER`.
    """
    capture = load_capture(run / "frames")
    gains = flicker_gains(capture.n_video_frames, FLICKER if amplitude is None else amplitude)[capture.frame_index]
    train = capture.split == TRAIN
    estimated = np.asarray(load_texture(run / "texture").light.gain)
    ratio = (estimated.reshape(len(estimated), -1).mean(axis=1) / gains)[train]
    return float(np.abs(ratio / np.median(ratio) - 1.0).max())


FLICKER = 0.3
"""Amplitude of the flicker whose gains are compared."""


def file_scores(run: Path) -> dict[str, float]:
    """Return the number of files of a run with a value that is not finite; unknown landmarks are nan by definition."""
    return {"files_with_nan": float(len(files_with_nonfinite_values(run)))}


NAN_ALLOWED = ("frames/frames.npz", "body/scores.npz")
"""Files in which nan means unknown."""


def files_with_nonfinite_values(run: Path) -> list[str]:
    """Return the arrays and tensors of a run, and the JSON files with bare NaN or Infinity, that are not finite."""
    found = []
    for name in list_files(run):
        path = run / name
        if name in NAN_ALLOWED:
            continue
        if path.suffix == ".npz":
            arrays = load_npz(path).values()
            broken = any(a.dtype.kind == "f" and not np.isfinite(a).all() for a in arrays)
        elif path.suffix == ".safetensors":
            broken = any(not bool(t.isfinite().all()) for t in load_tensors(path)[0].values() if t.is_floating_point())
        elif path.suffix == ".json":
            constants: list[str] = []
            json.loads(path.read_text(encoding="utf-8"), parse_constant=constants.append)
            broken = bool(constants)
        else:
            broken = False
        if broken:
            found.append(name)
    return found


MEASURES = {
    "body": Measure("body", body_scores),
    "poses": Measure("field", refined_pose_scores),
    "avatar": Measure("texture", avatar_scores),
    "gains": Measure("texture", gain_scores),
    "files": Measure("report", lambda capture, run: file_scores(run)),
}
