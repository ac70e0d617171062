"""The command stylise on a run with known texture."""

from pathlib import Path

import numpy as np
import pytest

from data_tools.stylise import main
from pipeline.core.errors import UserError
from pipeline.core.manifest import digest_files
from pipeline.geometry.atlas import rasterize_texels
from pipeline.io.image import read_rgb, write_rgb
from pipeline.texture.files import load_texture


def test_the_avatar_gets_the_palette_and_the_stages_keep_their_bytes(run: Path, tmp_path: Path) -> None:
    before = {stage: digest_files(run / stage) for stage in ("export", "texture")}
    look = np.zeros((20, 30, 3), np.uint8)
    look[..., 2] = 180
    write_rgb(tmp_path / "night.png", look)
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
