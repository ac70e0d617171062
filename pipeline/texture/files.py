"""The artifact of the texture stage: the UV atlas as npz, the maps as images. One writer, one reader."""

from dataclasses import dataclass
from pathlib import Path

import numpy as np
from jaxtyping import UInt8

from pipeline.core.errors import UserError
from pipeline.geometry.atlas import Atlas
from pipeline.io.image import read_gray, read_rgb, write_gray, write_rgb
from pipeline.io.npz import load_npz, save_npz

ATLAS, DIFFUSE, SPECULAR, COVERAGE = "atlas.npz", "diffuse.png", "specular.png", "coverage.png"


@dataclass(frozen=True)
class TextureArtifact:
    """The atlas and its maps; row 0 of a map is v = 1.

    Attributes:
        atlas: UV layout of the mesh.
        diffuse: sRGB, 0 to 255, gutters filled.
        specular: what a highlight adds to the diffuse colour, sRGB, 0 to 255; all 0 for a matte surface.
        coverage: confidence that the video shows the texel, 0 to 255; 0 outside the charts.
    """

    atlas: Atlas
    diffuse: UInt8[np.ndarray, "s s 3"]
    specular: UInt8[np.ndarray, "s s"]
    coverage: UInt8[np.ndarray, "s s"]


def save_texture(folder: Path, texture: TextureArtifact) -> None:
    """Write the atlas and the maps into `folder`; `load_texture` is the inverse."""
    atlas = texture.atlas
    save_npz(folder / ATLAS, {"uv": atlas.uv, "faces_uv": atlas.faces_uv, "vertex_of_uv": atlas.vertex_of_uv})
    write_rgb(folder / DIFFUSE, texture.diffuse)
    write_gray(folder / SPECULAR, texture.specular)
    write_gray(folder / COVERAGE, texture.coverage)


def load_texture(folder: Path) -> TextureArtifact:
    """Read what `save_texture` wrote.

    Raises:
        UserError: a file is missing or unreadable, or the atlas lacks an array.
    """
    arrays = load_npz(folder / ATLAS)
    try:
        atlas = Atlas(arrays["uv"], arrays["faces_uv"], arrays["vertex_of_uv"])
    except KeyError as error:
        raise UserError(f"{folder / ATLAS} lacks the array {error}; run `python -m stages.texture` again") from None
    return TextureArtifact(
        atlas, read_rgb(folder / DIFFUSE), read_gray(folder / SPECULAR), read_gray(folder / COVERAGE)
    )
