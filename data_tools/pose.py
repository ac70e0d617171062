"""Play motion capture on the avatar of a finished run, or pose it.

python -m data_tools.pose RUN [--bvh CLIP.bvh ...] [--frame 12 | --pose a|t|POSE.json] [--name NAME]

Writes RUN/pose/NAME/: capture.bvh, the motion of the video with standing feet held in place; with --bvh also
avatar.glb, the avatar with each clip as a further animation; with --frame or --pose also avatar.obj, the posed mesh.
"""

import argparse
import sys
from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np
import torch
from jaxtyping import Float32

from data_tools.command import run_command
from data_tools.folder import result_folder
from pipeline.avatar.motion.bvh_export import motion_to_bvh
from pipeline.avatar.motion.feet import find_contacts, snap_feet_to_floor, sole_positions_m
from pipeline.avatar.motion.planting import plant_feet
from pipeline.avatar.motion.retarget import retarget_with_contacts
from pipeline.avatar.placement import pad_motion_to_video, resample_uniformly
from pipeline.avatar.rig import build_rig
from pipeline.body.body import Body, Motion, canonical_to_world
from pipeline.body.files import load_body, load_motion
from pipeline.capture.capture import load_capture
from pipeline.core.command import format_command
from pipeline.core.errors import UserError
from pipeline.core.json_file import load_json
from pipeline.core.manifest import read_manifest, require_matching_stages
from pipeline.geometry.mesh import Mesh
from pipeline.geometry.skinning import linear_blend_skinning, local_quaternions
from pipeline.io.bvh import read_bvh, require_bvh_file, write_bvh
from pipeline.mesh.files import MeshArtifact
from stages import export
from stages.export import Scene, encode_scene, load_scene, write_scene_obj

RIG_POSES = ("a", "t")

EXPORTED_CLIPS = ("capture", "idle")
"""The clips of every avatar."""


def main(argv: Sequence[str]) -> None:
    """Write the clips and poses of one command."""
    options = _parse_options(argv)
    name = _result_name(options)
    _check_clips(options)
    inputs = {name: options.run / name for name in export.STAGE.needs}
    config = export_config(options.run)
    body = load_body(inputs["body"] / "body.npz")
    _check_pose(options, inputs, body)
    scene = load_scene(inputs, config)
    clips = {path.stem: play_bvh(path, body, scene.floor_y_m, options.in_place) for path in options.bvh}
    posed = _chosen_pose(options, scene, clips)
    with result_folder(options.run / "pose" / name) as out:
        write_bvh(out / "capture.bvh", motion_to_bvh(scene.rig, planted_motion(scene), scene.fps))
        if clips:
            (out / "avatar.glb").write_bytes(encode_scene(scene, config, scene.clips() | clips))
        if posed is not None:
            write_scene_obj(inputs["texture"], out, scene.texture, _posed_mesh(scene, posed))
        written = sorted(path.name for path in out.iterdir() if path.suffix in (".bvh", ".glb", ".obj"))
    print(f"{options.run / 'pose' / name}: {', '.join(written)}")


def planted_motion(scene: Scene) -> Motion:
    """Return the motion of the video at its frame rate, with standing feet held where they were."""
    motion = resample_uniformly(scene.motion, scene.fps)
    contact = find_contacts(sole_positions_m(scene.body, motion), motion.time_s)
    return plant_feet(scene.body, motion, contact, scene.floor_y_m)


def play_bvh(path: Path, body: Body, floor_y_m: float, in_place: bool = False) -> Motion:
    """Return a recorded motion of the body on a floor, with feet that stand where the recorded feet stand.

    Args:
        path: of the .bvh file.
        body: to be moved.
        floor_y_m: at which feet stand at their height in the A-pose.
        in_place: remove the horizontal translation; feet are then not held.

    Raises:
        UserError: the file is not a BVH file, lacks a required joint, or has fewer than two frames.
    """
    recorded = read_bvh(path)
    if len(recorded.rotations) < 2:
        raise UserError(f"motion {path} has one frame and no duration; supply a clip of at least two frames")
    try:
        motion, contact = retarget_with_contacts(recorded, body, np.array([0.0, floor_y_m, 0.0]), in_place)
        return motion if in_place else plant_feet(body, motion, contact, floor_y_m)
    except UserError as error:
        raise UserError(f"motion {path}: {error}") from error


def read_pose(path: Path, body: Body) -> Float32[np.ndarray, "1 j 4"]:
    """Read local rotations from the A-pose: a JSON object with a quaternion [w, x, y, z] by Mixamo's joint name.

    Raises:
        UserError: the file cannot be read, a joint is unknown or a value is not a quaternion.
    """
    if path.is_dir():
        raise UserError(f"pose {path} is a folder; choose a, t or a .json file")
    if not path.is_file():
        raise UserError(f"there is no pose {path}; choose a, t or a .json file")
    rotations = np.tile(np.array([1.0, 0.0, 0.0, 0.0], dtype=np.float32), (1, len(body.joint_names), 1))
    try:
        poses = load_json(path)
        entries = {str(name): np.asarray(values, dtype=np.float32) for name, values in poses.items()}
    except (OSError, ValueError, TypeError, AttributeError) as error:
        raise UserError(f'pose {path} is not a JSON object such as {{"LeftArm": [1, 0, 0, 0]}} ({error})') from error
    for name, quaternion in entries.items():
        if name not in body.joint_names:
            raise UserError(f"pose {path}: there is no joint {name}; use Mixamo's names, such as {body.joint_names[1]}")
        if quaternion.shape != (4,) or not np.isfinite(quaternion).all() or not np.linalg.norm(quaternion) > 0:
            raise UserError(f"pose {path}: {name} needs a quaternion of four numbers w, x, y, z that are not all 0")
        rotations[0, body.joint(name)] = quaternion / np.linalg.norm(quaternion)
    return rotations


