"""A .glb without its normal map equals one that never had it; levels of detail show the same normals."""

from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest
from scipy.spatial import cKDTree

from pipeline.avatar.formats.levels_of_detail import encode_level
from pipeline.avatar.formats.normal_maps import normal_images, remove_normal_maps
from pipeline.avatar.gltf import encode_glb
from pipeline.avatar.gltf_material import MaterialMaps
from pipeline.avatar.rig import build_rig
from pipeline.io.glb import GlbFile
from pipeline.io.glb_writer import GlbWriter
from pipeline.io.image import png_bytes
from tests.avatar.avatar_sample import sample_body, sample_maps, sample_motion
from tests.avatar.formats.column import FRAMES, column_mesh
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


@pytest.mark.parametrize("ratio", [1.0, 0.5])
def test_a_level_of_detail_shows_the_normals_of_the_avatar(ratio: float, tmp_path: Path) -> None:
    """A map that bends the normals of a column by a smooth pattern: directions in space, by an independent decoder."""
    v, u = np.meshgrid((np.arange(256) + 0.5) / 256, (np.arange(256) + 0.5) / 256, indexing="ij")
    bent = np.stack([0.4 * np.sin(4 * np.pi * u), 0.4 * np.cos(6 * np.pi * v), np.ones_like(u)], axis=2)
    bent /= np.linalg.norm(bent, axis=2, keepdims=True)
    maps = replace(sample_maps(), normal_png=png_bytes(np.rint(127.5 + 127.5 * bent).astype(np.uint8)))
    data = encode_glb(column_mesh(), build_rig(sample_body()), {"capture": sample_motion(FRAMES)}, maps)
    full = file_of(data, tmp_path / "full.glb")
    level = file_of(encode_level(full, ratio, 0), tmp_path / "level.glb")
    (at_m, shown), (own_m, own) = shown_normals(level), shown_normals(full)
    _, nearest = cKDTree(own_m).query(at_m)
    error_deg = np.rad2deg(np.arccos(np.sum(shown * own[nearest], axis=1).clip(-1.0, 1.0)))
    smooth = full.skinned_primitives()[0].normals  # what would be shown without a map
    without_deg = np.rad2deg(np.arccos(np.sum(own * smooth, axis=1).clip(-1.0, 1.0)))
    assert np.median(without_deg) > 15.0
    assert np.median(error_deg) < 1.5
    assert np.quantile(error_deg, 0.95) < 6.0
    assert validator_issues(level.path) == []


def shown_normals(file: GlbFile) -> tuple[np.ndarray, np.ndarray]:
    """Positions and shaded normals of the vertices that lie within a chart: glTF 2.0, 3.9.3."""
    names = file.gltf["meshes"][0]["primitives"][0]["attributes"]
    arrays = (file.accessor(names[name]).astype(np.float64) for name in ("POSITION", "NORMAL", "TANGENT", "TEXCOORD_0"))
    positions, normals, tangents, uv = arrays
    texture = file.gltf["textures"][file.gltf["materials"][0]["normalTexture"]["index"]]
    pixels = file.image_pixels(texture["source"]).astype(np.float32)
    rows, columns = (uv[:, [1, 0]] * pixels.shape[:2] - 0.5).T.astype(np.float32)
    texel = cv2.remap(pixels, columns[None], rows[None], cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)[0]
    x, y, z = (texel / 127.5 - 1.0).T[..., None]
    shown = x * tangents[:, :3] + y * tangents[:, 3:] * np.cross(normals, tangents[:, :3]) + z * normals
    return positions, shown / np.linalg.norm(shown, axis=1, keepdims=True)


@pytest.mark.parametrize("unlit", [False, True])
def test_an_unlit_surface_has_no_normal_map(unlit: bool, maps: MaterialMaps, tmp_path: Path) -> None:
    tree = file_of(encoded(maps=replace(maps, unlit=unlit)), tmp_path / "avatar.glb").gltf
    assert ("normalTexture" in tree["materials"][0]) is not unlit
    assert ("TANGENT" in tree["meshes"][0]["primitives"][0]["attributes"]) is not unlit
    assert validator_issues(tmp_path / "avatar.glb") == []
