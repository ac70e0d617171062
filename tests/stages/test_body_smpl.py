"""Stage `body` with a model file of the user's: the same artifacts, with the model's joints."""

import numpy as np
import pytest

from pipeline.avatar.smpl import SmplBody
from pipeline.core.errors import UserError
from pipeline.io.npz import load_body, load_motion
from stages.body import STAGE, Config, run
from tests.avatar.acting import act
from tests.avatar.smpl_sample import file_contents, made_up_arrays
from tests.stages.test_body import FRAMES, write_capture


@pytest.fixture
def model_file(tmp_path):
    path = tmp_path / "SMPL_NEUTRAL.npz"
    np.savez(path, **file_contents(made_up_arrays(24)))
    return path


def test_a_model_file_takes_the_place_of_the_built_in_body(tmp_path, model_file) -> None:
    model = SmplBody(made_up_arrays(24))
    scene = act(model, FRAMES, shape={"beta_1": 1.0}, turn_rad=2.0, noise_m=0.005)
    frames, out = tmp_path / "frames", tmp_path / "body"
    out.mkdir()
    write_capture(frames, scene, scene.camera, scene.masks())
    config = Config(model_file=str(model_file), height_m=scene.model.height_m()[0], rounds=2)
    metrics = run({"frames": frames}, out, config)
    assert {path.name for path in out.iterdir()} == set(STAGE.makes)
    assert metrics["silhouette_iou"] > 0.93
    body, motion = load_body(out / "body.npz"), load_motion(out / "motion.npz")
    assert body.joint_names == model.joint_names
    assert list(body.shape) == [f"beta_{number}" for number in range(10)]
    assert motion.rotations_wxyz.shape == (FRAMES, 24, 4)
    assert np.abs(motion.root_translation_m - scene.state.root_m.numpy()).max() < 0.05


def test_a_missing_model_file_is_refused(tmp_path) -> None:
    model = SmplBody(made_up_arrays(24))
    scene = act(model, FRAMES)
    write_capture(tmp_path / "frames", scene, scene.camera, scene.masks())
    with pytest.raises(UserError, match="SMPL_MALE.npz"):
        run({"frames": tmp_path / "frames"}, tmp_path, Config(model_file=str(tmp_path / "SMPL_MALE.npz")))
