"""A camera carried around a person: the room is rigid, person, room and light turn together."""

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from data_tools.evaluate.truth import load_ground_truth, verify_ground_truth
from data_tools.from_gltf import main
from data_tools.synthetic.person.noise import ValueNoise
from data_tools.synthetic.scene.capture import portrait_camera
from data_tools.synthetic.scene.walk_around import make_surroundings, walking_shift_m
from pipeline.core.errors import UserError
from tests.data_tools.synthetic.rig.glb_writer import write_test_glb

SIZE_PX = 64
TINY = ["--frames", "4", "--fps", "2", "--size", "160", "--novel-views", "0", "--novel-poses", "0"]


def test_turning_the_room_is_carrying_the_camera_around_it() -> None:
    camera, ground_m = portrait_camera(SIZE_PX, 1.7, 3.0, 0.8)
    room = make_surroundings(camera, ground_m, True, ValueNoise(1))
    angle = 1.1
    carried = np.eye(4, dtype=np.float32)
    # The camera looks along -Z of its world; it goes by the opposite angle about the vertical through the person.
    cosine, sine = np.cos(angle), np.sin(angle)
    turn = np.array([[cosine, 0.0, sine], [0.0, 1.0, 0.0], [-sine, 0.0, cosine]])
    carried[:3, :3] = camera.world_to_camera[:3, :3] @ turn
    carried[:3, 3] = camera.world_to_camera[:3, :3] @ (ground_m - turn @ ground_m) + camera.world_to_camera[:3, 3]
    turned = room.seen_by(camera, ground_m, angle).image
    walked = room.seen_by(replace(camera, world_to_camera=carried), ground_m, 0.0).image
    still = room.seen_by(camera, ground_m, 0.0).image
    assert np.abs(turned - walked).mean() < 1e-4
    assert np.abs(turned - still).mean() > 0.01


def test_a_walking_camera_is_displaced_by_centimetres() -> None:
    shift_m = walking_shift_m(np.arange(0.0, 20.0, 0.1))
    assert 0.02 < np.ptp(shift_m[:, 0]) < 0.1
    assert 0.1 < np.ptp(shift_m[:, 2]) < 0.4
    assert np.abs(np.diff(shift_m, axis=0)).max() < 0.03


def test_person_room_and_light_turn_together(tmp_path: Path) -> None:
    write_test_glb(tmp_path / "person.glb")
    main([str(tmp_path / "person.glb"), str(tmp_path / "out"), *TINY, "--walk-around"])
    capture = load_ground_truth(tmp_path / "out")
    settings = json.loads((tmp_path / "out" / "truth" / "capture_settings.json").read_text())
    assert settings["walk_around"] is True
    pelvis = capture.canonical_to_world[:, 0, :3, :3].numpy()
    lights = np.array([capture.light_of_frame(k).key_direction for k in range(4)])
    from_pelvis = np.einsum("kji,kj->ki", pelvis, lights)
    np.testing.assert_allclose(from_pelvis, np.tile(from_pelvis[:1], (4, 1)), atol=0.05)
    assert np.ptp(lights[:, 0]) > 0.5
    assert verify_ground_truth(tmp_path / "out").passes()


def test_a_camera_is_not_carried_around_someone_who_walks(tmp_path: Path) -> None:
    write_test_glb(tmp_path / "person.glb")
    with pytest.raises(UserError, match="--walk-around is for a person who stands still"):
        main([str(tmp_path / "person.glb"), str(tmp_path / "out"), *TINY, "--walk-around", "--arc", "90"])
