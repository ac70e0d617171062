"""Write binary glTF 2.0 files (.glb): the JSON tree grows object by object, the binary chunk array by array.

A document is built from nothing, or continues a file that was read (`GlbWriter.from_file`): its arrays and images are
then replaced, and what nothing refers to any more is not written.

Reference: https://registry.khronos.org/glTF/specs/2.0/glTF-2.0.html, chapters 3.6 (accessors) and 4.4 (container).
"""

import copy
import json
import struct
from collections.abc import Iterator
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from jaxtyping import Shaped

from pipeline.io.glb import GlbFile

_ACCESSOR_TYPES = {1: "SCALAR", 2: "VEC2", 3: "VEC3", 4: "VEC4", 16: "MAT4"}
_COMPONENT_TYPES = {"int8": 5120, "uint8": 5121, "int16": 5122, "uint16": 5123, "uint32": 5125, "float32": 5126}


@dataclass
class GlbWriter:
    """Accumulates the JSON chunk and the binary chunk of a .glb."""

    json: dict[str, Any] = field(default_factory=dict)
    binary: bytearray = field(default_factory=bytearray)

    @classmethod
    def from_file(cls, file: GlbFile) -> "GlbWriter":
        """Return a copy of a file's contents, with the same indices."""
        return cls(copy.deepcopy(file.gltf), bytearray(file.binary))

    def add(self, kind: str, value: dict[str, Any]) -> int:
        """Append an object to a top-level array such as "nodes"; return its index."""
        self.json.setdefault(kind, []).append(value)
        return len(self.json[kind]) - 1

    def add_bytes(self, data: bytes, target: int | None = None) -> int:
        """Append a buffer view, aligned to 4 bytes; return its index."""
        self.binary.extend(b"\0" * (-len(self.binary) % 4))
        view = {"buffer": 0, "byteOffset": len(self.binary), "byteLength": len(data)}
        self.binary.extend(data)
        return self.add("bufferViews", view | ({"target": target} if target else {}))

    def add_array(self, values: Shaped[np.ndarray, "n *c"], target: int | None = None, bounds: bool = False) -> int:
        """Append an accessor, one element per row; `bounds` adds min and max. Return its index."""
        values = np.ascontiguousarray(values)
        accessor: dict[str, Any] = {
            "bufferView": self.add_bytes(values.tobytes(), target),
            "componentType": _COMPONENT_TYPES[values.dtype.name],
            "count": len(values),
            "type": _ACCESSOR_TYPES[values[0].size],
        }
        if bounds:
            accessor |= _bounds(values)
        return self.add("accessors", accessor)

    def add_sparse_array(self, values: Shaped[np.ndarray, "n *c"], bounds: bool = False) -> int:
        """Append an accessor that stores only the rows that are not 0; return its index. `bounds` as in `add_array`."""
        rows = np.flatnonzero(values.any(axis=tuple(range(1, values.ndim))))
        rows = (rows if len(rows) else np.zeros(1)).astype(np.uint16 if len(values) <= 65536 else np.uint32)
        indices = {"bufferView": self.add_bytes(rows.tobytes()), "componentType": _COMPONENT_TYPES[rows.dtype.name]}
        stored = {"bufferView": self.add_bytes(np.ascontiguousarray(values[rows]).tobytes())}
        accessor = {
            "componentType": _COMPONENT_TYPES[values.dtype.name],
            "count": len(values),
            "type": _ACCESSOR_TYPES[values[0].size],
            "sparse": {"count": len(rows), "indices": indices, "values": stored},
        }
        return self.add("accessors", accessor | (_bounds(values) if bounds else {}))

    def replace_array(self, index: int, values: Shaped[np.ndarray, "n *c"]) -> None:
        """Give an accessor other values: index, target, and whether it is sparse or has min and max, stay.

        values: in the file's component type or another one that its use allows; rows of 4 bytes or a multiple for
        vertex attributes.
        """
        old = self.json["accessors"][index]
        target = self.json["bufferViews"][old["bufferView"]].get("target") if "bufferView" in old else None
        bounds = "min" in old
        added = self.add_sparse_array(values, bounds) if "sparse" in old else self.add_array(values, target, bounds)
        new = self.json["accessors"].pop(added)
        kept = {key: old[key] for key in ("name", "normalized") if key in old}
        self.json["accessors"][index] = new | kept

    def replace_image(self, index: int, data: bytes, mime_type: str) -> None:
        """Give an image other contents: a whole encoded file."""
        self.json["images"][index] |= {"bufferView": self.add_bytes(data), "mimeType": mime_type}

    def remove_unused(self) -> None:
        """Remove the accessors and buffer views that nothing refers to, and their bytes; renumber the others."""
        self._keep("accessors", list(_accessor_references(self.json)))
        self._keep("bufferViews", list(_view_references(self.json)))
        old, self.binary = bytes(self.binary), bytearray()
        for view in self.json.get("bufferViews", ()):
            start = view.get("byteOffset", 0)
            self.binary.extend(b"\0" * (-len(self.binary) % 4))
            view["byteOffset"] = len(self.binary)
            self.binary.extend(old[start : start + view["byteLength"]])

    def to_bytes(self) -> bytes:
        """Return the whole file; the JSON chunk is padded with spaces, the binary chunk with zeros."""
        self.json["buffers"] = [{"byteLength": len(self.binary)}]
        text = json.dumps(self.json, separators=(",", ":"), ensure_ascii=True).encode()
        text += b" " * (-len(text) % 4)
        binary = bytes(self.binary) + b"\0" * (-len(self.binary) % 4)
        chunks = struct.pack("<I4s", len(text), b"JSON") + text + struct.pack("<I4s", len(binary), b"BIN\0") + binary
        return struct.pack("<4sII", b"glTF", 2, 12 + len(chunks)) + chunks

    def _keep(self, kind: str, references: list[tuple[dict[str, Any], str]]) -> None:
        used = sorted({owner[key] for owner, key in references})
        renumbered = {old: new for new, old in enumerate(used)}
        for owner, key in references:
            owner[key] = renumbered[owner[key]]
        self.json[kind] = [self.json[kind][index] for index in used]


