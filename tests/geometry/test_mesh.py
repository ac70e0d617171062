"""Mesh quantities against trimesh and closed forms."""

import numpy as np
import torch
import trimesh

from pipeline.geometry.mesh import Mesh, area_weighted_vertex_normals


def sphere() -> tuple[Mesh, trimesh.Trimesh]:
    truth = trimesh.creation.icosphere(subdivisions=3)
    return Mesh(truth.vertices.astype(np.float32), truth.faces.astype(np.int32)), truth


def test_normals_and_areas_agree_with_trimesh() -> None:
    mesh, truth = sphere()
    np.testing.assert_allclose(mesh.face_normals(), truth.face_normals, atol=1e-5)
    np.testing.assert_allclose(mesh.face_areas_m2(), truth.area_faces, rtol=1e-5)
    np.testing.assert_allclose(mesh.vertex_normals(), mesh.vertices, atol=0.02)  # a unit sphere


def test_edges_agree_with_trimesh_and_eulers_formula() -> None:
    mesh, truth = sphere()
    assert len(mesh.vertices) - len(mesh.edges()) + len(mesh.faces) == 2
    assert len(mesh.edges()) == len(truth.edges_unique)
    half_edges = np.concatenate([mesh.faces[:, [0, 1]], mesh.faces[:, [1, 2]], mesh.faces[:, [2, 0]]])
    expected, counts = np.unique(np.sort(half_edges, axis=1), axis=0, return_counts=True)
    np.testing.assert_array_equal(mesh.edges(), expected)
    assert (counts == 2).all()


def test_tensor_normals_agree_with_array_normals() -> None:
    mesh, _ = sphere()
    normals = area_weighted_vertex_normals(torch.from_numpy(mesh.vertices), torch.from_numpy(mesh.faces))
    np.testing.assert_allclose(normals.numpy(), mesh.vertex_normals(), atol=1e-6)


def test_watertight_means_closed_and_consistently_wound() -> None:
    mesh, _ = sphere()
    assert mesh.is_watertight()
    assert not Mesh(mesh.vertices, mesh.faces[1:]).is_watertight()
    flipped = mesh.faces.copy()
    flipped[0] = flipped[0, ::-1]
    assert not Mesh(mesh.vertices, flipped).is_watertight()
    assert not Mesh(mesh.vertices, np.concatenate([mesh.faces, mesh.faces[:1]])).is_watertight()
