"""The avatar of a finished run with another diffuse map: what `retexture` and `stylise` read and write."""

from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path

from data_tools.folder import result_folder
from data_tools.pose import export_config
from pipeline.avatar.skinned_avatar import to_rest_pose
from pipeline.core.manifest import read_manifest
from pipeline.texture.files import DIFFUSE, TextureArtifact, TextureFormat, save_maps
from stages import export
from stages.export import Scene, encode_scene, load_scene, make_face, write_scene_obj


@dataclass(frozen=True)
class EditableAvatar:
    """A finished run as its export shows it; `scene` has no moving face, which is made of the edited map.

    texture_format: of the maps of its texture stage.
    """

    scene: Scene
    config: export.Config
    texture_format: TextureFormat


def load_editable_avatar(run: Path) -> EditableAvatar:
    """Read the artifacts of a run with a finished export.

    Raises:
        UserError: the export is not finished, or an artifact cannot be read.
    """
    config = export_config(run)
    inputs = {name: run / name for name in export.STAGE.needs}
    manifest = read_manifest(run / "texture")
    texture_format: TextureFormat = manifest.config.get("format", "png8") if manifest else "png8"
    scene = load_scene(inputs, config.model_copy(update={"face": False}))
    return EditableAvatar(scene, config, texture_format)


def write_edited_avatar(
    avatar: EditableAvatar, texture: TextureArtifact, out: Path, report: Callable[[str], None] = print
) -> None:
    """Write `avatar.glb`, `avatar.obj` with its `.mtl` and maps, and the maps into `out`.

    Rig, animations and face are those of the export; the face gets the edited texture.
    """
    scene, config = avatar.scene, avatar.config
    face = make_face(scene.body, scene.template, scene.skinned, texture) if config.face else None
    edited = replace(scene, texture=texture, face=face)
    with result_folder(out) as part:
        save_maps(part, texture, avatar.texture_format)
        (part / "avatar.glb").write_bytes(encode_scene(edited, config, edited.clips()))
        write_scene_obj(part, part, texture, to_rest_pose(scene.skinned, scene.rig))
    report(f"{out}: avatar.glb, avatar.obj, {DIFFUSE} ({len(texture.diffuse)} px)")
