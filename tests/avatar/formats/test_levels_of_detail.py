"""Levels of detail: files that play like the avatar, with fewer faces and smaller textures."""

from pathlib import Path

import numpy as np
import pytest

from pipeline.avatar.formats.levels_of_detail import FACE_RATIOS, encode_level, encode_levels
from pipeline.geometry.mesh import Mesh
from pipeline.geometry.surface import closest_points_on_mesh
from pipeline.io.glb import GlbFile
from pipeline.io.glb_writer import GlbWriter
from pipeline.io.image import png_bytes
from tests.avatar.formats.column import FRAMES, column_glb
from tests.avatar.test_gltf import Player
from tests.tools.khronos import validator_issues


@pytest.fixture(scope="module")
def files(tmp_path_factory: pytest.TempPathFactory) -> list[GlbFile]:
    """The avatar and its coarser levels."""
    folder = tmp_path_factory.mktemp("levels")
    full = column_glb(folder)
    paths = [folder / f"level{number}.glb" for number in range(1, 1 + len(FACE_RATIOS))]
    for path, data in zip(paths, encode_levels(full), strict=True):
        path.write_bytes(data)
    return [full, *(GlbFile(path) for path in paths)]


def test_faces_textures_and_bytes_become_fewer(files: list[GlbFile]) -> None:
    faces = [len(file.skinned_primitives()[0].faces) for file in files]
    assert faces[1:] == [pytest.approx(ratio * faces[0], abs=2) for ratio in FACE_RATIOS]
    assert [len(file.binary) for file in files] == sorted((len(file.binary) for file in files), reverse=True)


def test_textures_are_halved_with_all_channels(tmp_path: Path) -> None:
    full = column_glb(tmp_path)
    document = GlbWriter.from_file(full)
    pixels = np.zeros((256, 128, 4), dtype=np.uint8)
    pixels[:128, :64], pixels[..., 3] = (200, 100, 50, 0), 77
    document.replace_image(1, png_bytes(pixels), "image/png")
    (tmp_path / "two.glb").write_bytes(document.to_bytes())
    (tmp_path / "level.glb").write_bytes(encode_level(GlbFile(tmp_path / "two.glb"), 0.5, 1))
    halved = GlbFile(tmp_path / "level.glb").image_pixels(1)
    np.testing.assert_array_equal(halved, pixels[::2, ::2])
    assert GlbFile(tmp_path / "level.glb").image_pixels(0).shape == (64, 64, 3)  # small ones stay


def test_skin_weights_sum_to_one_and_are_those_of_the_avatar(files: list[GlbFile]) -> None:
    full = files[0].skinned_primitives()[0]
    rows = {tuple(row) for row in np.c_[full.positions, full.joints, full.weights].tolist()}
    for file in files[1:]:
        level = file.skinned_primitives()[0]
        np.testing.assert_allclose(level.weights.sum(axis=1, dtype=np.float64), 1.0, atol=1e-6)
        assert {tuple(row) for row in np.c_[level.positions, level.joints, level.weights].tolist()} <= rows


@pytest.mark.parametrize(("level", "limit_m"), [(1, 0.006), (2, 0.008)])
def test_the_posed_surface_stays(files: list[GlbFile], level: int, limit_m: float) -> None:
    for time_s in FRAMES[[3, 9]] / 25.0:
        full, posed = (Player(file.path).posed_vertices(time_s) for file in (files[0], files[level]))
        mesh = Mesh(posed, files[level].skinned_primitives()[0].faces)
        assert closest_points_on_mesh(full, mesh)[0].max() < limit_m


def test_skeleton_clip_and_camera_are_the_same(files: list[GlbFile]) -> None:
    for file in files[1:]:
        assert file.gltf["nodes"] == files[0].gltf["nodes"]
        for mine, its in zip(_clip(file), _clip(files[0]), strict=True):
            np.testing.assert_array_equal(mine, its)


@pytest.mark.parametrize("sparse", [False, True])
def test_morphs_move_the_same_vertices(tmp_path: Path, sparse: bool) -> None:
    full = column_glb(tmp_path)
    document = GlbWriter.from_file(full)
    primitive = document.json["meshes"][0]["primitives"][0]
    positions = full.accessor(primitive["attributes"]["POSITION"])
    add = document.add_sparse_array if sparse else document.add_array
    primitive["targets"] = [{"POSITION": add(0.1 * positions[:, ::-1], bounds=True)}]
    (tmp_path / "morph.glb").write_bytes(document.to_bytes())
    (tmp_path / "level.glb").write_bytes(encode_level(GlbFile(tmp_path / "morph.glb"), 0.5, 1))
    level = GlbFile(tmp_path / "level.glb")
    (reduced,) = level.gltf["meshes"][0]["primitives"]
    expected = 0.1 * level.accessor(reduced["attributes"]["POSITION"])[:, ::-1]
    np.testing.assert_array_equal(level.accessor(reduced["targets"][0]["POSITION"]), expected)
    assert ("sparse" in level.gltf["accessors"][reduced["targets"][0]["POSITION"]]) == sparse
    assert validator_issues(level.path) == []


def test_the_khronos_validator_finds_no_issue(files: list[GlbFile]) -> None:
    assert [validator_issues(file.path) for file in files] == [[], [], []]


def _clip(file: GlbFile) -> list[np.ndarray]:
    samplers = file.gltf["animations"][0]["samplers"]
    return [file.accessor(sampler[end]) for sampler in samplers for end in ("input", "output")]
