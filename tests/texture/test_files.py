"""The artifact of the texture stage: round trip and errors."""

from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest

from pipeline.core.errors import UserError
from pipeline.geometry.atlas import Atlas
from pipeline.io.image import to_float
from pipeline.io.npz import load_npz, save_npz
from pipeline.texture.files import (
    ATLAS,
    COVERAGE,
    DIFFUSE,
    LIGHT,
    NORMAL,
    ROUGHNESS,
    SPECULAR,
    TextureArtifact,
    TextureFormat,
    load_texture,
    map_files,
    save_texture,
)
from pipeline.texture.light import Highlights, VideoLight


@pytest.fixture
def artifact() -> TextureArtifact:
    random = np.random.default_rng(0)
    atlas = Atlas(
        random.uniform(size=(5, 2)).astype(np.float32),
        np.array([[0, 1, 2], [2, 3, 4]], dtype=np.int32),
        np.array([0, 1, 2, 3, 0], dtype=np.int32),
    )
    diffuse, gray = (random.integers(0, 256, shape, dtype=np.uint8) for shape in ((8, 8, 3), (2, 8, 8)))
    return TextureArtifact(
        atlas, to_float(diffuse), to_float(gray[0]), gray[1], VideoLight.uniform(4), Highlights.none()
    )


def test_reading_inverts_writing(artifact: TextureArtifact, tmp_path: Path) -> None:
    save_texture(tmp_path, artifact)
    assert sorted(path.name for path in tmp_path.iterdir()) == sorted(
        [ATLAS, DIFFUSE, SPECULAR, COVERAGE, LIGHT, NORMAL, ROUGHNESS]
    )
    read = load_texture(tmp_path)
    for name in ("uv", "faces_uv", "vertex_of_uv"):
        np.testing.assert_array_equal(getattr(read.atlas, name), getattr(artifact.atlas, name))
    for name in ("diffuse", "specular", "coverage"):
        np.testing.assert_array_equal(getattr(read, name), getattr(artifact, name))


@pytest.mark.parametrize(
    ("texture_format", "names", "tolerance"),
    [
        ("png8", ["diffuse.png"], 0.5 / 255),
        ("png16", ["diffuse.png"], 0.5 / 65535),
        ("exr", ["diffuse.png", "diffuse.exr"], 3e-4),
    ],
)
def test_each_format_keeps_its_precision(
    artifact: TextureArtifact, tmp_path: Path, texture_format: TextureFormat, names: list[str], tolerance: float
) -> None:
    values = np.random.default_rng(0).uniform(size=(8, 8, 3)).astype(np.float32)
    deep = replace(artifact, diffuse=values, specular=np.ascontiguousarray(values[..., 0]))
    save_texture(tmp_path, deep, texture_format)
    assert [path.name for path in map_files(tmp_path, DIFFUSE)] == names
    read = load_texture(tmp_path)
    for name in ("diffuse", "specular"):
        np.testing.assert_allclose(getattr(read, name), getattr(deep, name), atol=1.001 * tolerance)
        assert np.abs(getattr(read, name) - getattr(deep, name)).max() > 0.2 * tolerance
    depth = np.uint16 if texture_format == "png16" else np.uint8
    assert cv2.imread(str(tmp_path / DIFFUSE), cv2.IMREAD_UNCHANGED).dtype == depth


@pytest.mark.parametrize("name", [ATLAS, DIFFUSE, SPECULAR, NORMAL, ROUGHNESS, COVERAGE])
def test_a_missing_file_is_named(name: str, artifact: TextureArtifact, tmp_path: Path) -> None:
    save_texture(tmp_path, artifact)
    (tmp_path / name).unlink()
    with pytest.raises(UserError, match=name):
        load_texture(tmp_path)


@pytest.mark.parametrize(("texture_format", "step"), [("png8", 255), ("png16", 65535), ("exr", 65535)])
def test_a_normal_map_is_read_back_and_none_stays_none(
    artifact: TextureArtifact, tmp_path: Path, texture_format: TextureFormat, step: int
) -> None:
    save_texture(tmp_path, artifact, texture_format)
    assert load_texture(tmp_path).normal is None
    normal = np.random.default_rng(0).uniform(size=(4, 4, 3)).astype(np.float32)
    save_texture(tmp_path, replace(artifact, normal=normal), texture_format)
    read = load_texture(tmp_path).normal
    assert read is not None
    np.testing.assert_allclose(read, normal, atol=0.501 / step)
    assert [path.name for path in map_files(tmp_path, NORMAL)] == [NORMAL]


@pytest.mark.parametrize(("texture_format", "step"), [("png8", 255), ("png16", 65535), ("exr", 65535)])
def test_a_roughness_map_is_read_back_and_one_roughness_is_one_texel(
    artifact: TextureArtifact, tmp_path: Path, texture_format: TextureFormat, step: int
) -> None:
    artifact = replace(artifact, highlights=Highlights(np.array([0.0, 0.0, 1.0], np.float32), 30.0))
    save_texture(tmp_path, artifact, texture_format)
    assert load_texture(tmp_path).roughness is None
    texel = cv2.imread(str(tmp_path / ROUGHNESS), cv2.IMREAD_UNCHANGED)
    np.testing.assert_allclose(texel / (255.0 if step == 255 else 65535.0), [[0.5]], atol=0.501 / step)
    roughness = np.random.default_rng(0).uniform(0.3, 0.7, size=(8, 8)).astype(np.float32)
    save_texture(tmp_path, replace(artifact, roughness=roughness), texture_format)
    read = load_texture(tmp_path).roughness
    assert read is not None
    np.testing.assert_allclose(read, roughness, atol=0.501 / step)


def test_a_missing_array_is_named(artifact: TextureArtifact, tmp_path: Path) -> None:
    save_texture(tmp_path, artifact)
    arrays = load_npz(tmp_path / ATLAS)
    save_npz(tmp_path / ATLAS, {"uv": arrays["uv"]})
    with pytest.raises(UserError, match=r"atlas\.npz lacks the array 'faces_uv'.*stages texture"):
        load_texture(tmp_path)
