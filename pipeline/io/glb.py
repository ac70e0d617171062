"""Read binary glTF 2.0 files (.glb) into plain arrays: accessors, node transforms, skinned triangles, embedded images.

trimesh reads the positions, UV and triangles of a .glb, but neither joint indices, joint weights, inverse bind matrices
nor animations, and it gives no public access to accessors. Skinned files are therefore read here.

Reference: https://registry.khronos.org/glTF/specs/2.0/glTF-2.0.html, chapters 3.6 (accessors), 3.7.3 (skins) and
4.4 (container).
"""

import io
import struct
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from jaxtyping import Float, Int, UInt8
from PIL import Image
from scipy.spatial.transform import Rotation

from pipeline.core.errors import UserError
from pipeline.core.json_file import parse_json
from pipeline.geometry.colour import linear_to_srgb, srgb_to_linear

_COMPONENT_DTYPES = {5120: "i1", 5121: "u1", 5122: "<i2", 5123: "<u2", 5125: "<u4", 5126: "<f4"}
_N_COMPONENTS = {"SCALAR": 1, "VEC2": 2, "VEC3": 3, "VEC4": 4, "MAT4": 16}
_SUPPORTED_EXTENSIONS = {"KHR_mesh_quantization", "KHR_materials_unlit"}
_JSON_CHUNK, _BINARY_CHUNK = 0x4E4F534A, 0x004E4942
_TRIANGLES = 4
_UNTEXTURED_SIDE_PX = 8

MAX_VALUES = 1 << 27
"""Numbers of an accessor: 40 million vertices. A sparse accessor may claim more than its file holds."""
MAX_IMAGE_PIXELS = 1 << 27
"""Pixels of an embedded image: 11,500 squared. A damaged header may claim any number."""

# What reading a damaged JSON tree raises: each field may be absent, or of any type.
_DAMAGE = (LookupError, TypeError, ValueError, AttributeError, OverflowError, MemoryError, RecursionError)


@dataclass(frozen=True)
class Primitive:
    """One skinned triangle list as stored in the file.

    Attributes:
        positions: in the space of the file's inverse bind matrices.
        normals: of unit length; zeros if the file has none.
        uv: origin top-left, as in glTF; zeros if the file has none.
        joints: indices into the joint list of `skin`.
        weights: one row per vertex; rows sum to 1.
        faces: vertex indices.
        skin: index into the file's skins.
        material: index into the file's materials; -1 if the primitive has none.
    """

    positions: Float[np.ndarray, "v 3"]
    normals: Float[np.ndarray, "v 3"]
    uv: Float[np.ndarray, "v 2"]
    joints: Int[np.ndarray, "v 4"]
    weights: Float[np.ndarray, "v 4"]
    faces: Int[np.ndarray, "f 3"]
    skin: int
    material: int


