"""Stage `body` with a user-supplied model file: the same artifacts with the joints of the model."""

from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest
import torch

from pipeline.body.body import load_anny
from pipeline.body.files import load_body, load_camera, load_motion
from pipeline.body.smpl import SmplBody
from pipeline.capture.capture import load_capture
from pipeline.capture.smpl_poses import SmplPoses, save_smpl_poses
from pipeline.core.errors import UserError
from pipeline.core.progress import take_warnings
from pipeline.core.stage import CHECKPOINT_PREFIX
from pipeline.geometry.camera import Camera, transform_world_to_camera
from pipeline.geometry.rotation import quaternion_to_matrix
from pipeline.geometry.skinning import forward_kinematics
from stages.body import STAGE, Config, load_supplied_poses, run
from tests.body.acting import SyntheticRecording, synthetic_recording
from tests.body.smpl_sample import file_contents, sample_arrays, smpl_pose_of
from tests.stages.test_body import FRAMES, write_capture

SPACE = np.array([[0.0, 0.0, 1.0, 0.4], [0.0, -1.0, 0.0, 0.1], [1.0, 0.0, 0.0, 2.0], [0.0, 0.0, 0.0, 1.0]])
"""From the space of the supplied poses to camera axes."""


@pytest.fixture
def model_file(tmp_path):
    path = tmp_path / "SMPL_NEUTRAL.npz"
    np.savez(path, **file_contents(sample_arrays(24)))
    return path


def test_a_model_file_replaces_the_built_in_body(tmp_path, model_file) -> None:
    model = SmplBody(sample_arrays(24))
    scene = synthetic_recording(model, FRAMES, shape={"beta_1": 1.0}, turn_rad=2.0, noise_m=0.005)
    frames, out = tmp_path / "frames", tmp_path / "body"
    out.mkdir()
    write_capture(frames, scene, scene.camera, scene.masks())
    config = Config(model_file=str(model_file), height_m=scene.model.height_m()[0], rounds=2)
    metrics = run({"frames": frames}, out, config)
    written = {path.name for path in out.iterdir()}
    assert {name for name in written if not name.startswith(CHECKPOINT_PREFIX)} == set(STAGE.makes)
    assert metrics["silhouette_iou"] > 0.93
    body, motion = load_body(out / "body.npz"), load_motion(out / "motion.npz")
    assert body.joint_names == model.joint_names
    assert list(body.shape) == [f"beta_{number}" for number in range(10)]
    assert motion.rotations_wxyz.shape == (FRAMES, 24, 4)
    # The stage turns the world upright with its floor at y = 0, so positions are compared in camera axes.
    roots_m = torch.from_numpy(motion.root_translation_m)
    fitted_m = transform_world_to_camera(roots_m, load_camera(out / "camera.npz"))
    true_m = transform_world_to_camera(scene.state.root_m, scene.camera)
    assert (fitted_m - true_m).abs().max() < 0.05


def test_a_missing_model_file_is_refused(tmp_path) -> None:
    model = SmplBody(sample_arrays(24))
    scene = synthetic_recording(model, FRAMES)
    write_capture(tmp_path / "frames", scene, scene.camera, scene.masks())
    with pytest.raises(UserError, match="SMPL_MALE.npz"):
        run({"frames": tmp_path / "frames"}, tmp_path, Config(model_file=str(tmp_path / "SMPL_MALE.npz")))


@pytest.fixture(scope="module")
def scene() -> SyntheticRecording:
    """Return a person with known betas and landmark errors of 2 cm."""
    return synthetic_recording(
        SmplBody(sample_arrays(24)), FRAMES, shape={"beta_0": 1.0, "beta_1": 1.5}, turn_rad=2.0, noise_m=0.02
    )


def true_poses(scene: SyntheticRecording) -> SmplPoses:
    """Return the poses of the scene in SMPL's format, for the frames of `write_capture`."""
    arrays = sample_arrays(24)
    betas = scene.state.shape.float().numpy()
    theta = smpl_pose_of(SmplBody(arrays), scene.model.all_joint_rotations(scene.state.rotations))
    world_to_smpl = np.linalg.inv(SPACE) @ scene.camera.world_to_camera
    root = axis_angle_product(world_to_smpl[:3, :3], theta[:, 0])
    pelvis = arrays.joint_regressor[0] @ (arrays.template_m + arrays.shape_directions_m @ betas)
    place = scene.state.root_m.numpy() @ world_to_smpl[:3, :3].T + world_to_smpl[:3, 3] - pelvis
    return SmplPoses(
        frame_index=3 * np.arange(FRAMES, dtype=np.int32),
        global_orient=root,
        body_pose=theta[:, 1:].reshape(FRAMES, 69),
        transl=place.astype(np.float32),
        betas=np.tile(betas, (FRAMES, 1)),
        smpl_to_camera=np.tile(SPACE.astype(np.float32), (FRAMES, 1, 1)),
        gender="neutral",
    )


def axis_angle_product(matrix: np.ndarray, axis_angle: np.ndarray) -> np.ndarray:
    """Return matrix @ exp(axis_angle) as axis-angle."""
    turned = [cv2.Rodrigues(matrix @ cv2.Rodrigues(vector.astype(np.float64))[0])[0][:, 0] for vector in axis_angle]
    return np.stack(turned).astype(np.float32)


