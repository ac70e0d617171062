"""The texture and export stages on a painted body whose mesh and poses are the truth."""

import shutil
from pathlib import Path

import cv2
import numpy as np
import pytest
import torch

from pipeline.avatar.gltf import read_glb
from pipeline.body.body import canonical_to_world
from pipeline.core.config import ConfigLayers, build_config
from pipeline.core.errors import UserError
from pipeline.geometry.skinning import linear_blend_skinning
from pipeline.geometry.texture_rendering import render_textured
from pipeline.io.image import read_gray, read_rgb, to_float, to_uint8, write_gray
from pipeline.io.npz import load_npz
from pipeline.metrics.images import composite_on_white, composite_premultiplied_on_white, foreground_mask, psnr_db
from stages.export import STAGE as EXPORT
from stages.texture import STAGE as TEXTURE
from tests.avatar.test_gltf import Player
from tests.field.scene import PaintedScene, painted_scene
from tests.stages.painted_run import make_run
from tests.tools.khronos import validator_issues

OPTIONS = {"max_texture_px": 512, "rounds": 1, "silhouette_falloff_m": 0.01}
HELD_OUT = 8


@pytest.fixture(scope="module")
def scene() -> PaintedScene:
    return painted_scene(frames=20, height_px=160)


@pytest.fixture(scope="module")
def inputs(scene: PaintedScene, tmp_path_factory: pytest.TempPathFactory) -> dict[str, Path]:
    folder = tmp_path_factory.mktemp("run")
    return make_run(folder, scene.body, scene.motion, scene.camera, scene.images, scene.masks)


@pytest.fixture(scope="module")
def textured(inputs: dict[str, Path]) -> tuple[Path, dict[str, float]]:
    out = inputs["mesh"].parent / "texture"
    out.mkdir()
    return out, dict(TEXTURE.run(inputs, out, TEXTURE.config(**OPTIONS)))


@pytest.fixture(scope="module")
def exported(inputs: dict[str, Path], textured: tuple[Path, dict[str, float]]) -> tuple[Path, dict[str, float]]:
    out = inputs["mesh"].parent / "export"
    out.mkdir()
    return out, dict(EXPORT.run(inputs | {"texture": textured[0]}, out, EXPORT.config()))


def test_the_texture_stage_makes_its_files_and_no_other(textured: tuple[Path, dict[str, float]]) -> None:
    out, metrics = textured
    assert sorted(path.name for path in out.iterdir()) == sorted(TEXTURE.makes)
    assert metrics["texture_px"] == 512
    assert cv2.imread(str(out / "diffuse.png"), cv2.IMREAD_UNCHANGED).shape == (512, 512, 3)
    assert cv2.imread(str(out / "specular.png"), cv2.IMREAD_UNCHANGED).shape == (512, 512)
    assert 0.4 < metrics["observed_texel_fraction"] < 0.95


def test_a_held_out_frame_is_foretold(scene: PaintedScene, textured: tuple[Path, dict[str, float]]) -> None:
    atlas = load_npz(textured[0] / "atlas.npz")
    posed = linear_blend_skinning(
        torch.from_numpy(scene.body.vertices),
        torch.from_numpy(scene.body.skin_weights),
        canonical_to_world(scene.body, scene.motion)[HELD_OUT : HELD_OUT + 1],
    )[0]
    layout = (torch.from_numpy(atlas[name]) for name in ("faces_uv", "uv"))
    texture = torch.from_numpy(to_float(read_rgb(textured[0] / "diffuse.png")))
    image, mask = scene.images[HELD_OUT], scene.masks[HELD_OUT]
    faces, (faces_uv, uv) = torch.from_numpy(scene.body.faces), layout

    def psnr_of(shown: torch.Tensor) -> float:
        rendered = render_textured(posed, faces, faces_uv, uv, shown, scene.camera).numpy()
        inside = cv2.erode(foreground_mask(mask).astype(np.uint8), np.ones((5, 5))) > 0  # limbs are 4 pixels wide here
        return psnr_db(composite_premultiplied_on_white(rendered), composite_on_white(image, mask), inside)

    mean_colour = torch.from_numpy(image[mask > 200].mean(axis=0) / 255.0).float()
    assert psnr_of(texture) > 6.0 + psnr_of(mean_colour.expand(512, 512, 3))


def test_coverage_is_black_between_charts_and_bright_on_the_chest(
    scene: PaintedScene, textured: tuple[Path, dict[str, float]]
) -> None:
    coverage, atlas = read_gray(textured[0] / "coverage.png"), load_npz(textured[0] / "atlas.npz")
    corner = [coverage[0, 0], coverage[-1, -1], coverage[0, -1]]
    assert min(corner) == 0
    chest = np.argmin(np.linalg.norm(scene.body.vertices - [0.0, 1.25, 0.15], axis=1))
    uv = atlas["uv"][np.flatnonzero(atlas["vertex_of_uv"] == chest)[0]]
    assert coverage[int((1.0 - uv[1]) * 512), int(uv[0] * 512)] > 180


def test_plain_paint_is_matte(textured: tuple[Path, dict[str, float]]) -> None:
    assert textured[1]["specular_partial_r2"] < 0.05
    assert read_gray(textured[0] / "specular.png").max() <= 20


def test_no_frame_but_training_and_validation_is_read(inputs: dict[str, Path], scene: PaintedScene) -> None:
    image = inputs["frames"] / "images" / f"{HELD_OUT:06d}.png"
    hidden = image.rename(image.with_suffix(".hidden"))
    try:
        out = inputs["mesh"].parent / "again"
        out.mkdir()
        TEXTURE.run(inputs, out, TEXTURE.config(**OPTIONS | {"rounds": 0}))
    finally:
        hidden.rename(image)


