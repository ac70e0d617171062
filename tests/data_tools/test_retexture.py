"""The command retexture on a run with known mesh, motion and texture."""

import shutil
from dataclasses import replace
from io import BytesIO
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from data_tools.retexture import fit_painting, main, run_of_map, same_places
from pipeline.core.errors import UserError
from pipeline.core.manifest import Manifest, digest_files, write_manifest
from pipeline.geometry.atlas import rasterize_texels
from pipeline.io.glb import GlbFile
from pipeline.io.image import read_gray, read_rgb, read_rgb_float, to_uint16, write_gray, write_rgb, write_rgba
from pipeline.mesh.files import load_mesh
from pipeline.template.layout import load_layout
from pipeline.template.template_atlas import build_template_atlas
from pipeline.texture.files import load_texture, save_texture
from pipeline.texture.light import Highlights
from pipeline.texture.painting import Painting, read_mask
from tests.data_tools.exported_run import write_exported_run
from tests.field.scene import PaintedScene
from tests.stages.painted_run import known_registration

SIDE_PX = 256


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


def test_paint_keeps_highlights_and_their_roughness(run: Path, tmp_path: Path) -> None:
    """The map of the painted avatar has the size of the paint: here twice that of the texture."""
    texture = load_texture(run / "texture")
    half = len(texture.diffuse) // 2
    strength, roughness = np.full((2, 2 * half, 2 * half), 0.02, np.float32)
    roughness[:half], roughness[half:] = 0.4, 0.6
    lobe = Highlights(np.array([0.0, 0.0, 1.0], np.float32), 30.0)
    save_texture(run / "texture", replace(texture, specular=strength, highlights=lobe, roughness=roughness))
    write_rgb(tmp_path / "plain.png", np.full((SIDE_PX, SIDE_PX, 3), 90, np.uint8))
    main([str(run), "--diffuse", str(tmp_path / "plain.png")])
    out, expected = run / "retexture" / "plain", np.repeat([102, 153], SIDE_PX // 2)[:, None]
    glb = GlbFile(out / "avatar.glb")
    optics = glb.gltf["materials"][0]["pbrMetallicRoughness"]
    embedded = glb.image_pixels(glb.gltf["textures"][optics["metallicRoughnessTexture"]["index"]]["source"])[..., 1]
    rows = np.abs(np.arange(SIDE_PX) - SIDE_PX // 2) > SIDE_PX // 16
    for pixels in (embedded, read_gray(out / "roughness.png"), read_gray(out / "avatar_roughness.png")):
        assert (pixels[:, :SIDE_PX] == expected)[rows].all()


def test_the_map_of_an_edited_avatar_is_edited_further_with_its_highlights(run: Path) -> None:
    """The clothes of the other person are matt; the painting lies where an artist saves it."""
    texture = load_texture(run / "texture")
    side_px = len(texture.diffuse)
    lobe = Highlights(np.array([0.0, 0.0, 1.0], np.float32), 30.0)
    shiny = np.full((side_px, side_px), 0.1, np.float32)
    save_texture(run / "texture", replace(texture, specular=shiny, highlights=lobe, roughness=4.0 * shiny))
    worn, matt = run / "retexture" / "other", np.zeros((SIDE_PX, SIDE_PX), np.uint8)
    worn.mkdir(parents=True)
    write_gray(worn / "specular.png", matt)
    write_gray(worn / "roughness.png", matt + 204)
    write_rgb(worn / "logo.png", np.full((SIDE_PX, SIDE_PX, 3), 90, np.uint8))
    main([str(run), "--diffuse", str(worn / "logo.png")])
    assert not read_gray(run / "retexture" / "logo" / "specular.png").any()
    assert (read_gray(run / "retexture" / "logo" / "roughness.png") == 204).all()
    shutil.copy(worn / "logo.png", run / "plain.png")
    main([str(run), "--diffuse", str(run / "plain.png")])
    assert read_gray(run / "retexture" / "plain" / "specular.png").min() == 26


def test_a_map_edited_in_place_is_not_replaced(run: Path, tmp_path: Path) -> None:
    paint = np.full((SIDE_PX, SIDE_PX, 3), 90, np.uint8)
    write_rgb(tmp_path / "diffuse.png", paint)
    main([str(run), "--diffuse", str(tmp_path / "diffuse.png")])
    edited = run / "retexture" / "diffuse" / "diffuse.png"
    write_rgb(edited, paint + 1)
    with pytest.raises(UserError, match="diffuse.png was edited and would be replaced: .* --name"):
        main([str(run), "--diffuse", str(edited)])
    assert (read_rgb(edited) == 91).all()
    main([str(run), "--diffuse", str(edited), "--name", "second"])
    assert (run / "retexture" / "second" / "avatar.glb").is_file()


def test_the_result_has_the_whole_name_of_the_other_run(run: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    names = []
    monkeypatch.setattr("data_tools.retexture.load_editable_avatar", lambda _: None)
    monkeypatch.setattr("data_tools.retexture.registered_surface", lambda *_: None)
    monkeypatch.setattr("data_tools.retexture.wear_texture_of", lambda *_: None)
    monkeypatch.setattr("data_tools.retexture.write_edited_avatar", lambda *arguments: names.append(arguments[2].name))
    for name in ("anna.1", "anna.2"):
        main([str(run), "--from", str(run.parent / name)])
    assert names == ["anna.1", "anna.2"]


@pytest.mark.parametrize("texture_format", ["png16", "exr"])
def test_edited_maps_have_the_format_of_the_texture(run: Path, tmp_path: Path, texture_format: str) -> None:
    """A ramp of 16 bits in dark tones comes back with its steps, in the folder and in the maps of avatar.obj."""
    save_texture(run / "texture", load_texture(run / "texture"), texture_format)
    manifest = Manifest("texture", 1, "", {"format": texture_format}, {}, {}, {}, 0.0, 0.0)
    write_manifest(manifest, run / "texture" / "manifest.json")
    ramp = np.linspace(0.2, 0.25, SIDE_PX, dtype=np.float32)
    paint = np.repeat(np.repeat(ramp[None, :, None], SIDE_PX, axis=0), 3, axis=2)
    write_rgb(tmp_path / "ramp.png", to_uint16(paint))
    main([str(run), "--diffuse", str(tmp_path / "ramp.png")])
    out, on_charts = run / "retexture" / "ramp", covered(run, SIDE_PX)
    suffix = ".exr" if texture_format == "exr" else ".png"
    for name in ("diffuse", "avatar_diffuse"):
        pixels = read_rgb_float(out / f"{name}{suffix}")
        np.testing.assert_allclose(pixels[on_charts], paint[on_charts], atol=2e-4)
    assert f"avatar_diffuse{suffix}" in (out / "avatar.mtl").read_text()


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


def test_white_of_a_mask_counts_where_it_is_opaque(tmp_path: Path) -> None:
    pixels = np.full((SIDE_PX, SIDE_PX, 4), 255, np.uint8)
    pixels[:100, :, :3], pixels[:, :50, 3], pixels[:, 50:70, 3] = 102, 0, 51
    write_rgba(tmp_path / "layer.png", pixels)
    mask = read_mask(tmp_path / "layer.png")
    assert not mask[:, :50].any()
    for columns, alpha in ((slice(50, 70), 0.2), (slice(70, None), 1.0)):
        np.testing.assert_allclose(mask[:100, columns], 0.4 * alpha, atol=1e-6)
        np.testing.assert_allclose(mask[100:, columns], alpha, atol=1e-6)
    pixels[..., 3] = 0
    write_rgba(tmp_path / "layer.png", pixels)
    with pytest.raises(UserError, match="transparent everywhere; paint what is replaced white"):
        read_mask(tmp_path / "layer.png")


def test_bad_masks_and_runs_are_named(run: Path, tmp_path: Path) -> None:
    black, paint = tmp_path / "black.png", tmp_path / "paint.png"
    write_rgb(black, np.zeros((SIDE_PX, SIDE_PX, 3), np.uint8))
    write_rgb(paint, np.zeros((SIDE_PX, SIDE_PX, 3), np.uint8))
    for arguments, words in (
        (["--from", str(run), "--mask", str(black)], "black or transparent everywhere"),
        (["--from", str(tmp_path)], "has no finished export"),
        (["--diffuse", str(paint), "--mask", str(black)], "--mask is for"),
    ):
        with pytest.raises(UserError, match=words):
            main([str(run), *arguments])
    assert not (run / "retexture").exists()


def on_template_layout(run: Path, scene: PaintedScene, colour: list[int]) -> None:
    """Give a run the template's layout and a map of one colour."""
    exact = known_registration(scene.body)
    skinned = load_mesh(run / "mesh")
    laid = build_template_atlas(skinned.mesh, exact, SIDE_PX, 4)
    texture = replace(load_texture(run / "texture"), atlas=laid.atlas, cut=laid.cut)
    diffuse = np.tile(np.array(colour, np.float32) / 255.0, (SIDE_PX, SIDE_PX, 1))
    blank = np.zeros((SIDE_PX, SIDE_PX), np.float32)
    save_texture(run / "texture", replace(texture, diffuse=diffuse, specular=blank, coverage=blank.astype(np.uint8)))


def test_the_map_of_another_person_fits_on_the_templates_layout_only(
    run: Path, scene: PaintedScene, tmp_path: Path
) -> None:
    other = tmp_path / "other"
    other.mkdir()
    write_exported_run(other, scene)
    paint = other / "texture" / "diffuse.png"
    on_template_layout(other, scene, [200, 10, 20])
    with pytest.raises(UserError, match="one of its own"):
        main([str(run), "--diffuse", str(paint)])
    assert not (run / "retexture").exists()
    on_template_layout(run, scene, [0, 0, 255])
    main([str(run), "--diffuse", str(paint), "--name", "worn"])
    written, reserved = read_rgb(run / "retexture" / "worn" / "diffuse.png"), load_layout().is_reserved(SIDE_PX)
    on_charts = covered(run, SIDE_PX)
    for colour, rows in (([200, 10, 20], on_charts & ~reserved), ([0, 0, 255], on_charts & reserved)):
        np.testing.assert_array_equal(written[rows], np.tile(colour, (rows.sum(), 1)))
    glb = GlbFile(run / "retexture" / "worn" / "avatar.glb")
    attributes = glb.gltf["meshes"][0]["primitives"][0]["attributes"]
    written_uv = glb.accessor(attributes["TEXCOORD_0"]) * np.float32([1, -1]) + np.float32([0, 1])
    distinct = [np.unique(uv.round(5), axis=0) for uv in (written_uv, load_texture(run / "texture").atlas.uv)]
    np.testing.assert_allclose(*distinct, atol=2e-5)


@pytest.mark.parametrize(
    "place", ["export/avatar_diffuse.png", "reshape/tall/avatar_diffuse.png", "pose/t/avatar_diffuse.png"]
)
def test_copies_of_another_persons_map_are_recognised(run: Path, tmp_path: Path, place: str) -> None:
    other = tmp_path / "other"
    shutil.copytree(run / "texture", other / "texture")
    (other / place).parent.mkdir(parents=True)
    paint = Painting(np.ones((SIDE_PX, SIDE_PX, 3), np.float32), np.ones((SIDE_PX, SIDE_PX), np.float32))
    with pytest.raises(UserError, match="has the layout of .*other, and .* one of its own"):
        fit_painting(paint, other / place, run, load_texture(run / "texture"))
    assert run_of_map(other / place) == other
    assert run_of_map(other / "export" / "wrapped_diffuse.png") is None
    assert fit_painting(paint, run / place, run, load_texture(run / "texture")) is paint


def test_texels_of_two_people_on_the_templates_layout_are_exchanged_as_they_are(run: Path, scene: PaintedScene) -> None:
    on_template_layout(run, scene, [0, 0, 255])
    texture = load_texture(run / "texture")
    noise = np.random.default_rng(0).uniform(size=(SIDE_PX, SIDE_PX, 3)).astype(np.float32)
    fallback = np.zeros((SIDE_PX, SIDE_PX, 3), np.float32)
    moved = same_places(fallback, (texture, replace(texture, diffuse=noise)))
    direct = covered(run, SIDE_PX) & ~load_layout().is_reserved(SIDE_PX)
    np.testing.assert_array_equal(moved[direct], noise[direct])
    assert not moved[~direct].any()
