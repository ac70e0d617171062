"""Folds: copies of their vertices have the normals of their sides, in the atlas, the skinned mesh and the .obj."""

from pathlib import Path

import numpy as np
import trimesh

from pipeline.avatar.obj import ObjMaps, write_obj
from pipeline.avatar.skinned_avatar import build_skinned_mesh
from pipeline.geometry.creases import find_creases
from pipeline.geometry.mesh import Mesh
from pipeline.geometry.surface_cut import cut_at_borders
from tests.geometry.wedge import one_chart, sheet_faces, skinned, wedge, worst_cosine


def test_a_wedge_is_closed() -> None:
    assert wedge().is_watertight()
    assert len(sheet_faces(wedge())) > 10


def test_each_side_of_a_fold_has_its_normal() -> None:
    mesh = wedge()
    creases = find_creases(mesh)
    split = Mesh(mesh.vertices[creases.source], creases.faces)
    np.testing.assert_array_equal(creases.source[creases.faces], mesh.faces)
    np.testing.assert_array_equal(creases.source[: len(mesh.vertices)], np.arange(len(mesh.vertices)))
    inner = sheet_faces(mesh)
    assert worst_cosine(mesh, mesh.vertex_normals()[mesh.faces], inner) < 0.5
    assert worst_cosine(mesh, split.vertex_normals()[split.faces], inner) > 0.7
    edge = np.flatnonzero((mesh.vertices[:, 1] == 0.0) & (np.abs(mesh.vertices[:, 0] - 0.5) < 0.5))
    copied = np.unique(creases.source[len(mesh.vertices) :])
    assert set(copied) >= set(edge)
    assert set(mesh.vertices[copied, 1].tolist()) == {0.0, 1.0}
    np.testing.assert_array_equal(np.flatnonzero(creases.on_fold())[: len(copied)], copied)


def test_a_mesh_without_its_copies_is_the_one_before() -> None:
    mesh = wedge()
    creases = find_creases(mesh)
    assert len(creases.source) > len(mesh.vertices)
    joined = creases.join(mesh.vertices[creases.source])
    np.testing.assert_array_equal(joined.vertices, mesh.vertices)
    np.testing.assert_array_equal(joined.faces, mesh.faces)


def test_a_smooth_surface_and_faces_without_area_have_no_folds() -> None:
    ball = trimesh.creation.icosphere(subdivisions=1)
    mesh = Mesh(np.asarray(ball.vertices), np.asarray(ball.faces))
    assert len(find_creases(mesh).source) == len(mesh.vertices)
    a, b, c = mesh.faces[0]
    count = len(mesh.vertices)
    middle = 0.5 * (mesh.vertices[a] + mesh.vertices[b])  # a face of no area between the first one and its neighbour
    thin = Mesh(
        np.concatenate([mesh.vertices, middle[None]]),
        np.concatenate([mesh.faces[1:], [[a, count, c], [count, b, c], [b, count, a]]]),
    )
    assert thin.is_watertight()
    assert len(find_creases(thin).source) == len(thin.vertices)


def test_the_atlas_of_a_split_mesh_shows_the_same_places() -> None:
    mesh = wedge()
    creases, atlas = find_creases(mesh), one_chart(mesh)
    layout = creases.split_atlas(atlas)
    np.testing.assert_array_equal(layout.uv[layout.faces_uv], atlas.uv[atlas.faces_uv])
    np.testing.assert_array_equal(layout.vertex_of_uv[layout.faces_uv], creases.faces)
    assert len(layout.uv) == len(creases.source)


def test_the_exported_mesh_has_both_normals_and_one_skin() -> None:
    mesh = wedge()
    before = skinned(mesh)
    cut, _ = cut_at_borders(mesh, lambda points: (points[:, 0] > 0.3).astype(int))
    whole = before.cut(cut)
    creases = find_creases(whole.mesh)
    split, layout = whole.split(creases), creases.split_atlas(one_chart(whole.mesh))
    exported = build_skinned_mesh(split, layout)
    inner = sheet_faces(whole.mesh)
    assert worst_cosine(whole.mesh, whole.vertex_normals()[whole.mesh.faces], inner) < 0.5
    assert worst_cosine(whole.mesh, exported.normals[exported.faces], inner) > 0.7
    np.testing.assert_array_equal(exported.positions_m[exported.faces], whole.mesh.vertices[whole.mesh.faces])
    np.testing.assert_array_equal(exported.joint_weights[exported.faces], whole.joint_weights[whole.mesh.faces])
    np.testing.assert_array_equal(split.vertex_colours[split.mesh.faces], whole.vertex_colours[whole.mesh.faces])
    smooth = ~creases.on_fold()[: len(mesh.vertices)]
    np.testing.assert_allclose(
        split.vertex_normals()[: len(mesh.vertices)][smooth], before.vertex_normals()[smooth], atol=1e-6
    )


def test_the_obj_stays_closed_and_has_both_normals(tmp_path: Path) -> None:
    mesh = wedge()
    creases, atlas = find_creases(mesh), one_chart(mesh)
    normals = skinned(mesh).split(creases).vertex_normals()
    write_obj(tmp_path / "a.obj", mesh, atlas.uv, atlas.faces_uv, normals, ObjMaps("a.png"), creases.faces)
    lines = [line.split() for line in (tmp_path / "a.obj").read_text().splitlines()]
    corners = np.array([[part.split("/") for part in line[1:]] for line in lines if line[0] == "f"], dtype=int) - 1
    np.testing.assert_array_equal(corners[..., 0], mesh.faces)
    written = np.array([line[1:] for line in lines if line[0] == "vn"], dtype=float)
    assert worst_cosine(mesh, written[corners[..., 2]], sheet_faces(mesh)) > 0.7


def test_a_cut_surface_without_folds_keeps_the_normals_from_before_the_cut() -> None:
    ball = trimesh.creation.icosphere(subdivisions=2)
    before = skinned(Mesh(np.asarray(ball.vertices), np.asarray(ball.faces)))
    cut, _ = cut_at_borders(before.mesh, lambda points: (points[:, 0] > 0.1).astype(int))
    whole = before.cut(cut)
    split = whole.split(find_creases(whole.mesh))
    assert np.abs(split.mesh.vertex_normals() - whole.vertex_normals()).max() > 0.02
    np.testing.assert_array_equal(split.vertex_normals(), whole.vertex_normals())
