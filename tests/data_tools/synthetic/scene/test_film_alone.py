"""A person who films alone: away from the camera, a turn, and back to it."""

from pathlib import Path

import numpy as np
import pytest
import torch

from data_tools.from_gltf import main
from data_tools.synthetic.scene.film_alone import MIN_FRAMES, film_alone
from data_tools.synthetic.scene.motion import turn_in_a_pose
from pipeline.avatar.motion.feet import joint_positions_m, lowest_foot_offset_m
from pipeline.body.body import Body, Motion
from pipeline.core.errors import UserError
from pipeline.geometry.rotation import quaternion_to_matrix

GROUND_M, CAMERA_M = np.array([0.2, -0.9, -3.6]), np.array([0.2, 0.4, 0.0])


@pytest.fixture(scope="module")
def alone(bare: Body) -> Motion:
    return film_alone(bare, turn_in_a_pose(bare, 2 * MIN_FRAMES, 12.0, GROUND_M, seed=0), GROUND_M, CAMERA_M)


def test_the_person_comes_from_the_camera_and_goes_back(alone: Motion) -> None:
    """At both ends the person is 0.7 m from the camera; the turn in half of the frames is on the spot."""
    from_camera_m = (CAMERA_M - alone.root_translation_m)[:, [0, 2]]
    distance_m = np.linalg.norm(from_camera_m, axis=1)
    assert len(distance_m) == 2 * MIN_FRAMES
    np.testing.assert_allclose(distance_m[[0, -1]], 0.7, atol=0.05)
    assert (np.abs(distance_m - 3.6) < 0.01).mean() == pytest.approx(0.63, abs=0.03)
    front = quaternion_to_matrix(torch.from_numpy(alone.rotations_wxyz[:, 0]))[:, 2, 2].numpy()
    assert front[0] < -0.9  # the back of the person
    assert front[-1] > 0.9
    assert front[36:90].min() < -0.9
    assert front[[33, 94]].min() > 0.9


def test_legs_step_while_walking_alone_and_a_foot_is_on_the_floor(bare: Body, alone: Motion) -> None:
    feet = [bare.joint("LeftFoot"), bare.joint("RightFoot")]
    ahead_m = np.subtract(*joint_positions_m(bare, alone)[:, feet, 2].T)
    for walk in (slice(0, 20), slice(-24, None)):
        assert ahead_m[walk].min() < -0.3
        assert ahead_m[walk].max() > 0.3
    np.testing.assert_allclose(lowest_foot_offset_m(bare, alone), GROUND_M[1], atol=1e-5)


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["--frames", "30"], "--film-alone needs --frames 60"),
        (["--frames", "60", "--arc", "90"], "--film-alone is for"),
    ],
)
def test_filming_alone_needs_a_full_turn(tmp_path: Path, arguments: list[str], message: str) -> None:
    with pytest.raises(UserError, match=message):
        main([str(tmp_path / "person.glb"), str(tmp_path / "out"), "--film-alone", *arguments])
