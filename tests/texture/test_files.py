"""The artifact of the texture stage: round trip and errors."""

from pathlib import Path

import numpy as np
import pytest

from pipeline.core.errors import UserError
from pipeline.geometry.atlas import Atlas
from pipeline.io.npz import load_npz, save_npz
from pipeline.texture.files import ATLAS, COVERAGE, DIFFUSE, SPECULAR, TextureArtifact, load_texture, save_texture


@pytest.fixture
def artifact() -> TextureArtifact:
    random = np.random.default_rng(0)
    atlas = Atlas(
        random.uniform(size=(5, 2)).astype(np.float32),
        np.array([[0, 1, 2], [2, 3, 4]], dtype=np.int32),
        np.array([0, 1, 2, 3, 0], dtype=np.int32),
    )
    diffuse, gray = (random.integers(0, 256, shape, dtype=np.uint8) for shape in ((8, 8, 3), (2, 8, 8)))
    return TextureArtifact(atlas, diffuse, gray[0], gray[1])


def test_reading_inverts_writing(artifact: TextureArtifact, tmp_path: Path) -> None:
    save_texture(tmp_path, artifact)
    assert sorted(path.name for path in tmp_path.iterdir()) == sorted([ATLAS, DIFFUSE, SPECULAR, COVERAGE])
    read = load_texture(tmp_path)
    for name in ("uv", "faces_uv", "vertex_of_uv"):
        np.testing.assert_array_equal(getattr(read.atlas, name), getattr(artifact.atlas, name))
    for name in ("diffuse", "specular", "coverage"):
        np.testing.assert_array_equal(getattr(read, name), getattr(artifact, name))


@pytest.mark.parametrize("name", [ATLAS, DIFFUSE, SPECULAR, COVERAGE])
def test_a_missing_file_is_named(name: str, artifact: TextureArtifact, tmp_path: Path) -> None:
    save_texture(tmp_path, artifact)
    (tmp_path / name).unlink()
    with pytest.raises(UserError, match=name):
        load_texture(tmp_path)


def test_a_missing_array_is_named(artifact: TextureArtifact, tmp_path: Path) -> None:
    save_texture(tmp_path, artifact)
    arrays = load_npz(tmp_path / ATLAS)
    save_npz(tmp_path / ATLAS, {"uv": arrays["uv"]})
    with pytest.raises(UserError, match=r"atlas\.npz lacks the array 'faces_uv'.*stages\.texture"):
        load_texture(tmp_path)
