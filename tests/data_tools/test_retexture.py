"""The command retexture on a run with known mesh, motion and texture."""

from io import BytesIO
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from data_tools.retexture import main
from pipeline.core.errors import UserError
from pipeline.core.manifest import digest_files
from pipeline.geometry.atlas import rasterize_texels
from pipeline.io.glb import GlbFile
from pipeline.io.image import read_rgb, write_rgb, write_rgba
from pipeline.texture.files import load_texture
from tests.data_tools.exported_run import write_exported_run
from tests.field.scene import PaintedScene, painted_scene

SIDE_PX = 256


@pytest.fixture(scope="module")
def scene() -> PaintedScene:
    return painted_scene(frames=6, height_px=32)


@pytest.fixture
def run(scene: PaintedScene, tmp_path: Path) -> Path:
    """A run whose export is finished; its texture is white."""
    folder = tmp_path / "run"
    folder.mkdir()
    write_exported_run(folder, scene)
    return folder


def covered(run: Path, side_px: int) -> np.ndarray:
    return rasterize_texels(load_texture(run / "texture").atlas, side_px).coverage_mask()


def test_the_paint_is_the_map_of_glb_and_obj(run: Path, tmp_path: Path) -> None:
    before = {stage: digest_files(run / stage) for stage in ("export", "texture", "mesh")}
    paint = np.random.default_rng(0).integers(0, 256, size=(SIDE_PX, SIDE_PX, 3), dtype=np.uint8)
    write_rgb(tmp_path / "stripes.png", paint)
    main([str(run), "--diffuse", str(tmp_path / "stripes.png")])
    out, on_charts = run / "retexture" / "stripes", covered(run, SIDE_PX)
    glb = GlbFile(out / "avatar.glb")
    embedded = np.asarray(Image.open(BytesIO(glb.image_bytes(0))).convert("RGB"))
    for pixels in (embedded, read_rgb(out / "diffuse.png"), read_rgb(out / "avatar_diffuse.png")):
        np.testing.assert_array_equal(pixels[on_charts], paint[on_charts])
    assert [animation["name"] for animation in glb.gltf["animations"]] == ["capture", "idle"]
    assert glb.gltf["nodes"][1]["name"] == "mixamorig:Hips"
    assert (out / "avatar.mtl").read_text().count("avatar_diffuse.png") >= 1
    assert {stage: digest_files(run / stage) for stage in before} == before


def test_alpha_says_where_the_paint_applies(run: Path, tmp_path: Path) -> None:
    paint = np.zeros((SIDE_PX, SIDE_PX, 4), dtype=np.uint8)
    paint[..., 0] = 200
    paint[: SIDE_PX // 2, :, 3] = 255
    paint[:, : SIDE_PX // 4, 3] = 51
    write_rgba(tmp_path / "half.png", paint)
    main([str(run), "--diffuse", str(tmp_path / "half.png"), "--name", "red"])
    written, on_charts = read_rgb(run / "retexture" / "red" / "diffuse.png"), covered(run, SIDE_PX)
    mixed = 0.8 * np.array([255, 255, 255]) + 0.2 * np.array([200, 0, 0])
    for alpha, colour in ((255, [200, 0, 0]), (0, [255, 255, 255]), (51, mixed)):
        rows = on_charts & (paint[..., 3] == alpha)
        assert rows.any()
        np.testing.assert_allclose(written[rows], np.tile(colour, (rows.sum(), 1)), atol=1)


@pytest.mark.parametrize(
    ("shape", "words"),
    [((300, 256), "256 x 300 px"), ((128, 128), "128 x 128 px")],
)
def test_paint_of_another_layout_is_one_sentence_and_writes_nothing(
    run: Path, tmp_path: Path, shape: tuple[int, int], words: str
) -> None:
    write_rgb(tmp_path / "paint.png", np.zeros((*shape, 3), np.uint8))
    before = sorted(path.name for path in run.rglob("*"))
    with pytest.raises(UserError, match=words):
        main([str(run), "--diffuse", str(tmp_path / "paint.png")])
    assert sorted(path.name for path in run.rglob("*")) == before


def test_missing_or_transparent_paint_is_named(run: Path, tmp_path: Path) -> None:
    write_rgba(tmp_path / "clear.png", np.zeros((SIDE_PX, SIDE_PX, 4), np.uint8))
    for name, words in (("none.png", "does not exist"), ("clear.png", "transparent everywhere")):
        with pytest.raises(UserError, match=words):
            main([str(run), "--diffuse", str(tmp_path / name)])


@pytest.mark.slow
def test_the_other_persons_colours_are_where_the_mask_is_white(run: Path, scene: PaintedScene, tmp_path: Path) -> None:
    other = tmp_path / "other"
    other.mkdir()
    write_exported_run(other, scene)
    write_rgb(other / "texture" / "diffuse.png", np.tile(np.array([200, 10, 20], np.uint8), (16, 16, 1)))
    mask = np.zeros((SIDE_PX, SIDE_PX, 3), np.uint8)
    mask[:100] = 255
    write_rgb(tmp_path / "shirt.png", mask)
    main([str(run), "--from", str(other), "--mask", str(tmp_path / "shirt.png")])
    written, on_charts = read_rgb(run / "retexture" / "shirt" / "diffuse.png"), covered(run, SIDE_PX)
    for colour, rows in (([200, 10, 20], on_charts[:100]), ([255, 255, 255], on_charts[100:])):
        pixels = (written[:100] if colour[0] == 200 else written[100:])[rows]
        np.testing.assert_array_equal(pixels, np.tile(colour, (len(pixels), 1)))
    assert not (other / "retexture").exists()


def test_bad_masks_and_runs_are_named(run: Path, tmp_path: Path) -> None:
    black, paint = tmp_path / "black.png", tmp_path / "paint.png"
    write_rgb(black, np.zeros((SIDE_PX, SIDE_PX, 3), np.uint8))
    write_rgb(paint, np.zeros((SIDE_PX, SIDE_PX, 3), np.uint8))
    for arguments, words in (
        (["--from", str(run), "--mask", str(black)], "black everywhere"),
        (["--from", str(tmp_path)], "has no finished export"),
        (["--diffuse", str(paint), "--mask", str(black)], "--mask is for"),
    ):
        with pytest.raises(UserError, match=words):
            main([str(run), *arguments])
    assert not (run / "retexture").exists()