def export_config(run: Path) -> export.Config:
    """Return the options of the finished export stage of a run, without its further formats.

    These need optional packages, and nothing that reads a finished export writes them.

    Raises:
        UserError: it is not finished, or does not belong to the stages that it has read, as after a new mesh alone.
    """
    if not run.is_dir():
        raise UserError(f"{run} is not a folder; name the folder of a finished run")
    manifest = read_manifest(run / "export")
    if manifest is None:
        raise UserError(f"{run} has no finished export; run {format_command('--run', run)}")
    require_matching_stages(run, (*export.STAGE.needs, export.STAGE.name))
    names = export.Config.model_fields.keys() - {"formats"}
    known = {name: value for name, value in manifest.config.items() if name in names}
    return export.Config(**known)


def check_folder_name(name: str) -> str:
    """Return the name of a result folder. UserError if it is a path."""
    if Path(name).name != name or name in (".", ".."):
        raise UserError(f"--name {name} is not the name of a folder; remove the slashes")
    return name


def _parse_options(argv: Sequence[str]) -> argparse.Namespace:
    parser = argparse.ArgumentParser(prog="python -m data_tools.pose", description=(__doc__ or "").splitlines()[0])
    parser.add_argument("run", type=Path, help="run folder with a finished export")
    parser.add_argument("--bvh", type=Path, action="append", default=[], help="clip to play; repeatable")
    parser.add_argument("--in-place", action="store_true", help="remove the horizontal movement of the clips")
    pose = parser.add_mutually_exclusive_group()
    pose.add_argument("--frame", type=int, help="pose of this frame of the video, or of the clip if there is one")
    pose.add_argument("--pose", help="a, t, or a JSON file with a quaternion [w, x, y, z] by joint name")
    parser.add_argument("--name", help="of the folder RUN/pose/NAME; default: that of the clip or pose")
    return parser.parse_args(argv)


def _result_name(options: argparse.Namespace) -> str:
    """Return the name of the folder: as chosen, or of the first of clip, pose and frame."""
    if options.name:
        return check_folder_name(options.name)
    if options.bvh:
        return str(options.bvh[0].stem)
    if options.pose is not None:
        return Path(options.pose).stem
    return "capture" if options.frame is None else f"frame-{options.frame}"


def _check_clips(options: argparse.Namespace) -> None:
    """Raise UserError for files and names of clips that cannot be used, before anything is read."""
    names = [path.stem for path in options.bvh]
    for path, name in zip(options.bvh, names, strict=True):
        require_bvh_file(path)
        if name in EXPORTED_CLIPS:
            raise UserError(f"{name} is the name of a clip that every avatar has; rename the file {path}")
        if names.count(name) > 1:
            raise UserError(f"there are several clips with the name {name}; rename the file {path}")
    if options.frame is not None and len(options.bvh) > 1:
        raise UserError("--frame is for one clip; name one --bvh")


def _check_pose(options: argparse.Namespace, inputs: Mapping[str, Path], body: Body) -> None:
    """Raise UserError for a pose or a frame of the video that does not exist, before the scene is loaded."""
    if options.pose is not None and options.pose not in RIG_POSES:
        read_pose(Path(options.pose), body)
    if options.frame is not None and not options.bvh:
        capture, motion = load_capture(inputs["frames"]), load_motion(inputs["mesh"] / "motion.npz")
        _select_frame(pad_motion_to_video(motion, capture.fps, capture.n_video_frames), options.frame, of_video=True)


def _select_frame(motion: Motion, frame: int, of_video: bool) -> Motion:
    rows = np.flatnonzero(motion.frame_index == frame)
    if not len(rows):
        raise UserError(
            f"frame {frame} has no pose; choose one of 0 to {motion.frame_index[-1]}"
            + (", of those that the frames stage selected" if of_video else "")
        )
    return motion.select(rows[:1])


def _chosen_pose(options: argparse.Namespace, scene: Scene, clips: Mapping[str, Motion]) -> Motion | None:
    """Return one frame, or None without --frame and --pose."""
    if options.frame is not None:
        motion = next(iter(clips.values())) if clips else scene.motion
        return _select_frame(motion, options.frame, of_video=not clips)
    if options.pose is None:
        return None
    if options.pose in RIG_POSES:
        rig = build_rig(scene.body, rest_pose=options.pose)
        rotations = local_quaternions(rig.bind_to_rest[None, :, :3, :3], scene.body.parents)
    else:
        rotations = read_pose(Path(options.pose), scene.body)
    motion = Motion(np.zeros(1, np.int32), np.zeros(1), rotations, scene.body.joints_m[:1])
    return snap_feet_to_floor(scene.body, motion, scene.floor_y_m)


def _posed_mesh(scene: Scene, motion: Motion) -> MeshArtifact:
    mesh = scene.skinned.mesh
    weights = scene.skinned.dense_skin_weights(len(scene.body.joint_names))
    transforms = canonical_to_world(scene.body, motion)
    posed = linear_blend_skinning(torch.from_numpy(mesh.vertices), weights, transforms)[0].numpy()
    return replace(scene.skinned, mesh=Mesh(posed, mesh.faces))


if __name__ == "__main__":
    raise SystemExit(run_command(main, sys.argv[1:]))
