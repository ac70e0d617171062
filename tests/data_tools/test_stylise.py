"""The command stylise on a run with known texture."""

from pathlib import Path

import numpy as np
import pytest

from data_tools.stylise import main, read_look
from pipeline.core.errors import UserError
from pipeline.core.manifest import digest_files
from pipeline.geometry.atlas import rasterize_texels
from pipeline.io.image import read_rgb, write_rgba
from pipeline.texture.files import load_texture


def test_transparent_pixels_are_no_colours(tmp_path: Path) -> None:
    logo = np.zeros((20, 30, 4), np.uint8)
    logo[:4, :5] = [200, 100, 50, 255]
    write_rgba(tmp_path / "logo.png", logo)
    np.testing.assert_allclose(
        255.0 * read_look(tmp_path / "logo.png"), np.tile([200.0, 100, 50], (1, 20, 1)), atol=1e-4
    )
    logo[..., 3] = 127
    write_rgba(tmp_path / "clear.png", logo)
    with pytest.raises(UserError, match="transparent everywhere; choose a picture"):
        read_look(tmp_path / "clear.png")


def test_the_avatar_gets_the_palette_and_the_stages_keep_their_bytes(run: Path, tmp_path: Path) -> None:
    before = {stage: digest_files(run / stage) for stage in ("export", "texture")}
    look = np.zeros((20, 30, 4), np.uint8)
    look[..., 0] = 200  # where it is transparent
    look[:, :9] = [0, 0, 180, 255]
    write_rgba(tmp_path / "night.png", look)
    with pytest.raises(UserError, match="does not exist"):
        main([str(run), "--look", str(tmp_path / "none.png")])
    assert not (run / "stylise").exists()
    main([str(run), "--look", str(tmp_path / "night.png")])
    texture = load_texture(run / "texture")
    on_charts = rasterize_texels(texture.atlas, len(texture.diffuse)).coverage_mask()
    red, _, blue = read_rgb(run / "stylise" / "night" / "diffuse.png")[on_charts].astype(int).T
    assert np.median(blue - red) > 50
    assert (run / "stylise" / "night" / "avatar.glb").is_file()
    assert {stage: digest_files(run / stage) for stage in before} == before
