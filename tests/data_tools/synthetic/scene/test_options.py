"""Capture options: novel cameras of a walking person, novel poses from BVH, focal length, meshes."""

import json
from pathlib import Path

import numpy as np
import pytest
import torch
import trimesh

from data_tools.command import run_command
from data_tools.evaluate.truth import _main as truth_command
from data_tools.evaluate.truth import load_ground_truth, load_true_mask, verify_ground_truth
from data_tools.from_gltf import main
from pipeline.body.body import Body, Motion, canonical_to_world
from pipeline.body.files import load_camera, load_motion
from pipeline.geometry.camera import project
from pipeline.io.image import read_rgba
from tests.data_tools.synthetic.rig.bvh_writer import write_test_bvh
from tests.data_tools.synthetic.rig.glb_writer import write_test_glb

TINY = ["--frames", "2", "--fps", "10", "--size", "160", "--fill", "0.6"]
HIPS_M = np.array([0.0, 1.0, 0.0])


@pytest.fixture
def person(tmp_path: Path) -> Path:
    write_test_glb(tmp_path / "person.glb")
    return tmp_path / "person.glb"


def left_arms(body: Body, motion: Motion) -> np.ndarray:
    """Unit vectors (n, 3) along the upper arm."""
    joints = [body.joint(name) for name in ("LeftArm", "LeftForeArm")]
    transforms = canonical_to_world(body, motion)[:, joints].numpy()
    positions_m = np.einsum("njab,jb->nja", transforms[..., :3, :3], body.joints_m[joints]) + transforms[..., :3, 3]
    bone = positions_m[:, 1] - positions_m[:, 0]
    return bone / np.linalg.norm(bone, axis=1, keepdims=True)


def test_novel_cameras_look_at_a_walking_person(person: Path, tmp_path: Path) -> None:
    """In the first frame, which they show, the person is two metres from the middle of the trajectory."""
    write_test_bvh(tmp_path / "walk.bvh", HIPS_M + np.linspace(0, 4, 21)[:, None] * [1.0, 0.0, 0.0], np.zeros(21))
    main([str(person), str(tmp_path / "out"), *TINY, "--bvh", str(tmp_path / "walk.bvh"), "--novel-views", "3"])
    truth = tmp_path / "out" / "truth"
    assert load_motion(truth / "motion.npz").root_translation_m[0, 0] < -1.5
    for index in range(3):
        alpha = read_rgba(truth / "novel_views" / f"{index:06d}.png")[:, :, 3]
        rows, columns = np.nonzero(alpha > 127)
        assert 0.4 < np.ptp(rows) / 160 < 0.8
        assert abs((columns.min() + columns.max()) / 2 - 80) < 16
        assert not alpha[[0, -1]].any()
        assert not alpha[:, [0, -1]].any()


def test_novel_poses_span_the_whole_motion(person: Path, tmp_path: Path) -> None:
    """The left arm rises by 80 degrees in 9 frames while the person walks; three frames are selected."""
    write_test_bvh(
        tmp_path / "rise.bvh", HIPS_M + np.linspace(0, 4, 9)[:, None] * [1.0, 0.0, 0.0], np.linspace(-40, 40, 9)
    )
    command = [str(person), str(tmp_path / "out"), *TINY, "--novel-views", "0"]
    main([*command, "--novel-poses", "3", "--novel-bvh", str(tmp_path / "rise.bvh")])
    truth = tmp_path / "out" / "truth"
    motion, capture = load_motion(truth / "novel_poses" / "motion.npz"), load_ground_truth(tmp_path / "out")
    arms = left_arms(capture.subject.body, motion)
    assert np.degrees(np.arccos(arms[0] @ arms[1])) == pytest.approx(40.0, abs=0.5)
    assert np.degrees(np.arccos(arms[0] @ arms[2])) == pytest.approx(80.0, abs=0.5)
    assert motion.frame_index.tolist() == [0, 1, 2]
    assert np.allclose(motion.root_translation_m[:, [0, 2]], capture.ground_m[[0, 2]], atol=1e-5)
    pictures = [read_rgba(truth / "novel_poses" / f"{index:06d}.png") for index in range(3)]
    tops = [np.flatnonzero((picture[:, 105:, 3] > 127).any(axis=1))[0] for picture in pictures]
    assert tops[0] > tops[1] > tops[2]
    assert json.loads((truth / "capture_settings.json").read_text())["novel_motion"] == "rise.bvh"


def test_focal_length_option(person: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """The person covers f height / distance pixels."""
    command = [str(person), str(tmp_path / "out"), *TINY, "--novel-poses", "0", "--novel-views", "0", "--focal"]
    assert run_command(main, [*command, "400"]) == 2
    assert "--focal 400.0 makes the person cover 1." in capsys.readouterr().err
    main([*command, "150"])
    camera = load_camera(tmp_path / "out" / "truth" / "camera.npz")
    assert (camera.fx, camera.fy) == pytest.approx((150.0, 150.0))
    capture = load_ground_truth(tmp_path / "out")
    rows = np.flatnonzero((capture.render_frame(0)[1] > 127).any(axis=1))
    assert np.ptp(rows) + 1 == pytest.approx(150.0 * capture.subject.body.height_m() / 3.6, abs=5.0)
    assert verify_ground_truth(tmp_path / "out").passes()


def test_projected_meshes_have_the_extent_of_the_masks(person: Path, tmp_path: Path) -> None:
    """Meshes are read by trimesh and projected."""
    main([str(person), str(tmp_path / "out"), *TINY, "--novel-views", "0", "--novel-poses", "0"])
    capture = load_ground_truth(tmp_path / "out")
    assert run_command(truth_command, [str(tmp_path / "out"), "--meshes", str(tmp_path / "meshes")]) == 0
    assert len(list((tmp_path / "meshes").glob("*.obj"))) == 2
    for index in range(2):
        mesh = trimesh.load_mesh(tmp_path / "meshes" / f"{index:06d}.obj", process=False)
        assert len(mesh.faces) == len(capture.subject.body.faces)
        pixels, _ = project(torch.tensor(mesh.vertices).float(), capture.camera)
        rows, columns = np.nonzero(load_true_mask(tmp_path / "out", index) > 127)
        assert np.allclose(pixels.min(0).values, [columns.min(), rows.min()], atol=1.0)
        assert np.allclose(pixels.max(0).values, [columns.max() + 1, rows.max() + 1], atol=1.0)


def test_pitched_capture_of_a_person_who_leans(person: Path, tmp_path: Path) -> None:
    """The room surrounds the person, the stored truth reproduces the video, and the camera is the requested one."""
    out = tmp_path / "out"
    turned = ["--pitch-deg", "-15", "--roll-deg", "5", "--lean-deg", "5", "--novel-views", "0", "--novel-poses", "0"]
    main([str(person), str(out), *TINY, *turned])
    assert verify_ground_truth(out, frame_stride=1).passes()
    capture = load_ground_truth(out)
    assert np.degrees(np.arcsin(capture.camera.world_to_camera[2, 1])) == pytest.approx(-15.0, abs=1e-4)
    assert np.isfinite(capture.room.image).all()
    assert np.isfinite(capture.room.floor_m[-1]).all()  # the camera looks down on the floor
    mask = load_true_mask(out, 0) > 127
    assert not mask[[0, -1]].any()
    assert mask.sum() > 500


def test_camera_below_the_floor_is_an_error(person: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert run_command(main, [str(person), str(tmp_path / "out"), *TINY, "--pitch-deg", "30"]) == 2
    assert "--pitch-deg 30" in capsys.readouterr().err
    assert not (tmp_path / "out").exists()