def test_the_same_inputs_give_the_same_bytes(
    inputs: dict[str, Path], textured: tuple[Path, dict[str, float]], tmp_path: Path
) -> None:
    TEXTURE.run(inputs, tmp_path, TEXTURE.config(**OPTIONS))
    for name in TEXTURE.makes:
        assert (tmp_path / name).read_bytes() == (textured[0] / name).read_bytes(), name


def test_without_training_frames_the_remedy_is_named(inputs: dict[str, Path], tmp_path: Path) -> None:
    arrays = load_npz(inputs["frames"] / "frames.npz")
    only_held_out = tmp_path / "frames"
    only_held_out.mkdir()
    np.savez(only_held_out / "frames.npz", **arrays | {"split": np.full(len(arrays["split"]), 2, np.uint8)})
    with pytest.raises(UserError, match="stages.frames"):
        TEXTURE.run(inputs | {"frames": only_held_out}, tmp_path, TEXTURE.config(**OPTIONS))


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"max_texture_px": 1000}, "largest_px = 1000 .* a power of two"),
        ({"min_texture_px": 96, "max_texture_px": 128}, "smallest_px = 96 .* a power of two"),
        ({"min_texture_px": 1024, "max_texture_px": 512}, "largest_px = 512 .* at least smallest_px, which is 1024"),
    ],
)
def test_sides_that_are_no_texture_are_refused(options: dict[str, int], message: str) -> None:
    layers = ConfigLayers()
    layers.add({"texture": options}, "test.yaml")
    with pytest.raises(UserError, match=message):
        build_config("texture", TEXTURE.config, layers)


def test_the_export_stage_makes_its_files_and_no_other(
    scene: PaintedScene, exported: tuple[Path, dict[str, float]]
) -> None:
    out, metrics = exported
    assert sorted(path.name for path in out.iterdir()) == sorted(EXPORT.makes)
    assert metrics["glb_bytes"] == (out / "avatar.glb").stat().st_size
    assert metrics["animation_s"] == pytest.approx(scene.motion.time_s[-1])


def test_the_khronos_validator_finds_nothing(exported: tuple[Path, dict[str, float]]) -> None:
    assert validator_issues(exported[0] / "avatar.glb") == []


def test_the_avatar_moves_as_filmed_with_the_floor_at_zero(
    scene: PaintedScene, exported: tuple[Path, dict[str, float]]
) -> None:
    player = Player(exported[0] / "avatar.glb")
    posed = player.posed_vertices(scene.motion.time_s[HELD_OUT])
    transforms = canonical_to_world(scene.body, scene.motion)[HELD_OUT : HELD_OUT + 1]
    weights = torch.from_numpy(scene.body.skin_weights)
    world = linear_blend_skinning(torch.from_numpy(scene.body.vertices), weights, transforms)[0].numpy()
    offset_m = np.array(player.json["asset"]["extras"]["world_to_scene_translation_m"])
    atlas = load_npz(exported[0].parent / "texture" / "atlas.npz")
    # four influences instead of all: millimetres, at joints
    assert np.abs(posed - (world + offset_m)[atlas["vertex_of_uv"]]).max() < 0.01
    assert abs(posed[:, 1].min()) < 0.12
    assert np.abs(posed.mean(axis=0)[[0, 2]]).max() < 0.15


def test_the_pictures_inside_the_glb_are_the_maps(exported: tuple[Path, dict[str, float]]) -> None:
    document, binary = read_glb(exported[0] / "avatar.glb")
    view = document["bufferViews"][document["images"][0]["bufferView"]]
    png = binary[view["byteOffset"] : view["byteOffset"] + view["byteLength"]]
    assert png == (exported[0] / "avatar_diffuse.png").read_bytes()
    same = read_rgb(exported[0] / "avatar_diffuse.png") == read_rgb(exported[0].parent / "texture" / "diffuse.png")
    assert same.all()
    assert to_uint8(np.float32([0.5])) == 128


def test_highlights_become_a_factor_unless_the_surface_is_unlit(
    inputs: dict[str, Path], textured: tuple[Path, dict[str, float]], tmp_path: Path
) -> None:
    shiny = shutil.copytree(textured[0], tmp_path / "texture")
    amplitude = np.zeros((512, 512), dtype=np.uint8)
    amplitude[:, 256:] = 1
    write_gray(shiny / "specular.png", amplitude)
    materials = []
    for name, unlit in (("lit", False), ("unlit", True)):
        (tmp_path / name).mkdir()
        EXPORT.run(inputs | {"texture": shiny}, tmp_path / name, EXPORT.config(unlit=unlit))
        assert validator_issues(tmp_path / name / "avatar.glb") == []
        document, binary = read_glb(tmp_path / name / "avatar.glb")
        materials.append((set(document["materials"][0]["extensions"]), len(document["images"])))
        if not unlit:
            view = document["bufferViews"][document["images"][1]["bufferView"]]
            png = np.frombuffer(binary, np.uint8, view["byteLength"], view["byteOffset"])
            alpha = cv2.imdecode(png, cv2.IMREAD_UNCHANGED)[..., 3]
            assert not alpha[:, :256].any()
            assert 10 < np.median(alpha[:, 256:]) < 120  # one level of 255 is a part of what a dielectric adds
    assert materials == [({"KHR_materials_specular"}, 2), ({"KHR_materials_unlit"}, 1)]
