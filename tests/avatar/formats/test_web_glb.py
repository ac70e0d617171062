"""The compressed .glb, decoded by Draco and OpenCV, against the file that it was made of."""

import json
import re
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
from scipy.spatial import cKDTree

from pipeline.avatar.formats.web_glb import (
    MIN_COLOUR_PSNR_DB,
    MIN_SPECULAR_PSNR_DB,
    POSITION_BITS,
    UV_BITS,
    encode_web_glb,
    encode_webp,
    quantise_weights,
)
from pipeline.avatar.gltf_material import MaterialMaps, pack_roughness
from pipeline.core.errors import UserError
from pipeline.io.glb import GlbFile
from pipeline.io.glb_writer import GlbWriter
from pipeline.io.image import png_bytes
from tests.avatar.formats.anny_avatar import anny_glb
from tests.tools.khronos import validator_issues

DracoPy = pytest.importorskip("DracoPy", reason="DracoPy is not installed: make venv EXTRA=web")


class WebGlb(GlbFile):
    """The general reader refuses the file because of its extensions; this one takes it apart for the tests."""

    def __init__(self, path: Path, uncompressed: Path) -> None:
        super().__init__(uncompressed)
        data = path.read_bytes()
        length = int.from_bytes(data[12:16], "little")
        self.gltf, self.binary = json.loads(data[20 : 20 + length]), data[28 + length :]

    def decoded(self) -> tuple[Any, dict[str, np.ndarray]]:
        """Draco's mesh, and its attributes by glTF's names."""
        compression = self.gltf["meshes"][0]["primitives"][0]["extensions"]["KHR_draco_mesh_compression"]
        view = self.gltf["bufferViews"][compression["bufferView"]]
        mesh = DracoPy.decode(self.binary[view["byteOffset"] : view["byteOffset"] + view["byteLength"]])
        by_identifier = {attribute["unique_id"]: attribute["data"] for attribute in mesh.attributes}
        return mesh, {name: by_identifier[number] for name, number in compression["attributes"].items()}


def smooth_image(channels: int, side_px: int = 256) -> np.ndarray:
    random = np.random.default_rng(2).uniform(90, 160, (16, 16, channels)).astype(np.float32)
    large = cv2.resize(random, (side_px, side_px), interpolation=cv2.INTER_CUBIC)
    return np.clip(large, 0, 255).astype(np.uint8)


def specular_image() -> np.ndarray:
    """White with a noisy alpha channel, of which the lowest qualities are not accurate enough."""
    pixels = np.full((256, 256, 4), 255, dtype=np.uint8)
    pixels[..., 3] = np.clip(np.random.default_rng(3).normal(90, 40, (256, 256)), 0, 255)
    return pixels


@pytest.fixture(scope="module")
def files(tmp_path_factory: pytest.TempPathFactory) -> tuple[GlbFile, WebGlb]:
    folder = tmp_path_factory.mktemp("web")
    roughness_png = png_bytes(pack_roughness(smooth_image(3)[..., 0]))
    maps = MaterialMaps(png_bytes(smooth_image(3)), png_bytes(specular_image()), roughness_png=roughness_png)
    full = anny_glb(folder, maps)
    (folder / "web.glb").write_bytes(encode_web_glb(full))
    return full, WebGlb(folder / "web.glb", full.path)


def test_positions_and_texture_coordinates_are_within_the_quantisation(files: tuple[GlbFile, WebGlb]) -> None:
    full, web = files[0].skinned_primitives()[0], files[1].decoded()[1]
    step_m = np.ptp(full.positions, axis=0).max() / 2**POSITION_BITS
    assert step_m < 0.2e-3
    distance_m, source = cKDTree(full.positions).query(web["POSITION"])
    assert distance_m.max() <= 0.5 * step_m * np.sqrt(3) * 1.01
    step = np.ptp(full.uv, axis=0).max() / 2**UV_BITS
    assert np.abs(web["TEXCOORD_0"] - full.uv[source]).max(axis=1).max() <= 0.51 * step
    angle = np.degrees(np.arccos(np.clip(np.sum(web["NORMAL"] * full.normals[source], axis=1), -1, 1)))
    assert angle.max() < 1.0


def test_the_skin_is_the_same_to_16_bits(files: tuple[GlbFile, WebGlb]) -> None:
    full, web = files[0].skinned_primitives()[0], files[1].decoded()[1]
    _, source = cKDTree(full.positions).query(web["POSITION"])
    np.testing.assert_array_equal(web["JOINTS_0"], full.joints[source])
    assert set(web["WEIGHTS_0"].sum(axis=1)) == {65535}
    np.testing.assert_allclose(web["WEIGHTS_0"] / 65535, full.weights[source], atol=4 / 65535)


def test_the_faces_are_the_same_triangles(files: tuple[GlbFile, WebGlb]) -> None:
    full, (mesh, web) = files[0].skinned_primitives()[0], files[1].decoded()
    _, source = cKDTree(full.positions).query(web["POSITION"])

    def normal(faces: np.ndarray) -> set[tuple[int, ...]]:
        start = faces.argmin(axis=1)
        return {tuple(np.roll(face, -shift)) for face, shift in zip(faces, start, strict=True)}

    assert normal(source[mesh.faces]) == normal(full.faces)


