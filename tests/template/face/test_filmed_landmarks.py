"""Landmarks of the face from frames: on a generated person whose landmarks are known, and against those of renders."""

import numpy as np
import pytest
import torch

from pipeline.geometry.camera import Camera, project
from pipeline.geometry.mesh import Mesh
from pipeline.geometry.rotation import axis_angle_to_matrix
from pipeline.geometry.skinning import rigid_transform
from pipeline.template.face.filmed_landmarks import MIN_FRAMES, FilmedFaces
from pipeline.template.face.landmarks import (
    LANDMARK_NUMBERS,
    LANDMARK_VERTICES,
    MAX_DISAGREEMENT_M,
    MAX_RESIDUAL_M,
    choose_landmarks,
)
from pipeline.template.regions import load_template
from tests.template.generated_person import generated_person

FRAMES = 9
CAMERA = Camera(1500.0, 1500.0, 320.0, 320.0, 640, 640)
NOISE_PX = 1.0


def closed_head() -> Mesh:
    """The surface of the head with closed eyes and mouth, as on a captured person."""
    person, template = generated_person(), load_template()
    eyes = np.any([*template.socket_faces, *template.eye_faces], axis=0)
    faces = person.all_faces[np.repeat(template.skin_faces | template.mouth_faces | eyes, 4)]
    return Mesh(person.surface.vertices, faces[(person.surface.vertices[faces, 1] > 1.4).all(axis=1)])


def true_landmarks_m() -> np.ndarray:
    return generated_person().template_m[LANDMARK_VERTICES]


def filmed_faces(frames: int, wrong_px: float = 0.0) -> FilmedFaces:
    """A person at 3 m who turns by 30° to both sides; in every third frame the detections are off by `wrong_px`."""
    person = generated_person()
    yaw_rad = torch.linspace(-0.5, 0.5, frames)
    turn = axis_angle_to_matrix(torch.stack([0.1 * yaw_rad, yaw_rad, 0.05 * yaw_rad], dim=1))
    head_m = torch.from_numpy(true_landmarks_m().mean(axis=0)).float()
    transforms = rigid_transform(turn, torch.tensor([0.0, 0.0, -3.0]) - turn @ head_m)
    rng = np.random.default_rng(0)
    faces_px = np.full((frames, 478, 2), np.nan, np.float32)
    points_m = torch.from_numpy(true_landmarks_m()).float()
    for frame, transform in enumerate(transforms):
        at_px, _ = project(points_m @ transform[:3, :3].T + transform[:3, 3], CAMERA)
        noise_px = NOISE_PX * rng.standard_normal(at_px.shape)
        faces_px[frame, LANDMARK_NUMBERS] = at_px.numpy() + noise_px + (wrong_px if frame % 3 == 0 else 0.0)
    joints = len(person.fitted.joint_names)
    return FilmedFaces(faces_px, transforms[:, None].expand(-1, joints, -1, -1), CAMERA)


@pytest.mark.parametrize("wrong_px", [0.0, 40.0])
def test_landmarks_are_found_on_the_surface(wrong_px: float) -> None:
    """One pixel is 2 mm; a third of the frames may be wrong by 8 cm. Corners of eyes and mouth lie in folds."""
    person = generated_person()
    found = filmed_faces(FRAMES, wrong_px).on_surface(closed_head(), person.fitted)
    assert found is not None
    error_m = found - true_landmarks_m()
    assert np.median(np.linalg.norm(error_m, axis=1)) < 0.004
    assert np.quantile(np.linalg.norm(error_m[:, :2], axis=1), 0.9) < 0.006  # seen from in front


def test_few_frames_tell_nothing() -> None:
    person = generated_person()
    assert filmed_faces(MIN_FRAMES - 1).on_surface(closed_head(), person.fitted) is None


def test_rays_that_miss_the_head_tell_nothing() -> None:
    person, faces = generated_person(), filmed_faces(FRAMES)
    beside = FilmedFaces(faces.faces_px + 300.0, faces.canonical_to_world, CAMERA)
    assert beside.on_surface(closed_head(), person.fitted) is None


def test_frames_are_believed_where_renders_disagree() -> None:
    person, true_m = generated_person(), true_landmarks_m()
    near_m, far_m = (true_m + [0.0, share * MAX_DISAGREEMENT_M, 0.0] for share in (0.9, 1.1))
    for rendered_m, expected_m in ((near_m, near_m), (far_m, true_m), (None, true_m)):
        chosen = choose_landmarks(person.bare, rendered_m, true_m)
        assert chosen is not None
        np.testing.assert_array_equal(chosen.positions_m, expected_m)


def test_landmarks_that_are_no_face_are_not_used() -> None:
    person, true_m = generated_person(), true_landmarks_m()
    rng = np.random.default_rng(1)
    scattered_m = true_m + 3.0 * MAX_RESIDUAL_M * rng.standard_normal(true_m.shape)
    chosen = choose_landmarks(person.bare, scattered_m, true_m)
    assert chosen is not None
    np.testing.assert_array_equal(chosen.positions_m, true_m)
    assert choose_landmarks(person.bare, scattered_m, None) is None
    assert choose_landmarks(person.bare, scattered_m, scattered_m) is None


def test_another_face_is_not_used() -> None:
    """A print on the clothes, or hair that looks like a face: half as large, turned, or beside the person's."""
    person, true_m = generated_person(), true_landmarks_m()
    centre_m = true_m.mean(axis=0)
    turn = np.array([[0.0, -1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, 1.0]])
    others = (0.6 * (true_m - centre_m), 1.6 * (true_m - centre_m), (true_m - centre_m) @ turn.T)
    for other_m in (*(part + centre_m for part in others), true_m + [0.0, 0.06, 0.0]):
        assert choose_landmarks(person.bare, other_m, None) is None
        chosen = choose_landmarks(person.bare, other_m, true_m)
        assert chosen is not None
        np.testing.assert_array_equal(chosen.positions_m, true_m)