def errors_m(out: Path, scene: SyntheticRecording) -> np.ndarray:
    """Return the mean joint error of each frame."""
    body, motion = load_body(out / "body.npz"), load_motion(out / "motion.npz")
    joint_to_world = forward_kinematics(
        quaternion_to_matrix(torch.tensor(motion.rotations_wxyz)),
        torch.tensor(motion.root_translation_m),
        torch.tensor(body.joints_m),
        body.parents,
    )
    found = joint_to_world[:, list(scene.model.full_joint_indices), :3, 3].double()
    return (found - scene.joints_m()).norm(dim=-1).mean(1).numpy()


def fitted(
    folder: Path, scene: SyntheticRecording, poses: SmplPoses, camera: Camera | None, **options: object
) -> tuple[Path, dict[str, float]]:
    """Run the stage on a capture with these poses; return its folder and metrics."""
    frames, out = folder / "frames", folder / "body"
    out.mkdir()
    write_capture(frames, scene, camera, scene.masks())
    save_smpl_poses(frames / "smpl_poses.npz", poses)
    return out, dict(run({"frames": frames}, out, Config(rounds=1, **options)))


def test_supplied_poses_are_kept(tmp_path, model_file, scene: SyntheticRecording) -> None:
    """Landmark errors of 2 cm have no effect; the shape is that of the file."""
    out, metrics = fitted(tmp_path, scene, true_poses(scene), scene.camera, model_file=str(model_file))
    assert errors_m(out, scene).max() < 1e-4
    assert metrics["silhouette_iou"] > 0.98
    assert list(load_body(out / "body.npz").shape.values()) == pytest.approx(scene.state.shape.tolist(), abs=1e-5)
    assert take_warnings() == []


def test_frames_without_a_supplied_pose_are_fitted(tmp_path, model_file, scene: SyntheticRecording) -> None:
    """The first frame is before all supplied poses, the third between two of them."""
    missing = np.isin(np.arange(FRAMES), [0, 2])
    poses = true_poses(scene).for_frames(3 * np.flatnonzero(~missing))
    out, _ = fitted(tmp_path, scene, poses, scene.camera, model_file=str(model_file))
    errors = errors_m(out, scene)
    assert errors[~missing].max() < 1e-4
    assert 1e-4 < errors[missing].max() < 0.06


@pytest.mark.slow
def test_supplied_poses_are_refined(tmp_path, model_file, scene: SyntheticRecording) -> None:
    """Poses with errors of 5 cm and bent joints are refined; the shape is that of the file."""
    true = true_poses(scene)
    random = np.random.default_rng(0)
    bent = true.body_pose + random.normal(0.0, 0.05, true.body_pose.shape).astype(np.float32)
    wrong = replace(true, body_pose=bent, transl=true.transl + np.float32(0.03))
    (tmp_path / "kept").mkdir()
    kept, _ = fitted(tmp_path / "kept", scene, wrong, scene.camera, model_file=str(model_file))
    out, _ = fitted(tmp_path, scene, wrong, scene.camera, model_file=str(model_file), supplied_poses="start")
    assert errors_m(kept, scene).mean() > 0.05
    assert errors_m(out, scene).mean() < 0.025
    assert list(load_body(out / "body.npz").shape.values()) == pytest.approx(scene.state.shape.tolist(), abs=1e-5)


@pytest.mark.parametrize(
    ("joints", "knows_camera", "frames", "expected"),
    [
        (0, True, slice(None), "an SMPL or SMPL-H model file (neutral); add --set body.model_file"),
        (55, True, slice(None), "an SMPL or SMPL-H model file"),
        (24, False, slice(None), "supply camera.json"),
        (24, True, slice(0), "no pose of a selected frame"),
    ],
)
def test_unusable_supplied_poses_are_reported(
    tmp_path, scene: SyntheticRecording, joints: int, knows_camera: bool, frames: slice, expected: str
) -> None:
    model = SmplBody(sample_arrays(joints)) if joints else load_anny()
    write_capture(tmp_path / "frames", scene, scene.camera, [])
    poses = true_poses(scene)
    take_warnings()
    capture = replace(load_capture(tmp_path / "frames"), smpl_poses=poses.for_frames(poses.frame_index[frames]))
    assert load_supplied_poses(capture, model, scene.camera, knows_camera, Config()) is None
    (warning,) = take_warnings()
    assert "smpl_poses.npz is not used" in warning
    assert expected in warning
    assert load_supplied_poses(capture, model, scene.camera, knows_camera, Config(supplied_poses="ignore")) is None
    assert take_warnings() == []


def test_misplaced_poses_are_refused_with_a_remedy(tmp_path, model_file, scene: SyntheticRecording) -> None:
    poses = true_poses(scene)
    misplaced = replace(poses, transl=poses.transl + np.float32(0.5))
    with pytest.raises(UserError, match=r"does not fit the person .* body.supplied_poses=start, or lower"):
        fitted(tmp_path, scene, misplaced, scene.camera, model_file=str(model_file))
