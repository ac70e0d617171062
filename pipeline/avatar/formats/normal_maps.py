"""The normal map in the JSON tree of a .glb: where it is, and a tree without it."""

from collections.abc import Iterator
from typing import Any


def normal_images(tree: dict[str, Any]) -> set[int]:
    """Return the indices of the images that are normal maps."""
    textures = tree.get("textures", [])
    return {
        textures[material["normalTexture"]["index"]]["source"]
        for material in tree.get("materials", ())
        if "normalTexture" in material
    }


def remove_normal_maps(tree: dict[str, Any]) -> list[int]:
    """Remove the normal maps, their images and the tangents; return the former indices of the images that are left.

    The accessors and buffer views stay until `GlbWriter.remove_unused`.
    """
    gone_images = normal_images(tree)
    kept_images = [index for index in range(len(tree.get("images", ()))) if index not in gone_images]
    for material in tree.get("materials", ()):
        material.pop("normalTexture", None)
    for mesh in tree.get("meshes", ()):
        for primitive in mesh["primitives"]:
            primitive["attributes"].pop("TANGENT", None)
    if not gone_images:
        return kept_images
    textures = tree["textures"]
    kept_textures = [index for index, texture in enumerate(textures) if texture["source"] not in gone_images]
    for reference in _texture_references(tree["materials"]):
        reference["index"] = kept_textures.index(reference["index"])
    tree["textures"] = [textures[index] for index in kept_textures]
    tree["images"] = [tree["images"][index] for index in kept_images]
    for texture in tree["textures"]:
        texture["source"] = kept_images.index(texture["source"])
    return kept_images


def _texture_references(materials: list[dict[str, Any]]) -> Iterator[dict[str, Any]]:
    """Yield every object of the materials that holds the index of a texture."""
    open_objects = list(materials)
    while open_objects:
        for key, value in open_objects.pop().items():
            if isinstance(value, dict):
                if key.endswith("Texture") and "index" in value:
                    yield value
                open_objects.append(value)
