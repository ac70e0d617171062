"""The comparison of materials on a small capture: its run is the true person, and its figures are consistent."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from data_tools.evaluate.comparison import Comparison
from data_tools.evaluate.materials import gain_to_truth, main, normal_map_angle_deg, reduced_mesh, write_true_run
from data_tools.evaluate.run_materials import score_comparison
from data_tools.evaluate.truth import load_ground_truth
from pipeline.body.body import Body
from pipeline.body.files import load_motion
from pipeline.capture.capture import load_capture
from pipeline.geometry.atlas import unwrap
from pipeline.geometry.colour import linear_to_srgb, srgb_to_linear
from pipeline.geometry.mesh import Mesh
from pipeline.geometry.surface import remove_unreferenced_vertices
from pipeline.metrics.surfaces import chamfer_distance_mm
from pipeline.texture.files import TextureArtifact
from pipeline.texture.light import Highlights, VideoLight
from pipeline.texture.normal_map import bake_normal_map
from tests.data_tools.synthetic.shapes import sphere


@pytest.mark.slow
def test_the_run_is_the_true_person(sample: Path, tmp_path: Path) -> None:
    truth = load_ground_truth(sample)
    gains = write_true_run(truth, tmp_path, 3, flicker=0.2)
    capture, motion = load_capture(tmp_path / "frames"), load_motion(tmp_path / "mesh" / "motion.npz")
    assert np.all(np.abs(gains - 1.0) <= 0.2)
    assert len(capture) == len(motion.time_s) == 3
    bright = [capture.image(position)[capture.mask(position) > 0.5].mean() for position in range(3)]
    assert np.argmax(bright) == np.argmax(gains)


@pytest.mark.slow
def test_the_reduced_mesh_is_the_true_surface(sample: Path) -> None:
    body = load_ground_truth(sample).subject.body
    reduced = reduced_mesh(body)
    assert len(reduced.mesh.faces) <= 22_000
    assert chamfer_distance_mm(reduced.mesh, body.mesh(), 5_000) < 2.0


def test_a_surface_with_texture_seams_is_reduced_without_tearing() -> None:
    """Each half of a ball has vertices of its own, as in files; reduced apart, one half would be closed by a disc."""
    vertices, faces = sphere(0.5, (0.0, 1.0, 0.0), 6)
    right = vertices[faces].mean(axis=1)[:, 0] > 0.0
    faces = np.where(right[:, None], faces, faces + len(vertices)).astype(np.int32)
    split = remove_unreferenced_vertices(Mesh(np.concatenate([vertices, vertices]), faces))
    weights = np.ones((len(split.vertices), 1), dtype=np.float32)
    body = Body(("Hips",), np.array([-1]), np.zeros((1, 3)), split.vertices, split.faces, weights, {})
    mesh = reduced_mesh(body).mesh
    assert len(mesh.faces) <= 22_000
    assert mesh.is_watertight()
    outwards = (mesh.vertices - np.array([0.0, 1.0, 0.0])) / 0.5
    assert np.linalg.norm(outwards, axis=1) == pytest.approx(1.0, abs=1e-3)
    assert np.min(np.sum(mesh.vertex_normals() * outwards, axis=1)) > np.cos(np.radians(3.0))


@pytest.mark.slow
def test_the_table_has_all_rows(sample: Path, capsys: pytest.CaptureFixture[str]) -> None:
    main([str(sample), "--frames", "6"])
    rows = capsys.readouterr().out
    for mode in ("kept", "auto", "removed"):
        for name in ("albedo_error", "relit_left_db", "heldout_psnr_body_db", "gain_error_largest"):
            assert f"{mode:8} {name} " in rows


def test_the_error_of_colours_is_what_one_gain_a_channel_leaves() -> None:
    """Linear colours that are multiples of the true ones have no error; a tenth of black ones keeps the gain."""
    true = np.random.default_rng(1).uniform(0.1, 0.9, (200, 3)).astype(np.float32)
    own = linear_to_srgb(srgb_to_linear(true.astype(np.float64)) * np.array([0.5, 0.8, 0.3]))
    gain, error = gain_to_truth(own, true)
    assert gain == pytest.approx([2.0, 1.25, 1.0 / 0.3], rel=1e-4)
    assert error < 0.01
    own[:20] = 0.0
    gain, error = gain_to_truth(own, true)
    assert gain == pytest.approx([2.0, 1.25, 1.0 / 0.3], rel=1e-4)
    assert error == pytest.approx(255.0 * true[:20].sum() / 600.0, rel=1e-3)


def test_the_normal_map_is_measured_against_the_dense_mesh() -> None:
    """A bumpy ball shades almost like the dense sphere with its map, and 3 degrees off without."""
    smooth, dense = (Mesh(*sphere(0.1, (0.0, 0.0, 0.0), level)) for level in (3, 5))
    radii = np.random.default_rng(0).uniform(0.97, 1.03, (len(smooth.vertices), 1)).astype(np.float32)
    mesh = Mesh(smooth.vertices * radii, smooth.faces)
    atlas = unwrap(mesh, np.zeros(len(mesh.faces), np.int32), 128, 4, smoothing_steps=0)
    blank = np.zeros((128, 128), np.float32)
    texture = TextureArtifact(
        atlas,
        np.zeros((128, 128, 3), np.float32),
        blank,
        blank.astype(np.uint8),
        VideoLight.uniform(1),
        Highlights.none(),
        bake_normal_map(mesh, atlas, dense, 128),
    )
    without = normal_map_angle_deg(mesh, replace(texture, normal=None), dense)
    assert without > 2.0
    assert normal_map_angle_deg(mesh, texture, dense) < 0.3 * without


@pytest.mark.slow
def test_the_true_person_as_a_run_has_the_true_texture(perfect: Comparison) -> None:
    """Relit renders agree where the avatar is the truth; half of its albedo black is an error."""
    run = perfect.run
    scores = score_comparison(perfect)
    assert scores["albedo_error"] < 3.0
    dark = run.avatar.diffuse.clone()
    dark[: len(dark) // 2] = 0.0
    painted = score_comparison(replace(perfect, run=replace(run, avatar=replace(run.avatar, diffuse=dark))))
    for name in ("relit_left_db", "relit_top_db", "heldout_psnr_body_db"):
        assert scores[name] > painted[name] + 3.0
    assert scores["relit_left_db"] > 28.0
