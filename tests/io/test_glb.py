"""The .glb reader against trimesh and on damaged files; skinned files are covered by tests/avatar/test_gltf.py."""

import json
import struct
from collections.abc import Callable
from io import BytesIO
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import trimesh
from PIL import Image

from pipeline.core.errors import UserError
from pipeline.io.glb import GlbFile

TEXELS = np.arange(48, dtype=np.uint8).reshape(4, 4, 3)


def textured_box(path: Path, texels: np.ndarray = TEXELS) -> Path:
    """A box with UV and a texture, written by trimesh."""
    box = trimesh.creation.box((0.4, 1.8, 0.3))
    uv = np.random.default_rng(0).uniform(size=(len(box.vertices), 2))
    texture = Image.fromarray(texels)
    box.visual = trimesh.visual.TextureVisuals(
        uv=uv, material=trimesh.visual.material.PBRMaterial(baseColorTexture=texture)
    )
    path.write_bytes(box.export(file_type="glb"))
    return path


@pytest.fixture
def box_path(tmp_path: Path) -> Path:
    return textured_box(tmp_path / "box.glb")


def rewrite_json(path: Path, change: Callable[[dict[str, Any]], object]) -> Path:
    """Change the JSON chunk of a .glb in place."""
    data = path.read_bytes()
    (length,) = struct.unpack_from("<I", data, 12)
    tree = json.loads(data[20 : 20 + length])
    change(tree)
    text = json.dumps(tree).encode()
    text += b" " * (-len(text) % 4)
    header = data[:8] + struct.pack("<II", len(data) - length + len(text), len(text)) + data[16:20]
    path.write_bytes(header + text + data[20 + length :])
    return path


def test_accessors_equal_what_trimesh_reads(box_path: Path) -> None:
    glb = GlbFile(box_path)
    expected = trimesh.load(box_path, force="mesh", process=False)
    primitive = glb.gltf["meshes"][0]["primitives"][0]
    np.testing.assert_array_equal(glb.accessor(primitive["attributes"]["POSITION"]), expected.vertices)
    np.testing.assert_array_equal(glb.accessor(primitive["indices"]).reshape(-1, 3), expected.faces)
    uv = glb.accessor(primitive["attributes"]["TEXCOORD_0"])
    np.testing.assert_allclose(np.c_[uv[:, 0], 1.0 - uv[:, 1]], expected.visual.uv, atol=1e-7)


def test_embedded_image_is_decoded_and_returned_as_stored(box_path: Path) -> None:
    glb = GlbFile(box_path)
    np.testing.assert_array_equal(glb.base_colour(0), TEXELS)
    np.testing.assert_array_equal(np.asarray(Image.open(BytesIO(glb.image_bytes(0))).convert("RGB")), TEXELS)


def test_material_without_texture_has_its_factor_as_colour(box_path: Path) -> None:
    def set_factor(tree: dict[str, Any]) -> None:
        tree["materials"] = [{"pbrMetallicRoughness": {"baseColorFactor": [1.0, 0.5, 0.0, 1.0]}}]

    assert GlbFile(rewrite_json(box_path, set_factor)).base_colour(0)[0, 0].tolist() == [255, 188, 0]
    assert (GlbFile(box_path).base_colour(-1) == 255).all()


def test_factor_of_a_texture_is_one_of_linear_light(tmp_path: Path) -> None:
    """Half of the light of white is level 188, a quarter 137."""

    def set_factor(tree: dict[str, Any]) -> None:
        tree["materials"][0]["pbrMetallicRoughness"]["baseColorFactor"] = [0.5, 0.25, 1.0, 1.0]

    texels = np.full((4, 4, 3), (255, 255, 77), np.uint8)
    texels[0] = (188, 0, 0)
    box = rewrite_json(textured_box(tmp_path / "box.glb", texels), set_factor)
    assert GlbFile(box).base_colour(0)[:2, 0].tolist() == [[137, 0, 0], [188, 137, 77]]


def test_node_to_world_chains_parents(box_path: Path) -> None:
    half_turn_about_y = [0.0, 1.0, 0.0, 0.0]

    def add_nodes(tree: dict[str, Any]) -> None:
        tree["nodes"] = [
            {"translation": [1.0, 2.0, 3.0]},
            {"children": [0], "rotation": half_turn_about_y, "scale": [2.0, 2.0, 2.0]},
            {"matrix": [1, 0, 0, 0, 0, 1, 0, 0, 0, 0, 1, 0, 7, 8, 9, 1]},
        ]

    world = GlbFile(rewrite_json(box_path, add_nodes)).node_to_world()
    np.testing.assert_allclose(world[0, :3, 3], [-2.0, 4.0, -6.0], atol=1e-12)
    np.testing.assert_allclose(world[2, :3, 3], [7.0, 8.0, 9.0])


@pytest.mark.parametrize("content", [b"", b"not a binary glTF file", b"glTF" + struct.pack("<I", 1) + b"\0" * 20])
def test_other_files_are_refused(content: bytes, tmp_path: Path) -> None:
    (tmp_path / "no.glb").write_bytes(content)
    with pytest.raises(UserError, match=r"no\.glb is no binary glTF 2 file"):
        GlbFile(tmp_path / "no.glb")


def test_unreadable_json_is_refused(box_path: Path) -> None:
    data = box_path.read_bytes()
    box_path.write_bytes(data[:40] + b"#" + data[41:])
    with pytest.raises(UserError, match="its JSON cannot be read"):
        GlbFile(box_path)


def test_required_extensions_are_named(box_path: Path) -> None:
    rewrite_json(box_path, lambda tree: tree.update(extensionsRequired=["KHR_draco_mesh_compression"]))
    with pytest.raises(UserError, match="requires the extension KHR_draco_mesh_compression"):
        GlbFile(box_path)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (lambda tree: tree["accessors"][0].update(sparse={"count": 1}), "values of accessor 0 are missing"),
        (lambda tree: tree["accessors"][0].pop("bufferView"), "values of accessor 0 are missing"),
        (lambda tree: tree["accessors"][0].update(count=10**6), "values of accessor 0 are missing"),
        (lambda tree: tree["accessors"][0].update(componentType=1), "values of accessor 0 are missing"),
    ],
)
def test_accessors_that_cannot_be_read_are_named(
    change: Callable[[dict[str, Any]], object], message: str, box_path: Path
) -> None:
    with pytest.raises(UserError, match=rf"box\.glb.*{message}"):
        GlbFile(rewrite_json(box_path, change)).accessor(0)


def test_images_that_cannot_be_read_are_named(box_path: Path) -> None:
    rewrite_json(box_path, lambda tree: tree["images"][0].pop("bufferView"))
    with pytest.raises(UserError, match="image 0 is an external file"):
        GlbFile(box_path).base_colour(0)
    rewrite_json(box_path, lambda tree: tree["textures"][0].pop("source"))
    with pytest.raises(UserError, match="neither PNG nor JPEG"):
        GlbFile(box_path).base_colour(0)


def test_file_without_skin_has_no_skinned_primitives(box_path: Path) -> None:
    with pytest.raises(UserError, match="no skinned triangles"):
        GlbFile(box_path).skinned_primitives()
