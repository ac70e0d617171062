"""Changing a .glb: what is kept is equal, what nothing refers to is gone, and indices follow."""

from pathlib import Path

import numpy as np
import pytest

from pipeline.io.glb import GlbFile
from pipeline.io.glb_writer import GlbWriter
from tests.io.test_glb import textured_box


@pytest.fixture
def box(tmp_path: Path) -> GlbFile:
    return GlbFile(textured_box(tmp_path / "box.glb"))


def written(document: GlbWriter, folder: Path) -> GlbFile:
    (folder / "written.glb").write_bytes(document.to_bytes())
    return GlbFile(folder / "written.glb")


def attribute(file: GlbFile, name: str) -> np.ndarray:
    return file.accessor(file.gltf["meshes"][0]["primitives"][0]["attributes"][name])


def test_a_copy_holds_the_same_arrays_and_images(box: GlbFile, tmp_path: Path) -> None:
    document = GlbWriter.from_file(box)
    document.remove_unused()
    copy = written(document, tmp_path)
    for name in ("POSITION", "TEXCOORD_0"):
        np.testing.assert_array_equal(attribute(copy, name), attribute(box, name))
    assert copy.image_bytes(0) == box.image_bytes(0)


def test_replaced_contents_are_read_back_and_the_old_ones_are_gone(box: GlbFile, tmp_path: Path) -> None:
    document = GlbWriter.from_file(box)
    index = document.json["meshes"][0]["primitives"][0]["attributes"]["POSITION"]
    half = (0.5 * box.accessor(index)[:10]).astype(np.float32)
    document.replace_array(index, half)
    document.replace_image(0, b"short", "image/png")
    document.remove_unused()
    changed = written(document, tmp_path)
    np.testing.assert_array_equal(attribute(changed, "POSITION"), half)
    stored = changed.gltf["accessors"][changed.gltf["meshes"][0]["primitives"][0]["attributes"]["POSITION"]]
    assert stored["max"] == half.max(axis=0).tolist()
    assert changed.image_bytes(0) == b"short"
    views = sum(view["byteLength"] for view in changed.gltf["bufferViews"])
    assert views <= len(changed.binary) < views + 4 * len(changed.gltf["bufferViews"])


def test_arrays_that_nothing_refers_to_are_removed(box: GlbFile, tmp_path: Path) -> None:
    document = GlbWriter.from_file(box)
    document.add_array(np.zeros((5, 3), dtype=np.float32))
    document.json["accessors"].insert(0, document.json["accessors"].pop())  # an unused one before all others
    primitive = document.json["meshes"][0]["primitives"][0]
    primitive["indices"] += 1
    primitive["attributes"] = {name: index + 1 for name, index in primitive["attributes"].items()}
    document.remove_unused()
    cleaned = written(document, tmp_path)
    assert len(cleaned.gltf["accessors"]) == len(box.gltf["accessors"])
    np.testing.assert_array_equal(attribute(cleaned, "POSITION"), attribute(box, "POSITION"))


def test_the_file_that_was_read_does_not_change(box: GlbFile) -> None:
    document = GlbWriter.from_file(box)
    document.json["asset"]["generator"] = "another"
    document.replace_image(0, b"", "image/png")
    assert box.gltf["asset"].get("generator") != "another"
    assert box.image_bytes(0)
