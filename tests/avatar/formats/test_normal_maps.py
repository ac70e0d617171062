"""A .glb without its normal map equals one that never had it; a level of detail has none."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from pipeline.avatar.formats.levels_of_detail import encode_level
from pipeline.avatar.formats.normal_maps import normal_images, remove_normal_maps
from pipeline.avatar.gltf import MaterialMaps
from pipeline.io.glb import GlbFile
from pipeline.io.glb_writer import GlbWriter
from pipeline.io.image import png_bytes
from tests.avatar.avatar_sample import sample_maps
from tests.avatar.test_gltf import encoded
from tests.tools.khronos import validator_issues


@pytest.fixture(scope="module")
def maps() -> MaterialMaps:
    return replace(sample_maps(), normal_png=png_bytes(np.full((64, 64, 3), (150, 120, 250), np.uint8)))


def file_of(data: bytes, path: Path) -> GlbFile:
    path.write_bytes(data)
    return GlbFile(path)


def test_removal_leaves_the_file_that_has_no_normal_map(maps: MaterialMaps, tmp_path: Path) -> None:
    file = file_of(encoded(maps=maps), tmp_path / "with.glb")
    plain = encoded(maps=replace(maps, normal_png=None))
    document = GlbWriter.from_file(file)
    images = len(file.gltf["images"])
    assert normal_images(file.gltf) == {images - 1}
    assert remove_normal_maps(document.json) == list(range(images - 1))
    document.remove_unused()
    left, expected = file_of(document.to_bytes(), tmp_path / "left.glb"), file_of(plain, tmp_path / "plain.glb")
    for kind in ("materials", "textures", "meshes"):
        assert left.gltf[kind] == expected.gltf[kind]
    assert len(left.binary) == len(expected.binary)


def test_other_textures_are_renumbered() -> None:
    specular = {"KHR_materials_specular": {"specularTexture": {"index": 2}}}
    tree = {
        "materials": [
            {"pbrMetallicRoughness": {"baseColorTexture": {"index": 1}}, "normalTexture": {"index": 0}}
            | {"extensions": specular}
        ],
        "textures": [{"source": 1}, {"source": 2}, {"source": 0}],
        "images": [{"name": name} for name in ("specular", "normal", "diffuse")],
        "meshes": [{"primitives": [{"attributes": {"POSITION": 0, "TANGENT": 1}}]}],
    }
    assert remove_normal_maps(tree) == [0, 2]
    assert [image["name"] for image in tree["images"]] == ["specular", "diffuse"]
    assert tree["textures"] == [{"source": 1}, {"source": 0}]
    material = tree["materials"][0]
    assert material["pbrMetallicRoughness"]["baseColorTexture"]["index"] == 0
    assert material["extensions"]["KHR_materials_specular"]["specularTexture"]["index"] == 1
    assert tree["meshes"][0]["primitives"][0]["attributes"] == {"POSITION": 0}


def test_a_level_of_detail_has_no_normal_map(maps: MaterialMaps, tmp_path: Path) -> None:
    file = file_of(encoded(maps=maps), tmp_path / "with.glb")
    level = file_of(encode_level(file, 0.5, 1), tmp_path / "level.glb").gltf
    assert "normalTexture" not in level["materials"][0]
    assert "TANGENT" not in level["meshes"][0]["primitives"][0]["attributes"]
    assert len(level["images"]) == len(file.gltf["images"]) - 1


@pytest.mark.parametrize("unlit", [False, True])
def test_an_unlit_surface_has_no_normal_map(unlit: bool, maps: MaterialMaps, tmp_path: Path) -> None:
    tree = file_of(encoded(maps=replace(maps, unlit=unlit)), tmp_path / "avatar.glb").gltf
    assert ("normalTexture" in tree["materials"][0]) is not unlit
    assert ("TANGENT" in tree["meshes"][0]["primitives"][0]["attributes"]) is not unlit
    assert validator_issues(tmp_path / "avatar.glb") == []