def test_accessors_describe_what_the_decoder_returns(files: tuple[GlbFile, WebGlb]) -> None:
    web = files[1]
    (mesh, attributes), primitive = web.decoded(), web.gltf["meshes"][0]["primitives"][0]
    assert web.gltf["accessors"][primitive["indices"]]["count"] == mesh.faces.size
    assert {web.gltf["accessors"][index]["count"] for index in primitive["attributes"].values()} == {len(mesh.points)}
    position = web.gltf["accessors"][primitive["attributes"]["POSITION"]]
    np.testing.assert_allclose(position["max"], attributes["POSITION"].max(axis=0), atol=1e-6)


def test_rotations_are_within_their_quantisation(files: tuple[GlbFile, WebGlb]) -> None:
    full, web = files
    for mine, its in zip(web.gltf["animations"][0]["samplers"], full.gltf["animations"][0]["samplers"], strict=True):
        np.testing.assert_allclose(web.accessor(mine["output"]), full.accessor(its["output"]), atol=0.6 / 32767)


def test_morphs_still_belong_to_their_vertices(files: tuple[GlbFile, WebGlb], tmp_path: Path) -> None:
    document = GlbWriter.from_file(files[0])
    primitive = document.json["meshes"][0]["primitives"][0]
    positions = files[0].skinned_primitives()[0].positions
    primitive["targets"] = [{"POSITION": document.add_sparse_array(0.1 * positions, bounds=True)}]
    primitive["targets"][0]["NORMAL"] = document.add_sparse_array(0.1 * positions)
    (tmp_path / "morph.glb").write_bytes(document.to_bytes())
    (tmp_path / "web.glb").write_bytes(encode_web_glb(GlbFile(tmp_path / "morph.glb")))
    web = WebGlb(tmp_path / "web.glb", files[0].path)
    (target,) = web.gltf["meshes"][0]["primitives"][0]["targets"]
    assert set(target) == {"POSITION"}
    offsets = web.accessor(target["POSITION"])
    np.testing.assert_allclose(offsets, 0.1 * web.decoded()[1]["POSITION"], atol=2e-5)
    assert validator_issues(tmp_path / "web.glb") == []


def test_it_is_much_smaller_and_valid(files: tuple[GlbFile, WebGlb], tmp_path: Path) -> None:
    full, web = files
    data = encode_web_glb(full)
    (tmp_path / "web.glb").write_bytes(data)
    assert len(data) < 0.5 * full.path.stat().st_size
    assert validator_issues(tmp_path / "web.glb") == []
    required = ["KHR_draco_mesh_compression", "EXT_texture_webp"]
    assert web.gltf["extensionsRequired"] == required
    assert set(required) < set(web.gltf["extensionsUsed"])
    with pytest.raises(UserError, match=re.escape("requires the extension EXT_texture_webp, KHR_draco")):
        GlbFile(tmp_path / "web.glb")


@pytest.mark.parametrize(
    ("pixels", "channels", "least_db"),
    [
        (smooth_image(3), slice(0, 3), MIN_COLOUR_PSNR_DB),
        (specular_image(), slice(3, 4), MIN_SPECULAR_PSNR_DB),
        (np.random.default_rng(0).integers(0, 256, (64, 64, 3), dtype=np.uint8), slice(0, 3), np.inf),
    ],
    ids=["colours", "specular", "noise is lossless"],
)
def test_textures_are_as_accurate_as_promised(pixels: np.ndarray, channels: slice, least_db: float) -> None:
    data = encode_webp(pixels)
    decoded = cv2.imdecode(np.frombuffer(data, np.uint8), cv2.IMREAD_UNCHANGED)
    decoded = cv2.cvtColor(decoded, cv2.COLOR_BGR2RGB if pixels.shape[2] == 3 else cv2.COLOR_BGRA2RGBA)
    error = np.mean((decoded[..., channels].astype(float) - pixels[..., channels]) ** 2)
    assert error <= 255**2 * 10 ** (-least_db / 10)
    assert (error == 0.0) == (least_db == np.inf)


def test_the_roughness_map_is_exact(files: tuple[GlbFile, WebGlb]) -> None:
    full, web = files
    texture = web.gltf["materials"][0]["pbrMetallicRoughness"]["metallicRoughnessTexture"]["index"]
    index = web.gltf["textures"][texture]["extensions"]["EXT_texture_webp"]["source"]
    decoded = cv2.imdecode(np.frombuffer(web.image_bytes(index), np.uint8), cv2.IMREAD_COLOR)
    np.testing.assert_array_equal(decoded[..., 1], smooth_image(3)[..., 0])
    np.testing.assert_array_equal(decoded[..., ::-1], full.image_pixels(index))


def test_weights_sum_to_65535_also_after_rounding() -> None:
    weights = np.random.default_rng(0).dirichlet([0.3] * 4, 500).astype(np.float32)
    quantised = quantise_weights(weights)
    assert set(quantised.sum(axis=1, dtype=np.int64)) == {65535}
    np.testing.assert_allclose(quantised / 65535, weights, atol=4 / 65535)
