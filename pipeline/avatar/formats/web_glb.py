"""Compress the avatar's .glb for web pages: Draco geometry, WebP textures, 16-bit rotations.

A viewer needs decoders for it: three.js with DRACOLoader, model-viewer, Babylon.js and Blender have them; the
uncompressed .glb stays the file for everything else. No wheel encodes meshopt compression or KTX2.

References: KHR_draco_mesh_compression and EXT_texture_webp in https://github.com/KhronosGroup/glTF/tree/main/extensions.
"""

import io
from typing import Any

import numpy as np
from jaxtyping import Float, Int, UInt8, UInt16
from PIL import Image

from pipeline.avatar.formats.normal_maps import normal_images
from pipeline.io.glb import GlbFile
from pipeline.io.glb_writer import GlbWriter

POSITION_BITS, UV_BITS, NORMAL_BITS = 14, 14, 9
"""Bits of a coordinate. The step of a position is the largest extent of the mesh / 2^14: 0.11 mm of 1.8 m."""

MIN_COLOUR_PSNR_DB, MIN_SPECULAR_PSNR_DB = 42.0, 30.0
"""Least accuracy of the textures over the whole image. The specular factor scales a reflection of 4 %; WebP codes it
without prediction, at 40 dB in two to ten times the bytes of the colours."""

_WEBP_QUALITIES = (20, 40, 60, 75, 85, 90, 95)
_DRACO_LEVEL = 10
_WEIGHT_MAX = 65535
_ROTATION_MAX = 32767
_JOINTS_ID, _WEIGHTS_ID = 0, 1
_DRACO_TYPES = {"POSITION": 0, "NORMAL": 1, "TEXCOORD_0": 3}
"""Draco's number of the kind of attribute; joints and weights are generic attributes with the identifiers above."""


def encode_web_glb(file: GlbFile) -> bytes:
    """Return the avatar as a .glb that requires KHR_draco_mesh_compression and EXT_texture_webp.

    Args:
        file: triangle lists with positions, normals, texture coordinates, joints and weights. Morphs are not
            compressed, lose their normals, and keep the order of the vertices, with which Draco compresses less.

    Raises:
        UserError: the file's arrays or images cannot be read.
        ModuleNotFoundError: the package DracoPy is not installed.
    """
    document = GlbWriter.from_file(file)
    for mesh in document.json["meshes"]:
        for primitive in mesh["primitives"]:
            _compress_primitive(file, document, primitive)
    # an error of 42 dB would be 1 degree of the normals, and 8 % of the peak of a highlight
    lossless = normal_images(file.gltf) | _roughness_images(file.gltf)
    for index in range(len(document.json.get("images", ()))):
        pixels = file.image_pixels(index)
        encoded = encode_lossless_webp(pixels) if index in lossless else encode_webp(pixels)
        document.replace_image(index, encoded, "image/webp")
    for texture in document.json.get("textures", ()):
        texture["extensions"] = {"EXT_texture_webp": {"source": texture.pop("source")}}
    for animation in document.json.get("animations", ()):
        for channel in animation["channels"]:
            if channel["target"]["path"] == "rotation":
                _quantise_rotations(file, document, animation["samplers"][channel["sampler"]]["output"])
    required = ["KHR_draco_mesh_compression", "EXT_texture_webp"]
    document.json["extensionsUsed"] = [*document.json.get("extensionsUsed", ()), *required]
    document.json["extensionsRequired"] = required
    document.remove_unused()
    return document.to_bytes()


def _roughness_images(tree: dict[str, Any]) -> set[int]:
    """Return the indices of the images that are roughness maps; these have few values, and are small without loss."""
    optics = [material.get("pbrMetallicRoughness", {}) for material in tree.get("materials", ())]
    used = [each["metallicRoughnessTexture"]["index"] for each in optics if "metallicRoughnessTexture" in each]
    return {tree["textures"][index]["source"] for index in used}


