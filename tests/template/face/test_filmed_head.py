"""The face of the fitted body moves to where frames show it, on a generated person with a wrong shape."""

from dataclasses import replace

import numpy as np

from pipeline.mesh.face import head_vertices
from pipeline.template.face.filmed_head import move_face_to_frames
from pipeline.template.face.filmed_landmarks import MIN_FRAMES
from pipeline.template.face.landmarks import LANDMARK_VERTICES
from tests.template.face.test_filmed_landmarks import FRAMES, filmed_faces
from tests.template.generated_person import generated_person

SHIFT_M = np.array([0.006, 0.012, 0.0], np.float32)


def face_error_mm(vertices: np.ndarray) -> np.ndarray:
    """Distances from the true landmarks, seen from in front."""
    true_m = generated_person().template_m[LANDMARK_VERTICES]
    return 1e3 * np.linalg.norm((vertices[LANDMARK_VERTICES] - true_m)[:, :2], axis=1)


def test_a_face_that_is_too_high_moves_down() -> None:
    """Noise of a pixel, 2 mm, in nine frames; the depth of the face stays."""
    bare = generated_person().bare
    wrong = replace(bare, vertices=bare.vertices + np.where(head_vertices(bare)[:, None], SHIFT_M, 0.0))
    moved = move_face_to_frames(wrong, filmed_faces(FRAMES))
    assert np.median(face_error_mm(wrong.vertices)) > 12.0
    assert np.median(face_error_mm(moved.vertices)) < 2.0
    np.testing.assert_array_equal(moved.vertices[:, 2], wrong.vertices[:, 2])


def test_a_face_of_another_shape_comes_nearer() -> None:
    fitted = generated_person().fitted
    moved = move_face_to_frames(fitted, filmed_faces(FRAMES))
    assert np.median(face_error_mm(moved.vertices)) < 0.3 * np.median(face_error_mm(fitted.vertices))


def test_a_right_face_stays() -> None:
    bare = generated_person().bare
    moved = move_face_to_frames(bare, filmed_faces(FRAMES))
    assert np.abs(moved.vertices - bare.vertices).max() < 0.002


def test_only_the_face_moves() -> None:
    fitted = generated_person().fitted
    moved = move_face_to_frames(fitted, filmed_faces(FRAMES))
    head = head_vertices(fitted)
    back = fitted.vertices[:, 2] < 0.5 * (fitted.vertices[head, 2].min() + fitted.vertices[head, 2].max())
    hands = fitted.vertices[:, 1] < fitted.vertices[head, 1].min() - 0.1
    assert np.linalg.norm(moved.vertices - fitted.vertices, axis=1).max() > 0.005
    np.testing.assert_array_equal(moved.vertices[back | hands], fitted.vertices[back | hands])


def test_without_evidence_the_body_is_returned_as_it_is() -> None:
    person = generated_person()
    assert move_face_to_frames(person.fitted, filmed_faces(MIN_FRAMES - 1)) is person.fitted
    rng = np.random.default_rng(0)
    faces = filmed_faces(FRAMES)
    scattered = replace(faces, faces_px=faces.faces_px + 20.0 * rng.standard_normal((1, 478, 2)).astype(np.float32))
    assert move_face_to_frames(person.fitted, scattered) is person.fitted
    other = replace(person.fitted, faces=person.fitted.faces[:-1])
    assert move_face_to_frames(other, faces) is other
