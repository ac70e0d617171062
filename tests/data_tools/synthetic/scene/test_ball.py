"""The ball: coverage of a sphere in closed form, and a capture with a ball."""

import json
from pathlib import Path

import numpy as np
import pytest

from data_tools.evaluate.truth import load_ground_truth, verify_ground_truth
from data_tools.sample import main
from data_tools.synthetic.scene.ball import RADIUS_M, Ball
from data_tools.synthetic.scene.capture import portrait_camera
from data_tools.synthetic.scene.renderer import FLAT
from pipeline.io.image import read_gray
from tests.data_tools.conftest import SAMPLE_OPTIONS


def test_coverage_of_the_ball_in_closed_form() -> None:
    camera, ground_m = portrait_camera(240, 1.8, 3.6, 0.8)
    ball = Ball(ground_m, 1.8)
    for time_s in (0.0, 0.4, 1.9):
        picture, centre = ball.render_rgba(camera, time_s, FLAT, 3), ball.centre_m(time_s)
        # A cone of this half angle: its cut with the image plane is an ellipse of that area.
        distance = np.linalg.norm(centre)
        half, off = np.arcsin(RADIUS_M / distance), np.arccos(-centre[2] / distance)
        minor = camera.fx * np.sin(half) * np.cos(half) / (np.cos(off) ** 2 - np.sin(half) ** 2)
        major = camera.fx * np.sin(half) / np.sqrt(np.cos(off) ** 2 - np.sin(half) ** 2)
        assert picture[..., 3].sum() == pytest.approx(np.pi * minor * major, rel=0.01)
        rows, columns = np.nonzero(picture[..., 3] > 0.5)
        assert np.mean(columns) + 0.5 == pytest.approx(camera.cx - camera.fx * centre[0] / centre[2], abs=0.5)
        assert np.mean(rows) + 0.5 == pytest.approx(camera.cy + camera.fy * centre[1] / centre[2], abs=0.5)
        assert (picture[..., :3] <= picture[..., 3:] + 1e-6).all()


def test_ball_is_in_front_of_the_person() -> None:
    ball = Ball(np.array([0.0, -0.9, -3.0]), 1.8)
    places = np.stack([ball.centre_m(time_s) for time_s in np.linspace(0, 20, 400)])
    assert places[:, 1].min() > -0.9 + RADIUS_M
    assert places[:, 1].max() < -0.9 + 1.8
    assert np.abs(places[:, 0]).max() < 0.3
    assert np.ptp(places[:, 1]) > 0.7


@pytest.mark.slow
def test_capture_with_a_ball_and_its_ground_truth(sample: Path, tmp_path: Path) -> None:
    main([str(tmp_path / "ball"), *SAMPLE_OPTIONS, "--ball"])
    assert json.loads((tmp_path / "ball" / "truth" / "capture_settings.json").read_text())["ball"] is True
    capture = load_ground_truth(tmp_path / "ball")
    assert load_ground_truth(sample).ball is None
    assert verify_ground_truth(tmp_path / "ball").passes()
    hidden = []
    for frame in range(6):
        mask, whole = (read_gray(out / "truth" / "masks" / f"{frame:06d}.png") for out in (tmp_path / "ball", sample))
        ball = capture.ball.render_rgba(capture.camera, frame / capture.fps, capture.light, capture.samples)[..., 3]
        assert ((mask == 0) | (ball < 1)).all()
        assert (mask[ball == 0] == whole[ball == 0]).all()
        hidden.append((whole[ball == 1] > 127).mean())
    # Now and then it shows between the legs.
    assert np.mean(hidden) > 0.3