def _bounds(values: np.ndarray) -> dict[str, list[float]]:
    rows = values.reshape(len(values), -1)
    return {"min": rows.min(axis=0).tolist(), "max": rows.max(axis=0).tolist()}


def _accessor_references(tree: dict[str, Any]) -> Iterator[tuple[dict[str, Any], str]]:
    """Yield every place that holds the index of an accessor: the object and the key in it."""
    for mesh in tree.get("meshes", ()):
        for primitive in mesh["primitives"]:
            for attributes in (primitive["attributes"], *primitive.get("targets", ())):
                yield from ((attributes, name) for name in attributes)
            if "indices" in primitive:
                yield primitive, "indices"
    for skin in tree.get("skins", ()):
        if "inverseBindMatrices" in skin:
            yield skin, "inverseBindMatrices"
    for animation in tree.get("animations", ()):
        for sampler in animation["samplers"]:
            yield sampler, "input"
            yield sampler, "output"


def _view_references(tree: dict[str, Any]) -> Iterator[tuple[dict[str, Any], str]]:
    """Yield every place that holds the index of a buffer view: the object and the key in it."""
    owners = [*tree.get("accessors", ()), *tree.get("images", ())]
    for accessor in tree.get("accessors", ()):
        sparse = accessor.get("sparse", {})
        owners += [sparse[part] for part in ("indices", "values") if part in sparse]
    primitives = [primitive for mesh in tree.get("meshes", ()) for primitive in mesh["primitives"]]
    owners += [extension for primitive in primitives for extension in primitive.get("extensions", {}).values()]
    yield from ((owner, "bufferView") for owner in owners if "bufferView" in owner)
