"""Skin and hair of the head: by place on the body model's head, and by the distance from it."""

import numpy as np
import pytest
import torch
import trimesh
from torch import Tensor

from pipeline.body.body import AnnyBody, Body
from pipeline.geometry.mesh import Mesh
from pipeline.mesh.extraction.fairing import fair_surface
from pipeline.mesh.extraction.isosurface import extract_mesh, sample_canonical_grid
from pipeline.mesh.face import face_weight, head_skin_weight, head_vertices, is_ear
from pipeline.mesh.remeshing import detailed_faces, face_of_person
from pipeline.mesh.settings import MeshSettings
from tests.mesh.capsule import capsule_body
from tests.mesh.full_evidence import full_evidence

HEAD_M, HAIR_M = 0.11, 0.035


@pytest.fixture(scope="module")
def person() -> Body:
    model = AnnyBody()
    return model.at_shape(model.shape_defaults)


def landmarks_m(*names: str) -> np.ndarray:
    return np.array([AnnyBody().landmark_positions_m[name] for name in names])


def test_ears_are_detailed_where_they_are_seen(person: Body) -> None:
    """The outermost points of the head are ears; hair that covers them has long edges."""
    head = person.vertices[head_vertices(person)]
    outermost = head[np.argsort(-np.abs(head[:, 0]))[:100]]
    assert is_ear(outermost, person).all()
    crown_m = head[head[:, 1].argmax()][None]
    assert not is_ear(np.concatenate([landmarks_m("face_nose", "face_mouth"), crown_m]), person).any()
    assert not is_ear(outermost, capsule_body()).any()
    mesh = person.mesh()
    at_ear = is_ear(mesh.vertices[mesh.faces].mean(axis=1), person)
    assert detailed_faces(mesh, person)[at_ear].all()
    covered = Mesh((mesh.vertices + HAIR_M * mesh.vertex_normals()).astype(np.float32), mesh.faces)
    centres_m = covered.vertices[covered.faces].mean(axis=1)
    behind = is_ear(centres_m, person) & at_ear & (mesh.vertices[mesh.faces].mean(axis=1)[:, 2] < 0.03)
    assert behind.sum() > 10
    assert detailed_faces(covered, person)[behind].mean() < 0.4


def test_the_features_are_face_at_any_distance_and_hair_is_not(person: Body) -> None:
    features_m = landmarks_m("face_nose", "face_eye_inner", "face_mouth")
    assert face_weight(features_m, np.full(3, HAIR_M), person).min() > 0.95
    crown_m = person.vertices[person.vertices[:, 1].argmax()][None].astype(np.float64)
    back_m = crown_m + [[0.0, -0.09, -0.1]]
    for point_m in (crown_m, back_m):
        assert head_skin_weight(point_m, np.zeros(1), person)[0] == 1.0
        assert head_skin_weight(point_m, np.full(1, HAIR_M), person)[0] == 0.0
    assert face_weight(back_m, np.zeros(1), person)[0] == 0.0


def test_the_rest_of_the_body_is_neither(person: Body) -> None:
    points_m = landmarks_m("shoulder", "hip", "wrist", "heel")
    assert not face_weight(points_m, np.zeros(4), person).any()
    assert not head_skin_weight(points_m, np.zeros(4), person).any()


def test_a_body_without_a_head_has_no_face() -> None:
    headless = capsule_body()
    assert not head_vertices(headless).any()
    assert not face_weight(np.zeros((3, 3)), np.zeros(3), headless).any()


def ball_head() -> Body:
    """A head alone: a ball of radius `HEAD_M` around the origin."""
    mesh = trimesh.creation.icosphere(subdivisions=4, radius=HEAD_M)
    return Body(
        joint_names=("Head",),
        parents=np.array([-1], dtype=np.int32),
        joints_m=np.zeros((1, 3), dtype=np.float32),
        vertices=np.asarray(mesh.vertices, dtype=np.float32),
        faces=np.asarray(mesh.faces, dtype=np.int32),
        skin_weights=np.ones((len(mesh.vertices), 1), dtype=np.float32),
        shape={},
    )


def hairy_density(points: Tensor) -> Tensor:
    """Density of the ball with hair of 3.5 cm on its upper half and with bumps of 4 mm, 4 cm long."""
    points_m = points.numpy().astype(np.float64)
    hair_m = np.where(points_m[:, 1] > 0.05, HAIR_M, 0.0)
    bumps_m = 0.004 * np.sin(points_m * (2.0 * np.pi / 0.04)).prod(axis=1)
    depth_m = HEAD_M + hair_m + bumps_m - np.linalg.norm(points_m, axis=1)
    return torch.from_numpy(100.0 * np.exp(np.clip(depth_m / 0.003, -20.0, 20.0))).float()


def test_fairing_keeps_hair_over_the_forehead_and_smooths_the_face() -> None:
    head, settings = ball_head(), MeshSettings(hands_from_body=False)
    bounds_m = np.array([[-1.0, -1.0, -1.0], [1.0, 1.0, 1.0]]) * (HEAD_M + HAIR_M + 0.02)
    samples = sample_canonical_grid(hairy_density, bounds_m, head, 0.006, settings)
    rough = extract_mesh(samples, 100.0, settings)
    fair = fair_surface(rough, samples, head, head.mesh(), full_evidence(head), settings)
    offset_m = np.linalg.norm(fair.vertices, axis=1) - HEAD_M
    x, y, z = fair.vertices.T
    assert np.median(offset_m[(z > 0.03) & (y > 0.08)]) == pytest.approx(HAIR_M, abs=0.006)
    features = (z > 0.06) & (np.abs(x) < 0.03) & (y > -0.05) & (y < 0.0)
    assert features.any()
    assert offset_m[features].std() < 0.001


def test_the_stiff_face_has_no_hair() -> None:
    head = ball_head()
    mesh = head.mesh()
    upper = mesh.vertices[:, 1] > 0.05
    hairy = Mesh(np.where(upper[:, None], (1.0 + HAIR_M / HEAD_M) * mesh.vertices, mesh.vertices), mesh.faces)
    assert face_of_person(mesh, head)[upper[mesh.faces].all(axis=1)].mean() > 0.3
    face = face_of_person(hairy, head)
    assert face.any()
    assert not face[upper[mesh.faces].all(axis=1)].any()
