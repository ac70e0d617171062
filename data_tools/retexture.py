"""Give the avatar of a finished run a painted diffuse map, or the clothes of another run's avatar.

python -m data_tools.retexture RUN --diffuse PAINT.png [--name NAME]
python -m data_tools.retexture RUN --from OTHER_RUN [--mask MASK.png] [--name NAME]

PAINT.png and MASK.png have the layout of RUN/texture/diffuse.png, any square size; where two runs were made with
texture.atlas=template, the map of one fits the other. Alpha of the paint says where it applies; white of the mask is
replaced by the other person's texture, without a mask everything from the neck down.
Writes RUN/retexture/NAME/: avatar.glb, avatar.obj with its maps, diffuse.png.
"""

import argparse
import sys
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np
from jaxtyping import Float

from data_tools.command import run_command
from data_tools.edited_avatar import EditableAvatar, load_editable_avatar, write_edited_avatar
from data_tools.pose import check_folder_name
from pipeline.core.errors import UserError
from pipeline.core.progress import warn
from pipeline.geometry.atlas import rasterize_texels
from pipeline.io.image import read_rgb_float
from pipeline.template.layout import load_layout
from pipeline.template.texture_exchange import RegisteredSurface, exchanged_map
from pipeline.texture.files import ATLAS, ROUGHNESS, SPECULAR, TextureArtifact, load_texture, map_files
from pipeline.texture.painting import Painting, enlarge_maps, paint_over, read_mask, read_painting, resize_map

_FOLDERS_OF_MAPS = ("texture", "export", "retexture", "stylise", "reshape", "pose")
"""In a run: maps lie in them, or in their folders, in the layout of its texture."""


def main(argv: Sequence[str]) -> None:
    """Write one edited avatar."""
    options = _parse_options(argv)
    if options.diffuse is not None and options.mask is not None:
        raise UserError("--mask is for the texture of another run; with --diffuse, paint alpha instead")
    image = options.mask or options.diffuse
    default_name = image.stem if image else options.other.resolve().name
    name = check_folder_name(options.name) if options.name else default_name
    if options.diffuse is not None:
        painting = read_painting(options.diffuse)
        avatar = load_editable_avatar(options.run)
        painting = fit_painting(painting, options.diffuse, options.run, avatar.scene.texture)
        texture = paint_over(with_maps_beside(avatar.scene.texture, options.diffuse, options.run), painting)
    else:
        mask = None if options.mask is None else read_mask(options.mask)
        avatar, other = load_editable_avatar(options.run), load_editable_avatar(options.other)
        texture = wear_texture_of(
            (avatar, registered_surface(avatar, options.run)), (other, registered_surface(other, options.other)), mask
        )
    write_edited_avatar(avatar, texture, options.run / "retexture" / name)


def fit_painting(painting: Painting, path: Path, run: Path, texture: TextureArtifact) -> Painting:
    """Return the part of a painting that fits the run's layout: of another run's map, all but its loose parts.

    Raises:
        UserError: the painting is the map of another run, and one of the two has a layout of its own.
    """
    source = run_of_map(path)
    if source is None or source.resolve() == run.resolve():
        return painting
    for folder, cut in ((source, load_texture(source / "texture").cut), (run, texture.cut)):
        if cut is None:
            raise UserError(
                f"{path} has the layout of {source}, and {folder} has one of its own: a map fits another person where "
                f"both were made with texture.atlas=template; or use --from {source}"
            )
    reserved = load_layout().is_reserved(len(painting.colour))
    return replace(painting, alpha=np.where(reserved, np.float32(0.0), painting.alpha))


def run_of_map(path: Path) -> Path | None:
    """Return the run whose texture, a copy or an edit of it, a map lies in; None for a map elsewhere.

    Maps of the wrapped template are none of these: they have its layout in every run.
    """
    folder = path.resolve().parent
    candidates = (folder.parent, folder.parent.parent)
    names = (folder.name, folder.parent.name)
    for run, name in zip(candidates, names, strict=True):
        if name in _FOLDERS_OF_MAPS and (run / "texture" / ATLAS).is_file() and not path.name.startswith("wrapped_"):
            return run
    return None


