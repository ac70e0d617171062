"""Levels of detail: files that play like the avatar, with fewer faces and smaller textures."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch

from pipeline.avatar.formats.levels_of_detail import FACE_RATIOS, encode_level, encode_levels
from pipeline.avatar.gltf import encode_glb
from pipeline.avatar.gltf_material import pack_roughness
from pipeline.avatar.rig import build_rig
from pipeline.avatar.skinned_avatar import build_skinned_mesh
from pipeline.geometry.creases import find_creases
from pipeline.geometry.mesh import Mesh
from pipeline.geometry.surface import closest_points_on_mesh
from pipeline.geometry.texture_rendering import sample_texture
from pipeline.io.glb import GlbFile
from pipeline.io.glb_writer import GlbWriter
from pipeline.io.image import png_bytes
from pipeline.kernels.raster import rasterize
from tests.avatar.avatar_sample import sample_body, sample_maps, sample_motion
from tests.avatar.formats.column import FRAMES, column_glb, column_mesh
from tests.avatar.test_gltf import Player
from tests.geometry.wedge import one_chart, skinned, wedge
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
    assert halved.shape == (128, 64, 4)
    assert (halved[..., 3] == 77).all()
    assert np.isclose((halved[..., 0] > 100).mean(), 0.25, atol=0.12)  # the layout is a new one
    assert GlbFile(tmp_path / "level.glb").image_pixels(0).shape == (64, 64, 3)  # small ones stay


def test_both_sides_of_a_fold_keep_their_normals(tmp_path: Path) -> None:
    mesh = wedge()
    creases = find_creases(mesh)
    folded = build_skinned_mesh(skinned(mesh).split(creases), creases.split_atlas(one_chart(mesh)))
    one_joint = np.tile(np.eye(4, dtype=np.float32)[:1], (len(folded.uv), 1))
    folded = replace(folded, joint_indices=0 * folded.joint_indices, joint_weights=one_joint)
    data = encode_glb(folded, build_rig(sample_body()), {"capture": sample_motion(FRAMES)}, sample_maps())
    (tmp_path / "full.glb").write_bytes(data)
    (tmp_path / "level.glb").write_bytes(encode_level(GlbFile(tmp_path / "full.glb"), 0.5, 1))
    (level,) = GlbFile(tmp_path / "level.glb").skinned_primitives()
    reduced = Mesh(level.positions, level.faces)
    inner = np.flatnonzero(np.abs(reduced.face_normals()[:, 2]) > 0.9)
    assert len(inner) > 10
    facing = np.sum(reduced.face_normals()[inner, None] * level.normals[level.faces[inner]], axis=2)
    assert (facing > 0.0).all()


def test_a_roughness_map_is_kept_where_it_is_on_the_surface(tmp_path: Path) -> None:
    maps = replace(sample_maps(), roughness_png=png_bytes(pack_roughness(waves()[..., 0])))
    data = encode_glb(column_mesh(), build_rig(sample_body()), {"capture": sample_motion(FRAMES)}, maps)
    (tmp_path / "full.glb").write_bytes(data)
    full, level = GlbFile(tmp_path / "full.glb"), tmp_path / "level.glb"
    level.write_bytes(encode_level(full, 0.25, 1))
    optics = GlbFile(level).gltf["materials"][0]["pbrMetallicRoughness"]
    image = GlbFile(level).gltf["textures"][optics["metallicRoughnessTexture"]["index"]]["source"]
    assert np.percentile(colour_differences(full, GlbFile(level), image), 99) < 8.0
    assert (GlbFile(level).image_pixels(image)[..., [0, 2]] == [255, 0]).all()
    assert optics["roughnessFactor"] == 1.0


def test_the_surface_keeps_its_colours(tmp_path: Path) -> None:
    document = GlbWriter.from_file(column_glb(tmp_path))
    document.replace_image(0, png_bytes(waves()), "image/png")
    (tmp_path / "waves.glb").write_bytes(document.to_bytes())
    full = GlbFile(tmp_path / "waves.glb")
    (tmp_path / "level.glb").write_bytes(encode_level(full, 0.25, 1))
    assert np.percentile(colour_differences(full, GlbFile(tmp_path / "level.glb"), 0), 99) < 8.0


def waves() -> np.ndarray:
    """Smooth colours that wrap around, (256, 256, 3)."""
    v, u = np.meshgrid((np.arange(256) + 0.5) / 256, (np.arange(256) + 0.5) / 256, indexing="ij")
    channels = [np.sin(2.0 * np.pi * (u + 2.0 * v)), np.cos(4.0 * np.pi * u), np.cos(6.0 * np.pi * v)]
    return np.rint(127.5 + 100.0 * np.stack(channels, axis=2)).astype(np.uint8)


def colour_differences(full: GlbFile, level: GlbFile, image: int) -> np.ndarray:
    """What a level shows at the middle of its faces against what the avatar shows at the closest points."""
    reduced, avatar = level.skinned_primitives()[0], full.skinned_primitives()[0]
    thirds = np.full(3, 1.0 / 3.0)
    centres = np.einsum("k,fkc->fc", thirds, reduced.positions[reduced.faces])
    _, face, weights = closest_points_on_mesh(centres, Mesh(avatar.positions, avatar.faces))
    uv = np.einsum("fk,fkc->fc", weights, avatar.uv[avatar.faces[face]])
    shown = _colours(level.image_pixels(image), np.einsum("k,fkc->fc", thirds, reduced.uv[reduced.faces]))
    return np.abs(shown - _colours(full.image_pixels(image), uv))


def test_charts_of_a_level_do_not_overlap(files: list[GlbFile]) -> None:
    level = files[2].skinned_primitives()[0]
    a, b = (level.uv[level.faces[:, k]] - level.uv[level.faces[:, 0]] for k in (1, 2))
    area = 0.5 * np.abs(a[:, 0] * b[:, 1] - a[:, 1] * b[:, 0])
    pixels = torch.from_numpy(level.uv * 1024)
    face_id, _, _ = rasterize(pixels, torch.ones(len(pixels)), torch.from_numpy(level.faces), 1024, 1024)
    assert (face_id >= 0).float().mean().item() == pytest.approx(area.sum(), rel=0.02)


def test_skin_weights_sum_to_one_and_are_those_of_the_avatar(files: list[GlbFile]) -> None:
    full = files[0].skinned_primitives()[0]
    rows = {tuple(row) for row in np.c_[full.positions, full.joints, full.weights].tolist()}
    for file in files[1:]:
        level = file.skinned_primitives()[0]
        np.testing.assert_allclose(level.weights.sum(axis=1, dtype=np.float64), 1.0, atol=1e-6)
        assert {tuple(row) for row in np.c_[level.positions, level.joints, level.weights].tolist()} <= rows


@pytest.mark.parametrize(("level", "limit_m"), [(1, 0.001), (2, 0.002)])
def test_the_posed_surface_stays(files: list[GlbFile], level: int, limit_m: float) -> None:
    for time_s in FRAMES[[3, 9]] / 25.0:
        full, posed = (Player(file.path).posed_vertices(time_s) for file in (files[0], files[level]))
        mesh = Mesh(posed, files[level].skinned_primitives()[0].faces)
        distance_m = closest_points_on_mesh(full, mesh)[0]
        assert np.sqrt((distance_m**2).mean()) < limit_m
        assert distance_m.max() < 10.0 * limit_m


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


def _colours(pixels: np.ndarray, uv: np.ndarray) -> np.ndarray:
    bottom_left = torch.from_numpy((uv * [1.0, -1.0] + [0.0, 1.0]).astype(np.float32))
    return sample_texture(torch.from_numpy(pixels.astype(np.float32)), bottom_left).numpy()


def _clip(file: GlbFile) -> list[np.ndarray]:
    samplers = file.gltf["animations"][0]["samplers"]
    return [file.accessor(sampler[end]) for sampler in samplers for end in ("input", "output")]
