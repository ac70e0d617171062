"""Changing a .glb: what is kept is equal, what nothing refers to is gone, and indices follow."""

from pathlib import Path

import numpy as np
import pytest

from pipeline.io.glb import GlbFile
from pipeline.io.glb_writer import GlbWriter
from tests.io.test_glb import textured_box
from tests.tools.khronos import validator_issues


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


@pytest.mark.parametrize("moved", [[], [2, 5, 6]])
def test_sparse_arrays_are_read_back_and_valid(box: GlbFile, tmp_path: Path, moved: list[int]) -> None:
    document, count = GlbWriter.from_file(box), len(attribute(box, "POSITION"))
    values = np.zeros((count, 3), dtype=np.float32)
    values[moved] = np.arange(3 * len(moved), dtype=np.float32).reshape(-1, 3) + 1.0
    primitive = document.json["meshes"][0]["primitives"][0]
    primitive["targets"] = [{"POSITION": document.add_sparse_array(values, bounds=True)}]
    read = written(document, tmp_path)
    target = read.gltf["meshes"][0]["primitives"][0]["targets"][0]["POSITION"]
    np.testing.assert_array_equal(read.accessor(target), values)
    assert validator_issues(read.path) == []
    again = GlbWriter.from_file(read)
    again.replace_array(target, 2.0 * values)
    again.remove_unused()
    (changed,) = written(again, tmp_path).gltf["meshes"][0]["primitives"][0]["targets"]
    twice = GlbFile(tmp_path / "written.glb")
    assert "sparse" in twice.gltf["accessors"][changed["POSITION"]]
    np.testing.assert_array_equal(twice.accessor(changed["POSITION"]), 2.0 * values)


def test_a_sparse_array_overrides_rows_of_a_dense_one(box: GlbFile, tmp_path: Path) -> None:
    document = GlbWriter.from_file(box)
    index = box.gltf["meshes"][0]["primitives"][0]["attributes"]["POSITION"]
    positions = box.accessor(index)
    rows, values = np.array([3, 4], dtype=np.uint16), np.float32([[7, 8, 9], [1, 2, 3]])
    indices = {"bufferView": document.add_bytes(rows.tobytes()), "componentType": 5123}
    stored = {"bufferView": document.add_bytes(values.tobytes())}
    document.json["accessors"][index]["sparse"] = {"count": 2, "indices": indices, "values": stored}
    expected = positions.copy()
    expected[rows] = values
    np.testing.assert_array_equal(written(document, tmp_path).accessor(index), expected)


def test_the_file_that_was_read_does_not_change(box: GlbFile) -> None:
    document = GlbWriter.from_file(box)
    document.json["asset"]["generator"] = "another"
    document.replace_image(0, b"", "image/png")
    assert box.gltf["asset"].get("generator") != "another"
    assert box.image_bytes(0)