def encode_webp(pixels: UInt8[np.ndarray, "h w c"]) -> bytes:
    """Encode an image as WebP, with the least quality that reaches the PSNR of its kind; else lossless.

    pixels: RGB, or RGBA whose alpha channel holds the values and whose colours are white (a specular map).
    """
    image, is_specular = Image.fromarray(pixels), pixels.shape[2] == 4
    channels = slice(3, 4) if is_specular else slice(0, 3)
    least_db = MIN_SPECULAR_PSNR_DB if is_specular else MIN_COLOUR_PSNR_DB
    for quality in _WEBP_QUALITIES:
        encoded = io.BytesIO()
        image.save(encoded, "WEBP", quality=quality, alpha_quality=quality, method=4)
        decoded = np.asarray(Image.open(encoded).convert(image.mode))[..., channels].astype(np.float32)
        error = float(np.mean((decoded - pixels[..., channels]) ** 2))
        if error <= 255.0**2 * 10.0 ** (-least_db / 10.0):
            return encoded.getvalue()
    return encode_lossless_webp(pixels)


def encode_lossless_webp(pixels: UInt8[np.ndarray, "h w c"]) -> bytes:
    """Encode an RGB or RGBA image as WebP without loss."""
    encoded = io.BytesIO()
    Image.fromarray(pixels).save(encoded, "WEBP", lossless=True)
    return encoded.getvalue()


def quantise_weights(weights: Float[np.ndarray, "v 4"]) -> UInt16[np.ndarray, "v 4"]:
    """Return weights as 16-bit fractions whose rows sum to 65535, as glTF requires; the largest takes the rest."""
    fractions = np.floor(weights.astype(np.float64) * _WEIGHT_MAX).astype(np.int64)
    fractions[np.arange(len(weights)), weights.argmax(axis=1)] += _WEIGHT_MAX - fractions.sum(axis=1)
    return fractions.astype(np.uint16)


def _compress_primitive(file: GlbFile, document: GlbWriter, primitive: dict[str, Any]) -> None:
    import DracoPy  # an optional package

    attributes = primitive["attributes"]
    for target in primitive.get("targets", ()):
        target.pop("NORMAL", None)  # as many bytes as the displacements
    attributes.pop("TANGENT", None)  # viewers derive it; its 16 bytes a vertex would be half of the geometry
    stored = {name: np.ascontiguousarray(file.stored_array(index)) for name, index in attributes.items()}
    stored["WEIGHTS_0"] = quantise_weights(file.accessor(attributes["WEIGHTS_0"]))
    faces: Int[np.ndarray, "f 3"] = file.accessor(primitive["indices"]).reshape(-1, 3)
    data = DracoPy.encode(
        stored["POSITION"],
        faces.astype(np.uint32),
        quantization_bits=POSITION_BITS,
        compression_level=_DRACO_LEVEL,
        tex_coord=stored["TEXCOORD_0"].astype(np.float64),
        tex_coord_quantization_bits=UV_BITS,
        normals=stored["NORMAL"].astype(np.float64),
        normal_quantization_bits=NORMAL_BITS,
        preserve_order="targets" in primitive,
        generic_attributes={_JOINTS_ID: stored["JOINTS_0"], _WEIGHTS_ID: stored["WEIGHTS_0"]},
    )
    decoded = DracoPy.decode(data)  # Draco reorders the vertices, may duplicate some, and rounds the bounds
    identifiers = {"JOINTS_0": _JOINTS_ID, "WEIGHTS_0": _WEIGHTS_ID}
    for attribute in decoded.attributes:
        names = [name for name, kind in _DRACO_TYPES.items() if kind == attribute["attribute_type"]]
        identifiers |= dict.fromkeys(names, attribute["unique_id"])
    for name, index in attributes.items():
        accessor = document.json["accessors"][index]
        accessor.pop("bufferView")
        accessor["count"] = len(decoded.points)
        if name == "POSITION":
            accessor |= {"min": decoded.points.min(axis=0).tolist(), "max": decoded.points.max(axis=0).tolist()}
        elif name == "WEIGHTS_0":
            accessor |= {"componentType": 5123, "normalized": True}
    indices = document.json["accessors"][primitive["indices"]]
    indices.pop("bufferView")
    indices |= {"componentType": 5125, "count": decoded.faces.size}
    compression = {"bufferView": document.add_bytes(data), "attributes": identifiers}
    primitive["extensions"] = {"KHR_draco_mesh_compression": compression}


def _quantise_rotations(file: GlbFile, document: GlbWriter, index: int) -> None:
    """Store quaternions as normalised 16-bit integers."""
    rounded = np.rint(file.accessor(index) * _ROTATION_MAX).astype(np.int16)
    document.replace_array(index, rounded)
    document.json["accessors"][index]["normalized"] = True