class GlbFile:
    """A .glb file in memory: `gltf` is its JSON tree, `binary` the chunk from which methods read arrays and images."""

    def __init__(self, path: Path, contents: bytes | None = None) -> None:
        """Read the file.

        Args:
            path: of the file.
            contents: of the file, where they are in memory; `path` is then only its name in messages.

        Raises:
            UserError: the file is not binary glTF 2, is damaged, or requires an unsupported extension.
        """
        self.path = path
        data = contents if contents is not None else path.read_bytes() if path.is_file() else b""
        if len(data) < 20 or data[:4] != b"glTF" or struct.unpack_from("<I", data, 4)[0] != 2:
            raise UserError(f"{path} is no binary glTF 2 file; supply a .glb")
        chunks, offset = {}, 12
        while offset + 8 <= len(data):
            length, kind = struct.unpack_from("<II", data, offset)
            chunks[kind] = data[offset + 8 : offset + 8 + length]
            offset += 8 + length
        try:
            self.gltf: dict[str, Any] = parse_json(chunks[_JSON_CHUNK])
            unsupported = {str(name) for name in self.gltf.get("extensionsRequired", ())} - _SUPPORTED_EXTENSIONS
        except (KeyError, ValueError, AttributeError, TypeError):
            raise UserError(f"{path} is damaged: its JSON cannot be read; export it again") from None
        if unsupported:
            raise UserError(
                f"{path} requires the extension {', '.join(sorted(unsupported))}; export it again without compression"
            )
        self.binary = chunks.get(_BINARY_CHUNK, b"")

    def stored_array(self, index: int) -> np.ndarray:
        """Return the values of an accessor as they are stored, shape (count, components), without conversion.

        A sparse accessor without a buffer view is 0 where it has no values.

        Raises:
            UserError: the file does not hold its values.
        """
        with self.checked(f"the values of accessor {index} are missing"):
            accessor = self.gltf["accessors"][index]
            count, width = accessor["count"], _N_COMPONENTS[accessor["type"]]
            if not 0 <= count * width <= MAX_VALUES:
                raise ValueError(count)
            if "sparse" not in accessor:
                return self._view_array(accessor, accessor["componentType"], count, width)
            sparse, dtype = accessor["sparse"], _COMPONENT_DTYPES[accessor["componentType"]]
            values: np.ndarray = np.zeros((count, width), dtype)
            if "bufferView" in accessor:
                values[:] = self._view_array(accessor, accessor["componentType"], count, width)
            rows = self._view_array(sparse["indices"], sparse["indices"]["componentType"], sparse["count"], 1)[:, 0]
            values[rows] = self._view_array(sparse["values"], accessor["componentType"], sparse["count"], width)
            return values

    @contextmanager
    def checked(self, problem: str = "its nodes, meshes, skins and images do not fit together") -> Iterator[None]:
        """Turn what a damaged tree raises in the block into a UserError with this problem."""
        try:
            yield
        except _DAMAGE:
            raise UserError(f"{self.path} is damaged: {problem}; export it again") from None

    def accessor(self, index: int) -> np.ndarray:
        """Return the values of an accessor, shape (count, components).

        Floats are float32, integers int64. Normalised integers become float32 in [-1, 1] or [0, 1].

        Raises:
            UserError: the file does not hold its values.
        """
        values = self.stored_array(index)
        kind = values.dtype
        if self.gltf["accessors"][index].get("normalized"):
            return np.maximum(values.astype(np.float32) / np.iinfo(kind).max, -1.0)
        return values.astype(np.float32 if kind.kind == "f" else np.int64)

    def image_bytes(self, index: int) -> bytes:
        """Return the encoded file (PNG or JPEG) of an embedded image. UserError if the image is an external file."""
        with self.checked(f"image {index} is missing"):
            image = self.gltf["images"][index]
            if "bufferView" not in image:
                raise UserError(f"{self.path}: image {index} is an external file; export the .glb with embedded images")
            view = self.gltf["bufferViews"][image["bufferView"]]
            start = view.get("byteOffset", 0)
            return self.binary[start : start + view["byteLength"]]

    def image_pixels(self, index: int) -> UInt8[np.ndarray, "h w c"]:
        """Return an embedded image with the channels of its file (RGB or RGBA). UserError as `image_bytes`."""
        pixels = self._decode(index, cv2.IMREAD_UNCHANGED)
        if pixels is None or pixels.ndim != 3 or pixels.dtype != np.uint8:
            raise UserError(f"{self.path}: image {index} has not 8-bit colours; export it as PNG or JPEG")
        return cv2.cvtColor(pixels, cv2.COLOR_BGR2RGB if pixels.shape[2] == 3 else cv2.COLOR_BGRA2RGBA)

    def node_to_world(self) -> Float[np.ndarray, "n 4 4"]:
        """Return the rest-pose matrix of every node. UserError if the nodes are no forest."""
        with self.checked("its nodes are no trees"):
            nodes = self.gltf["nodes"]
            world = np.tile(np.eye(4), (len(nodes), 1, 1))
            children = [child for node in nodes for child in node.get("children", ())]
            if len(set(children)) != len(children):
                raise ValueError("a node with two parents")
            is_child = set(children)
            pending = [(index, np.eye(4)) for index in range(len(nodes)) if index not in is_child]
            while pending:
                index, parent_to_world = pending.pop()
                world[index] = parent_to_world @ _local_matrix(nodes[index])
                pending += [(child, world[index]) for child in nodes[index].get("children", ())]
            return world

    def skinned_primitives(self) -> list[Primitive]:
        """Return all triangle lists of nodes with a skin. UserError if there are none, or the file is damaged."""
        with self.checked():
            found = [
                self._primitive(primitive, node["skin"])
                for node in self.gltf.get("nodes", ())
                if "mesh" in node and "skin" in node
                for primitive in self.gltf["meshes"][node["mesh"]]["primitives"]
                if primitive.get("mode", _TRIANGLES) == _TRIANGLES and "JOINTS_0" in primitive["attributes"]
            ]
        if not found:
            raise UserError(f"{self.path} holds no skinned triangles; export the character with its armature")
        return found

    def base_colour(self, material: int) -> UInt8[np.ndarray, "h w 3"]:
        """Return the base colour texture of a material times its factor, in sRGB; 8 x 8 texels if it has no texture.

        The factor is one of linear light (3.9.2 of the specification).

        material: index; -1 means no material (white).

        Raises:
            UserError: the image is an external file, or neither PNG nor JPEG.
        """
        with self.checked():
            surface = self.gltf["materials"][material].get("pbrMetallicRoughness", {}) if material >= 0 else {}
            factor = np.clip(np.asarray(surface.get("baseColorFactor", [1.0] * 4)[:3], dtype=np.float64), 0.0, 1.0)
            light = srgb_to_linear(np.arange(256)[:, None] / 255.0) * factor
            levels = np.rint(255.0 * linear_to_srgb(light)).astype(np.uint8)
            if "baseColorTexture" not in surface:
                return np.tile(levels[255], (_UNTEXTURED_SIDE_PX, _UNTEXTURED_SIDE_PX, 1))
            texture = self.gltf["textures"][surface["baseColorTexture"]["index"]]
            if "source" not in texture:
                raise UserError(f"{self.path} holds an image that is neither PNG nor JPEG; export it as PNG or JPEG")
            return levels[self._decode_image(texture["source"]), np.arange(3)]

    def _view_array(self, owner: dict[str, Any], component_type: int, count: int, width: int) -> np.ndarray:
        """Return the rows in the buffer view of an accessor or of a part of a sparse one."""
        view, kind = self.gltf["bufferViews"][owner["bufferView"]], np.dtype(_COMPONENT_DTYPES[component_type])
        start = view.get("byteOffset", 0) + owner.get("byteOffset", 0)
        stride = view.get("byteStride", kind.itemsize * width)
        return np.ndarray((count, width), kind, self.binary, start, (stride, kind.itemsize))

    def _primitive(self, primitive: dict[str, Any], skin: int) -> Primitive:
        names = primitive["attributes"]
        positions = self.accessor(names["POSITION"]).astype(np.float32)
        indices = self.accessor(primitive["indices"]) if "indices" in primitive else np.arange(len(positions))
        if (
            not np.isfinite(positions).all()
            or indices.size
            and not 0 <= indices.min() <= indices.max() < len(positions)
        ):
            raise ValueError("triangles of vertices that the file does not have")
        weights = self.accessor(names["WEIGHTS_0"])
        uv = self.accessor(names["TEXCOORD_0"]) if "TEXCOORD_0" in names else np.zeros((len(positions), 2), np.float32)
        normals = self.accessor(names["NORMAL"]).astype(np.float32) if "NORMAL" in names else np.zeros_like(positions)
        return Primitive(
            positions,
            normals,
            uv,
            self.accessor(names["JOINTS_0"]),
            weights / np.maximum(weights.sum(axis=1, keepdims=True), 1e-9),
            indices.reshape(-1, 3).astype(np.int32),
            skin,
            primitive.get("material", -1),
        )

    def _decode_image(self, index: int) -> UInt8[np.ndarray, "h w 3"]:
        pixels = self._decode(index, cv2.IMREAD_COLOR)
        if pixels is None:
            raise UserError(f"{self.path}: image {index} cannot be decoded; export it as PNG or JPEG")
        return cv2.cvtColor(pixels, cv2.COLOR_BGR2RGB)

    def _decode(self, index: int, mode: int) -> np.ndarray | None:
        """Decode an embedded image; None if it is damaged, or its header claims more than `MAX_IMAGE_PIXELS`."""
        content = self.image_bytes(index)
        try:
            with Image.open(io.BytesIO(content)) as header:
                width, height = header.size
        except (OSError, ValueError, SyntaxError, Image.DecompressionBombError):
            return None
        return cv2.imdecode(np.frombuffer(content, np.uint8), mode) if width * height <= MAX_IMAGE_PIXELS else None


def _local_matrix(node: dict[str, Any]) -> Float[np.ndarray, "4 4"]:
    """Return a node's local matrix, from `matrix` (column-major) or translation, rotation (xyzw) and scale."""
    if "matrix" in node:
        return np.array(node["matrix"], dtype=float).reshape(4, 4).T
    rotation = Rotation.from_quat(node.get("rotation", (0.0, 0.0, 0.0, 1.0))).as_matrix()
    matrix = np.eye(4)
    matrix[:3, :3] = rotation * np.asarray(node.get("scale", (1.0, 1.0, 1.0)))
    matrix[:3, 3] = node.get("translation", (0.0, 0.0, 0.0))
    return matrix
