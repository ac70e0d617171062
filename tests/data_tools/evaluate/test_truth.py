"""The ground truth reproduces the video, errors are detected, and independent methods agree with it."""

import json
import shutil
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch

from data_tools.command import run_command
from data_tools.evaluate.truth import _main as truth_command
from data_tools.evaluate.truth import load_ground_truth, load_true_mask, verify_ground_truth
from data_tools.synthetic.person.noise import ValueNoise
from data_tools.synthetic.scene.backdrop import make_room
from data_tools.synthetic.scene.capture import CAPTURE_VERSION, SyntheticCapture
from data_tools.synthetic.scene.movie import write_video
from data_tools.synthetic.scene.renderer import pose_vertices
from pipeline.body.files import load_motion, save_motion
from pipeline.capture.video import open_frame_source, read_frames
from pipeline.core.errors import UserError
from pipeline.geometry.camera import pixel_rays, project
from tests.data_tools.synthetic.shapes import ray_triangle_distances


@pytest.fixture(scope="module")
def capture(sample: Path) -> SyntheticCapture:
    return load_ground_truth(sample)


def test_ground_truth_reproduces_the_video(sample: Path, capsys: pytest.CaptureFixture[str]) -> None:
    result = verify_ground_truth(sample, frame_stride=2)
    assert result.frames == 3
    assert result.passes()
    assert result.psnr_body_db > 48.0
    assert run_command(truth_command, [str(sample), "--frame-stride", "3"]) == 0
    assert "mask IoU 1.0000" in capsys.readouterr().out