def with_maps_beside(texture: TextureArtifact, path: Path, run: Path) -> TextureArtifact:
    """Return the run's texture with the highlights of its edited avatar whose map is edited further.

    Args:
        texture: of the run.
        path: a painting; the maps beside it count if it is in a result of `retexture` or `stylise` of this run.
    """
    folder, source = path.resolve().parent, run_of_map(path)
    is_edited = folder.parent.name in ("retexture", "stylise") and (folder / SPECULAR).is_file()
    if not is_edited or source is None or source.resolve() != run.resolve():
        return texture
    specular = read_rgb_float(map_files(folder, SPECULAR)[-1])[..., 0]
    roughness = read_rgb_float(folder / ROUGHNESS)[..., 0]
    texture = enlarge_maps(texture, len(specular))
    side_px = len(texture.diffuse)
    return replace(
        texture,
        specular=np.ascontiguousarray(resize_map(specular, side_px)),
        roughness=np.ascontiguousarray(resize_map(roughness, side_px)) if len(roughness) > 1 else None,
    )


def registered_surface(avatar: EditableAvatar, run: Path) -> RegisteredSurface:
    """Return the surface of an avatar with the template on it.

    Raises:
        UserError: the body of the run is not the built-in one.
    """
    scene = avatar.scene
    if scene.template is None:
        raise UserError(f"{run} has a body of a model file; textures are exchanged between runs with the built-in body")
    return RegisteredSurface(scene.skinned.mesh, scene.template.registration.vertices)


def wear_texture_of(
    target: tuple[EditableAvatar, RegisteredSurface],
    source: tuple[EditableAvatar, RegisteredSurface],
    mask: Float[np.ndarray, "s s"] | None,
) -> TextureArtifact:
    """Return the target's texture with the source's where the mask is white; None: from the neck down.

    Highlights of what is replaced are removed: they belong to the old clothes and to the lamp of one video.
    """
    scene, texture, other = target[0].scene, target[0].scene.texture, source[0].scene.texture
    if texture.light.is_uniform != other.light.is_uniform:
        warn("the light of the video is in one of the two textures and not in the other: the brightness may differ")
    side_px = max(len(texture.diffuse), len(other.diffuse), 0 if mask is None else len(mask))
    colour, alpha = exchanged_map(
        (target[1], texture.atlas),
        (source[1], other.atlas),
        other.diffuse,
        scene.body,
        side_px if mask is None else resize_map(mask, side_px),
    )
    if texture.cut is not None and other.cut is not None:
        colour = same_places(colour, (texture, other))
    painted = paint_over(enlarge_maps(texture, side_px), Painting(colour, alpha))
    return replace(painted, specular=np.asarray(painted.specular * (1.0 - alpha), np.float32))


def same_places(
    colour: Float[np.ndarray, "s s 3"], textures: tuple[TextureArtifact, TextureArtifact]
) -> Float[np.ndarray, "s s 3"]:
    """Return a map in which texels of two people on the template's layout take the other's texel as it is.

    colour: used where one of the two has no chart there, and for loose parts.
    """
    side_px = len(colour)
    known = [rasterize_texels(texture.atlas, side_px).coverage_mask() for texture in textures]
    both = known[0] & known[1] & ~load_layout().is_reserved(side_px)
    return np.where(both[..., None], resize_map(textures[1].diffuse, side_px), colour)


def _parse_options(argv: Sequence[str]) -> argparse.Namespace:
    parser = argparse.ArgumentParser(prog="python -m data_tools.retexture", description=(__doc__ or "").splitlines()[0])
    parser.add_argument("run", type=Path, help="run folder with a finished export")
    kind = parser.add_mutually_exclusive_group(required=True)
    kind.add_argument("--diffuse", type=Path, help="painted map in the layout of texture/diffuse.png")
    kind.add_argument("--from", dest="other", type=Path, help="run folder of the person whose texture is taken")
    parser.add_argument("--mask", type=Path, help="with --from: white is replaced; layout of texture/diffuse.png")
    parser.add_argument("--name", help="of the folder RUN/retexture/NAME; default: that of the mask, map or other run")
    return parser.parse_args(argv)


if __name__ == "__main__":
    raise SystemExit(run_command(main, sys.argv[1:]))
