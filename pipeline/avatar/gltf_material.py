"""The material of the avatar's .glb: core metallic-roughness, and KHR_materials_specular or KHR_materials_unlit.

A program that does not know KHR_materials_specular shows a dielectric of 4 %, with the roughness of the core.
"""

from dataclasses import dataclass
from typing import Any

import numpy as np
from jaxtyping import Float, UInt8

from pipeline.io.glb_writer import GlbWriter
from pipeline.io.image import png_bytes, to_uint8
from pipeline.texture.files import TextureArtifact
from pipeline.texture.lighting.specular import dielectric_specular_factor


@dataclass(frozen=True)
class MaterialMaps:
    """Encoded maps and parameters of the material.

    Attributes:
        diffuse_png: RGB, sRGB.
        specular_png: result of `pack_specular_factor`; None for a surface without highlights.
        roughness: in [0, 1]; not used where there is a map.
        roughness_png: result of `pack_roughness`; None for one roughness everywhere.
        normal_png: tangent-space normals, green up; None for a surface without a normal map.
        unlit: viewers show the diffuse map without lights; the other maps are then ignored.
    """

    diffuse_png: bytes
    specular_png: bytes | None = None
    roughness: float = 0.9
    unlit: bool = False
    normal_png: bytes | None = None
    roughness_png: bytes | None = None

    @property
    def has_normals(self) -> bool:
        """Whether the material has a normal map, for which vertices need tangents."""
        return self.normal_png is not None and not self.unlit


def pack_specular_factor(factor: UInt8[np.ndarray, "h w"]) -> UInt8[np.ndarray, "h w 4"]:
    """Return an RGBA image for KHR_materials_specular: the linear specular factor in alpha, RGB white.

    factor: 255 reflects like a standard dielectric (4 % at normal incidence), 0 does not reflect.
    """
    return np.concatenate([np.full((*factor.shape, 3), 255, dtype=np.uint8), factor[..., None]], axis=2)


def pack_roughness(roughness: UInt8[np.ndarray, "h w"]) -> UInt8[np.ndarray, "h w 3"]:
    """Return an RGB image for glTF's metallicRoughnessTexture: roughness in green, metalness 0 in blue.

    Red is white: programs that keep occlusion there find none.
    """
    white, black = np.full_like(roughness, 255), np.zeros_like(roughness)
    return np.stack([white, roughness, black], axis=2)


def encode_gloss(
    texture: TextureArtifact,
    strength: Float[np.ndarray, "h w"],
    roughness: Float[np.ndarray, "h w"] | None,
    matte_roughness: float,
) -> tuple[bytes | None, float, bytes | None]:
    """Return `specular_png`, `roughness` and `roughness_png` of the material.

    Args:
        texture: has the lobe and the lamp of the highlights.
        strength: specular map, in any layout.
        roughness: of the lobes, in the same layout; None for that of `texture.highlights`.
        matte_roughness: of a surface without highlights; where there is a roughness map, of its texels without.
    """
    if not strength.any():
        return None, matte_roughness, None
    lamp, one = texture.light.lamp_irradiance(texture.highlights.direction), texture.highlights.roughness
    factor = to_uint8(dielectric_specular_factor(strength, one if roughness is None else roughness, lamp))
    specular_png = png_bytes(pack_specular_factor(factor))
    if roughness is None:
        return specular_png, one, None
    shown = np.where(factor > 0, roughness, matte_roughness)
    return specular_png, one, png_bytes(pack_roughness(to_uint8(shown)))


def add_material(document: GlbWriter, maps: MaterialMaps) -> int:
    """Add the material with its sampler, textures and images; return its index."""
    document.add("samplers", {"magFilter": 9729, "minFilter": 9987, "wrapS": 33071, "wrapT": 33071})
    optics: dict[str, Any] = {
        "baseColorTexture": {"index": _add_texture(document, "diffuse", maps.diffuse_png)},
        "metallicFactor": 0.0,
        "roughnessFactor": maps.roughness,
    }
    surface: dict[str, Any] = {"name": "avatar", "pbrMetallicRoughness": optics}
    extensions: dict[str, Any] = {"KHR_materials_specular": {"specularFactor": 0.0}}
    if maps.unlit:  # the extension forbids KHR_materials_specular on the same material
        extensions = {"KHR_materials_unlit": {}}
    elif maps.specular_png is not None:
        texture = {"index": _add_texture(document, "specular", maps.specular_png)}
        extensions = {"KHR_materials_specular": {"specularTexture": texture}}
    if maps.roughness_png is not None and not maps.unlit:
        optics |= {
            "metallicRoughnessTexture": {"index": _add_texture(document, "roughness", maps.roughness_png)},
            "roughnessFactor": 1.0,
        }
    if maps.normal_png is not None and maps.has_normals:
        surface["normalTexture"] = {"index": _add_texture(document, "normal", maps.normal_png)}
    document.json["extensionsUsed"] = list(extensions)
    return document.add("materials", surface | {"extensions": extensions})


def _add_texture(document: GlbWriter, name: str, png: bytes) -> int:
    view = document.add_bytes(png)
    image = document.add("images", {"name": name, "mimeType": "image/png", "bufferView": view})
    return document.add("textures", {"name": name, "source": image, "sampler": 0})