def test_wrong_ground_truth_is_detected(sample: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """A motion with an error of two centimetres must not pass."""
    wrong = tmp_path / "wrong"
    shutil.copytree(sample, wrong)
    motion = load_motion(wrong / "truth" / "motion.npz")
    moved = motion.with_pose(motion.rotations_wxyz, motion.root_translation_m + [0.02, 0.0, 0.0])
    save_motion(wrong / "truth" / "motion.npz", moved)
    assert not verify_ground_truth(wrong, frame_stride=3).passes()
    assert run_command(truth_command, [str(wrong), "--frame-stride", "3"]) == 2
    assert capsys.readouterr().err.startswith("error: ")


def test_ground_truth_of_a_camera_in_the_hand_reproduces_its_video(hand_held: Path) -> None:
    truth = load_ground_truth(hand_held)
    assert (truth.hand_held_deg, truth.distortion) == (3.0, -0.1)
    assert verify_ground_truth(hand_held, frame_stride=2).passes()


def test_missing_ground_truth_is_an_error(tmp_path: Path) -> None:
    with pytest.raises(UserError, match=r"holds no ground truth.*sample NEW_FOLDER"):
        load_ground_truth(tmp_path)


@pytest.mark.parametrize(
    "text",
    [
        *("", "{", "[]", "{}", f'{{"version": {CAPTURE_VERSION}}}'),
        f'{{"version": {CAPTURE_VERSION}, "ground_m": [0, 1], "light": {{}}}}',
        f'{{"version": {CAPTURE_VERSION}, "ground_m": [0, 1, 2], "light": {{"hue": 1}}}}',
    ],
)
def test_damaged_capture_settings_are_reported(text: str, sample: Path, tmp_path: Path) -> None:
    shutil.copytree(sample / "truth", tmp_path / "truth")
    (tmp_path / "truth" / "capture_settings.json").write_text(text)
    with pytest.raises(UserError, match=r"capture_settings\.json is damaged"):
        load_ground_truth(tmp_path)


@pytest.mark.parametrize("name", ["background", "hand_held_deg", "seed"])
def test_settings_that_lack_an_option_are_damaged(name: str, sample: Path, tmp_path: Path) -> None:
    shutil.copytree(sample / "truth", tmp_path / "truth")
    path = tmp_path / "truth" / "capture_settings.json"
    settings = json.loads(path.read_text()) | {"walk_around": True}
    path.write_text(json.dumps({key: value for key, value in settings.items() if key != name}))
    with pytest.raises(UserError, match=r"capture_settings\.json is damaged"):
        load_ground_truth(tmp_path)


def test_a_capture_of_another_version_names_the_command(sample: Path, tmp_path: Path) -> None:
    shutil.copytree(sample / "truth", tmp_path / "truth")
    path = tmp_path / "truth" / "capture_settings.json"
    settings = json.loads(path.read_text())
    for source, module in (("sample", "sample"), ("gltf", "from_gltf")):
        path.write_text(json.dumps(settings | {"version": 1, "source": source}))
        with pytest.raises(UserError, match=rf"is a capture of version 1, .*python -m data_tools\.{module} {tmp_path}"):
            load_ground_truth(tmp_path)


def test_shortened_video_is_detected(sample: Path, tmp_path: Path) -> None:
    """The remaining frames agree with the ground truth."""
    (tmp_path / "out" / "video").mkdir(parents=True)
    shutil.copytree(sample / "truth", tmp_path / "out" / "truth")
    frames = [frame.rgb for frame in read_frames(open_frame_source(sample / "video"), lambda index: index < 5, 200)]
    write_video(tmp_path / "out" / "video" / "video.mp4", frames, 6.0)
    with pytest.raises(UserError, match="has 5 frames, its ground truth 6"):
        verify_ground_truth(tmp_path / "out", frame_stride=4)


@pytest.mark.parametrize("frame_stride", ["0", "-2"])
def test_frame_stride_below_one_is_an_error(
    frame_stride: str, sample: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert run_command(truth_command, [str(sample), "--frame-stride", frame_stride]) == 2
    assert capsys.readouterr().err.startswith(f"error: --frame-stride {frame_stride}")


def test_joints_project_into_the_masks(sample: Path, capture: SyntheticCapture) -> None:
    body = capture.subject.body
    names = ("Hips", "Spine1", "Neck", "Head", "LeftForeArm", "RightForeArm", "LeftLeg", "RightLeg", "LeftFoot")
    joints = torch.from_numpy(body.joints_m)[[body.joint(name) for name in names]]
    for frame in range(6):
        transforms = capture.canonical_to_world[frame, [body.joint(name) for name in names]]
        world = (transforms[:, :3, :3] @ joints[:, :, None]).squeeze(-1) + transforms[:, :3, 3]
        position_px, _ = project(world, capture.camera)
        column, row = position_px.floor().int().T.numpy()
        assert (load_true_mask(sample, frame)[row, column] > 127).all()


def test_masks_against_ray_casting(sample: Path, capture: SyntheticCapture) -> None:
    """Rays through fully covered pixels hit the surface, rays through uncovered pixels do not."""
    vertices = pose_vertices(capture.subject, capture.canonical_to_world[2]).double().numpy()
    mask = load_true_mask(sample, 2)
    random = np.random.default_rng(0)
    for value in (0, 255):
        rows, columns = np.nonzero(mask == value)
        near = np.flatnonzero((rows > 30) & (rows < 190) & (columns > 60) & (columns < 140))
        chosen = random.choice(near, 25, replace=False)
        pixels = torch.from_numpy(np.stack([columns[chosen], rows[chosen]], axis=1) + 0.5)
        origins, directions = pixel_rays(capture.camera, pixels)
        corners = vertices[capture.subject.body.faces]
        hits = [
            len(ray_triangle_distances(origins[0].numpy(), direction, corners)) > 0 for direction in directions.numpy()
        ]
        assert hits == [value == 255] * 25


def capture_at(capture: SyntheticCapture, factor: float) -> SyntheticCapture:
    """The same scene at a higher resolution, with a bare wall."""
    camera = capture.camera.scaled(factor)
    return replace(capture, camera=camera, room=make_room(camera, capture.ground_m, False, ValueNoise(0)))


@pytest.mark.slow
def test_mediapipe_detects_the_person(capture: SyntheticCapture) -> None:
    """Landmarks and segmentation of the person by mediapipe agree with the ground truth."""
    import mediapipe

    larger = capture_at(capture, 2.0)
    picture, coverage = larger.render_frame(0)
    with mediapipe.solutions.pose.Pose(static_image_mode=True, enable_segmentation=True) as detector:
        found = detector.process(picture)
    assert found.pose_landmarks is not None
    landmarks = np.array([[mark.x, mark.y, mark.visibility] for mark in found.pose_landmarks.landmark])
    assert landmarks[:, 2].min() > 0.5
    body, height = capture.subject.body, len(picture)
    for landmark, joint in ((15, "LeftHand"), (16, "RightHand"), (25, "LeftLeg"), (26, "RightLeg"), (27, "LeftFoot")):
        transform = capture.canonical_to_world[0, body.joint(joint)]
        world = transform[:3, :3] @ torch.from_numpy(body.joints_m[body.joint(joint)]) + transform[:3, 3]
        place_px, _ = project(world[None], larger.camera)
        assert np.linalg.norm(landmarks[landmark, :2] * height - place_px[0].numpy()) < 0.03 * height
    outline = found.segmentation_mask > 0.5
    true = coverage > 127
    assert (outline & true).sum() / (outline | true).sum() > 0.88
