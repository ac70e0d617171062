"""The texture stage on a painted body with true mesh and poses."""

from pathlib import Path

import cv2
import numpy as np
import pytest
import torch

from pipeline.body.body import canonical_to_world
from pipeline.core.config import ConfigLayers, build_config
from pipeline.core.errors import UserError
from pipeline.core.stage import CHECKPOINT_PREFIX
from pipeline.geometry.mesh import Mesh
from pipeline.geometry.skinning import linear_blend_skinning
from pipeline.geometry.texture_rendering import render_textured
from pipeline.io.npz import load_npz
from pipeline.mesh.files import load_mesh, save_dense_mesh
from pipeline.metrics.images import composite_on_white, composite_premultiplied_on_white, foreground_mask, psnr_db
from pipeline.template.files import load_fitted_template
from pipeline.texture.files import FLAT_NORMAL, load_texture
from pipeline.texture.settings import TextureSettings
from stages.texture import STAGE as TEXTURE
from stages.texture import make_normal_map, run
from tests.field.scene import PaintedScene, painted_scene
from tests.stages.painted_run import make_run

OPTIONS = {"max_texture_px": 512, "rounds": 1, "atlas": "capture"}
SETTINGS = TextureSettings(silhouette_falloff_m=0.01)
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
    return out, dict(run(inputs, out, TEXTURE.config(**OPTIONS), SETTINGS))


def test_the_stage_writes_its_files_and_no_other(textured: tuple[Path, dict[str, float]]) -> None:
    out, metrics = textured
    written = {path.name for path in out.iterdir()}
    assert {name for name in written if not name.startswith(CHECKPOINT_PREFIX)} == set(TEXTURE.makes)
    assert metrics["texture_px"] == 512
    assert cv2.imread(str(out / "diffuse.png"), cv2.IMREAD_UNCHANGED).shape == (512, 512, 3)
    assert cv2.imread(str(out / "specular.png"), cv2.IMREAD_UNCHANGED).shape == (512, 512)
    assert 0.4 < metrics["observed_texel_fraction"] < 0.95


def test_a_held_out_frame_is_predicted(scene: PaintedScene, textured: tuple[Path, dict[str, float]]) -> None:
    artifact = load_texture(textured[0])
    posed = linear_blend_skinning(
        torch.from_numpy(scene.body.vertices),
        torch.from_numpy(scene.body.skin_weights),
        canonical_to_world(scene.body, scene.motion)[HELD_OUT : HELD_OUT + 1],
    )[0]
    layout = (torch.from_numpy(getattr(artifact.atlas, name)) for name in ("faces_uv", "uv"))
    texture = torch.from_numpy(artifact.diffuse)
    image, mask = scene.images[HELD_OUT], scene.masks[HELD_OUT]
    faces, (faces_uv, uv) = torch.from_numpy(scene.body.faces), layout

    def psnr_of(shown: torch.Tensor) -> float:
        rendered = render_textured(posed, faces, faces_uv, uv, shown, scene.camera).numpy()
        inside = cv2.erode(foreground_mask(mask).astype(np.uint8), np.ones((5, 5))) > 0  # limbs are 4 pixels wide
        return psnr_db(composite_premultiplied_on_white(rendered), composite_on_white(image, mask), inside)

    mean_colour = torch.from_numpy(image[mask > 200].mean(axis=0) / 255.0).float()
    assert psnr_of(texture) > 6.0 + psnr_of(mean_colour.expand(512, 512, 3))


def test_coverage_is_zero_between_charts_and_high_on_the_chest(
    scene: PaintedScene, textured: tuple[Path, dict[str, float]]
) -> None:
    artifact = load_texture(textured[0])
    coverage, atlas = artifact.coverage, artifact.atlas
    corner = [coverage[0, 0], coverage[-1, -1], coverage[0, -1]]
    assert min(corner) == 0
    chest = np.argmin(np.linalg.norm(scene.body.vertices - [0.0, 1.25, 0.15], axis=1))
    uv = atlas.uv[np.flatnonzero(atlas.vertex_of_uv == chest)[0]]
    assert coverage[int((1.0 - uv[1]) * 512), int(uv[0] * 512)] > 180


def test_a_diffuse_surface_is_matte(textured: tuple[Path, dict[str, float]]) -> None:
    assert not load_texture(textured[0]).specular.any()


