"""Change the shape of the avatar of a finished run: height, weight, muscle, age of the fitted body.

python -m data_tools.reshape RUN --shape weight=+0.2 [height=-0.1 ...] [--name NAME]

Each change is a part of the body model's range, which is 1. Rig, animations and the face follow. Writes
RUN/reshape/NAME/: avatar.glb, avatar.obj with its maps.
"""

import argparse
import sys
from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np

from data_tools.command import run_command
from data_tools.edited_avatar import EditableAvatar, load_editable_avatar
from data_tools.folder import result_folder
from data_tools.pose import check_folder_name
from pipeline.avatar.placement import FLOOR_PERCENTILE, translate_motion
from pipeline.avatar.rig import build_rig
from pipeline.avatar.skinned_avatar import lowest_vertex_y_m, stand_on_soles, to_rest_pose
from pipeline.body.body import Motion
from pipeline.core.errors import UserError
from pipeline.core.manifest import read_manifest
from pipeline.core.progress import warn
from pipeline.geometry.mesh import Mesh
from pipeline.template.files import FittedTemplate
from pipeline.template.reshape import (
    carry_to_surface,
    parse_shape,
    reshape_body,
    reshape_registration,
    shape_change,
)
from stages.export import Scene, encode_scene, make_face, write_scene_obj


def main(argv: Sequence[str]) -> None:
    """Write one avatar in another shape."""
    options = _parse_options(argv)
    changes = parse_shape([part for entry in options.shape for part in entry.split()])
    if not changes:
        raise UserError("--shape is empty; name a change, such as weight=+0.2")
    name = check_folder_name(options.name) if options.name else _folder_name(changes)
    avatar = load_editable_avatar(options.run)
    scene = reshape_scene(avatar, changes, options.run)
    if scene.face is None and _has_moving_face(options.run):
        warn(
            "this shape is too far from the filmed person for a face that moves: avatar.glb has the filmed face "
            "without morph targets, the rest is complete; a smaller change keeps the face"
        )
    out = options.run / "reshape" / name
    with result_folder(out) as part:
        (part / "avatar.glb").write_bytes(encode_scene(scene, avatar.config, scene.clips()))
        write_scene_obj(options.run / "texture", part, scene.texture, to_rest_pose(scene.skinned, scene.rig))
    print(f"{out}: avatar.glb, avatar.obj")


def reshape_scene(avatar: EditableAvatar, changes: Mapping[str, float], run: Path) -> Scene:
    """Return what the export shows, in another shape.

    Raises:
        UserError: the body of the run is not the built-in one.
    """
    scene, config = avatar.scene, avatar.config
    if scene.template is None:
        raise UserError(f"{run} has a body of a model file; only the built-in body can be reshaped")
    registration, mesh = scene.template.registration, scene.skinned.mesh
    change = shape_change(scene.body, changes)
    body = reshape_body(scene.body, change, changes)
    moved_m = mesh.vertices + carry_to_surface(change, registration, mesh)
    skinned = replace(scene.skinned, mesh=Mesh(moved_m.astype(np.float32), mesh.faces))
    template = FittedTemplate(reshape_registration(registration, change), scene.template.correspondence)
    reshaped = replace(
        scene,
        body=body,
        skinned=skinned,
        rig=stand_on_soles(build_rig(body, config.rig, config.rest_pose), skinned),
        template=template,
        face=make_face(body, template, skinned, scene.texture) if config.face else None,
    )
    return replace(reshaped, motion=stand_on_floor(reshaped, scene))


def stand_on_floor(reshaped: Scene, before: Scene) -> Motion:
    """Return the motion of the new body: steps as long as its legs, the floor at y = 0.

    The height of the hip above the floor is that of the joint `Hips` above the lowest vertex of the A-pose.
    """
    hips_m = [
        float(scene.body.joints_m[scene.body.joint("Hips"), 1] - scene.skinned.mesh.vertices[:, 1].min())
        for scene in (reshaped, before)
    ]
    motion = before.motion
    scaled = motion.with_pose(motion.rotations_wxyz, motion.root_translation_m * (hips_m[0] / hips_m[1]))
    lowest_y_m = np.percentile(lowest_vertex_y_m(reshaped.skinned, reshaped.body, scaled), FLOOR_PERCENTILE)
    return translate_motion(scaled, np.array([0.0, -lowest_y_m, 0.0], dtype=np.float32))


def _has_moving_face(run: Path) -> bool:
    """Return whether the exported avatar has a face that moves."""
    manifest = read_manifest(run / "export")
    return manifest is not None and (manifest.metrics.get("morph_targets") or 0.0) > 0.0


def _folder_name(changes: Mapping[str, float]) -> str:
    return "_".join(f"{key}{value:+g}" for key, value in changes.items())


def _parse_options(argv: Sequence[str]) -> argparse.Namespace:
    parser = argparse.ArgumentParser(prog="python -m data_tools.reshape", description=(__doc__ or "").splitlines()[0])
    parser.add_argument("run", type=Path, help="run folder with a finished export")
    parser.add_argument("--shape", nargs="+", required=True, help="changes, such as weight=+0.2 height=-0.1")
    parser.add_argument("--name", help="of the folder RUN/reshape/NAME; default: the changes")
    return parser.parse_args(argv)


if __name__ == "__main__":
    raise SystemExit(run_command(main, sys.argv[1:]))
