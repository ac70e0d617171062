"""Cutting of meshes: areas of a disc and its complement in closed form, and closed surfaces after zipping."""

import igl
import numpy as np
import pytest

from pipeline.geometry.mesh import Mesh
from pipeline.template.level_set_cut import boundary_loops, cut_mesh, zip_loops


def grid(count: int) -> tuple[np.ndarray, np.ndarray]:
    x, y = np.meshgrid(np.linspace(-1, 1, count), np.linspace(-1, 1, count))
    vertices = np.stack([x.ravel(), y.ravel(), np.zeros(count * count)], axis=1)
    corner = (np.arange(count - 1)[:, None] * count + np.arange(count - 1)).ravel()
    lower = np.stack([corner, corner + 1, corner + count + 1], axis=1)
    upper = np.stack([corner, corner + count + 1, corner + count], axis=1)
    return vertices, np.concatenate([lower, upper])


def angle(points: np.ndarray) -> np.ndarray:
    return np.arctan2(points[:, 1], points[:, 0])


def test_the_parts_have_the_area_of_a_disc_and_its_complement() -> None:
    vertices, faces = grid(41)
    level = np.hypot(*vertices[:, :2].T) - 0.71
    for side, expected in ((level, np.pi * 0.71**2), (-level, 4.0 - np.pi * 0.71**2)):
        part = cut_mesh(faces, side)
        mesh = Mesh(part.interpolate(vertices), part.faces)
        assert mesh.face_areas_m2().sum() == pytest.approx(expected, rel=0.002)
        assert (mesh.face_normals()[:, 2] > 0.9).all()  # the orientation stays


def test_zipped_parts_have_the_area_of_the_whole() -> None:
    coarse, coarse_faces = grid(11)
    fine, fine_faces = grid(53)
    hole = cut_mesh(coarse_faces, 0.7 - np.hypot(*coarse[:, :2].T))
    disc = cut_mesh(fine_faces, np.hypot(*fine[:, :2].T) - 0.6)
    vertices = np.concatenate([hole.interpolate(coarse), disc.interpolate(fine)])
    outer = boundary_loops(hole.boundary[:, ::-1])[0]
    inner = boundary_loops(disc.boundary)[0] + len(hole.edge)
    strip = zip_loops(outer, angle(vertices[outer]), inner, angle(vertices[inner]))
    whole = Mesh(vertices, np.concatenate([hole.faces, disc.faces + len(hole.edge), strip]))
    assert whole.face_areas_m2().sum() == pytest.approx(4.0, rel=0.01)
    assert (whole.face_normals()[:, 2] > 0.9).all()
    loops = igl.boundary_loop(whole.faces.astype(np.int64))
    assert len(loops) == 40  # only the outer border of the coarse grid


def test_open_boundaries_are_refused() -> None:
    with pytest.raises(ValueError, match="simple loops"):
        boundary_loops(np.array([[0, 1], [1, 2]]))