@pytest.fixture(scope="module")
def repeated(inputs: dict[str, Path]) -> Path:
    """A second run with the same inputs, without the image of a held-out frame."""
    image = inputs["frames"] / "images" / f"{HELD_OUT:06d}.png"
    hidden = image.rename(image.with_suffix(".hidden"))
    try:
        out = inputs["mesh"].parent / "repeated"
        out.mkdir()
        run(inputs, out, TEXTURE.config(**OPTIONS), SETTINGS)
    finally:
        hidden.rename(image)
    return out


def test_held_out_frames_are_not_read(repeated: Path) -> None:
    assert {path.name for path in repeated.iterdir()} >= set(TEXTURE.makes)


def test_the_same_inputs_give_the_same_bytes(repeated: Path, textured: tuple[Path, dict[str, float]]) -> None:
    for name in TEXTURE.makes:
        assert (repeated / name).read_bytes() == (textured[0] / name).read_bytes(), name


def test_missing_training_frames_are_an_error_with_the_command(inputs: dict[str, Path], tmp_path: Path) -> None:
    arrays = load_npz(inputs["frames"] / "frames.npz")
    only_held_out = tmp_path / "frames"
    only_held_out.mkdir()
    np.savez(only_held_out / "frames.npz", **arrays | {"split": np.full(len(arrays["split"]), 2, np.uint8)})
    with pytest.raises(UserError, match="stages frames"):
        TEXTURE.run(inputs | {"frames": only_held_out}, tmp_path, TEXTURE.config(**OPTIONS))


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"max_texture_px": 1000}, "max_texture_px = 1000 .* a power of two"),
        ({"min_texture_px": 96, "max_texture_px": 128}, "min_texture_px = 96 .* a power of two"),
        (
            {"min_texture_px": 1024, "max_texture_px": 512},
            "max_texture_px = 512 .* at least min_texture_px, which is 1024",
        ),
        ({"min_texture_px": 4096}, "max_texture_px = 2048 .* at least min_texture_px, which is 4096"),
    ],
)
def test_invalid_texture_sizes_are_refused(options: dict[str, int], message: str) -> None:
    layers = ConfigLayers()
    layers.add({"texture": options}, "test.yaml")
    with pytest.raises(UserError, match=message):
        build_config("texture", TEXTURE.config, layers)


def test_a_normal_map_is_made_only_where_faces_were_removed(
    scene: PaintedScene, textured: tuple[Path, dict[str, float]], tmp_path: Path
) -> None:
    mesh, atlas = scene.body.mesh(), load_texture(textured[0]).atlas
    assert load_texture(textured[0]).normal is None
    save_dense_mesh(tmp_path, mesh)
    assert make_normal_map(tmp_path, mesh, atlas, 256, len(mesh.faces)) is None
    middle = mesh.vertices[mesh.faces[0]].mean(axis=0, keepdims=True)
    a, b, c = mesh.faces[0]
    extra = len(mesh.vertices)
    split = np.array([[a, b, extra], [b, c, extra], [c, a, extra]], dtype=mesh.faces.dtype)
    save_dense_mesh(tmp_path, Mesh(np.concatenate([mesh.vertices, middle]), np.concatenate([mesh.faces[1:], split])))
    normal = make_normal_map(tmp_path, mesh, atlas, 256, len(mesh.faces))
    assert normal is not None
    assert normal.shape == (128, 128, 3)
    assert np.abs(normal - np.float32(FLAT_NORMAL)).mean() < 0.01


@pytest.mark.slow
def test_the_templates_layout_is_baked_as_well_as_the_persons_own(
    scene: PaintedScene, inputs: dict[str, Path], textured: tuple[Path, dict[str, float]], tmp_path: Path
) -> None:
    metrics = run(inputs, tmp_path, TEXTURE.config(**OPTIONS | {"atlas": "template"}), SETTINGS)
    assert metrics["template_distance_p95_mm"] < 6.0
    artifact = load_texture(tmp_path)
    assert artifact.cut is not None
    skinned = load_mesh(inputs["mesh"]).cut(artifact.cut)
    np.testing.assert_array_equal(artifact.atlas.vertex_of_uv[artifact.atlas.faces_uv], skinned.mesh.faces)
    np.testing.assert_allclose(skinned.joint_weights.sum(axis=1), 1.0, atol=1e-5)
    fitted = load_fitted_template(tmp_path)
    assert fitted is not None
    assert len(fitted.correspondence.face) == len(skinned.mesh.vertices)
    assert metrics["validation_psnr_body_db"] > textured[1]["validation_psnr_body_db"] - 0.5
