"""The ceiling of novel views: the true person with its best static texture."""

from dataclasses import replace

import numpy as np
import pytest
import torch

from data_tools.evaluate import compare_avatar
from data_tools.evaluate.compare_avatar import compare_ceiling, compare_novel_views
from data_tools.evaluate.comparison import Comparison
from data_tools.evaluate.static_texture import static_brightness
from data_tools.sample import main as make_sample
from data_tools.synthetic.scene.renderer import Light, pose_vertices
from pipeline.capture.frame_selection import TRAIN
from pipeline.geometry.mesh import Mesh
from tests.data_tools.conftest import SAMPLE_OPTIONS
from tests.data_tools.ground_truth_run import ground_truth_run


def test_ceiling_under_flat_light_is_the_truth(flat: Comparison, monkeypatch: pytest.MonkeyPatch) -> None:
    """The true texture is static: with as many samples as the truth only rounding differs."""
    monkeypatch.setattr(compare_avatar, "SAMPLES_PER_AXIS", flat.truth.samples)
    assert torch.allclose(static_brightness(flat), torch.ones(1), atol=1e-5)
    ceiling = compare_ceiling(flat)
    assert set(ceiling) == {"novel_views_ceiling", "novel_poses_ceiling"}
    for scores in ceiling.values():
        assert scores["psnr_body"] > 45.0
        assert scores["mask_iou"] > 0.999


@pytest.fixture(scope="module")
def flat(tmp_path_factory: pytest.TempPathFactory) -> Comparison:
    """The true person as a run, in a capture with the options of `sample` and flat light."""
    out = tmp_path_factory.mktemp("captures") / "flat"
    make_sample([str(out), *SAMPLE_OPTIONS, "--light", "flat"])
    return ground_truth_run(out, tmp_path_factory.mktemp("flat"))


def test_light_lowers_the_ceiling(perfect: Comparison) -> None:
    """In views all around, a texture with the mean light is better than the bare texture of the perfect avatar."""
    ceiling = compare_ceiling(perfect)
    bare = np.mean([pair.scores()["psnr_body"] for pair in compare_novel_views(perfect)])
    assert bare + 0.5 < ceiling["novel_views_ceiling"]["psnr_body"] < 35.0
    assert ceiling["novel_poses_ceiling"]["psnr_body"] < 35.0


def test_brightness_is_the_mean_over_training_frames(perfect: Comparison) -> None:
    """In a room lit from above: the mean of the shades of mid grey, weighted by the view."""
    frames = perfect.run.capture.frame_index[perfect.run.capture.positions(TRAIN)]
    light = Light(key_intensity=0.0, ambient_intensity=0.7, sky_gradient=0.2)
    truth = replace(perfect.truth, light=light)
    found = static_brightness(replace(perfect, truth=truth)).numpy()
    numerator = denominator = 0.0
    for frame in frames.tolist():
        vertices = pose_vertices(truth.subject, truth.canonical_to_world[frame]).double().numpy()
        normals = Mesh(vertices, truth.subject.body.faces).vertex_normals()
        towards = truth.camera.centre_m() - vertices
        towards /= np.linalg.norm(towards, axis=1, keepdims=True)
        weight = np.maximum((normals * towards).sum(1), 1e-3)
        linear = ((0.5 + 0.055) / 1.055) ** 2.4 * (0.7 + 0.2 * normals[:, 1])
        numerator = numerator + weight * (1.055 * linear ** (1 / 2.4) - 0.055) / 0.5
        denominator = denominator + weight
    assert np.allclose(found, numerator / denominator, atol=2e-3)
