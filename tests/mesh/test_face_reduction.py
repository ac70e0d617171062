"""Reduction of faces: as far as the images allow, close to the surface, and closed."""

import numpy as np
import pytest

from pipeline.geometry.mesh import Mesh
from pipeline.geometry.surface import closest_points_on_mesh, is_closed_manifold, isosurface
from pipeline.mesh.face_reduction import MAX_SHARES, reduce_faces
from pipeline.mesh.remeshing import DETAILED, FREE, HEAD
from pipeline.mesh.settings import MeshSettings

RADIUS_M, SPACING_M = 0.1, 0.01


def sphere() -> Mesh:
    axis = np.arange(-0.13, 0.1301, SPACING_M)
    distance = np.linalg.norm(np.stack(np.meshgrid(axis, axis, axis, indexing="ij"), axis=-1), axis=-1)
    return isosurface(RADIUS_M - distance, 0.0, np.full(3, axis[0]), SPACING_M)


def no_detail(mesh: Mesh) -> np.ndarray:
    return np.full(len(mesh.faces), FREE)


def test_detailed_faces_stay() -> None:
    mesh = sphere()
    detailed = mesh.vertices[mesh.faces].mean(axis=1)[:, 1] > 0.0
    reduced = reduce_faces(mesh, np.where(detailed, DETAILED, FREE), lambda trial: 30.0, MeshSettings())
    above = reduced.vertices[reduced.faces].mean(axis=1)[:, 1] > 0.0
    assert above.sum() >= 0.97 * detailed.sum()
    assert (~above).sum() < 0.3 * (~detailed).sum()


def test_faces_are_removed_while_the_loss_is_small() -> None:
    mesh = sphere()
    # One dB for each thousand faces that are missing.
    psnr_db, settings = lambda trial: len(trial.faces) / 1000.0, MeshSettings(max_reduction_loss_db=2.5)
    reduced = reduce_faces(mesh, no_detail(mesh), psnr_db, settings)
    assert len(mesh.faces) - 2500 <= len(reduced.faces) < len(mesh.faces) - 1000
    assert is_closed_manifold(reduced)


def test_the_surface_stays_where_it_was() -> None:
    mesh = sphere()
    reduced = reduce_faces(mesh, no_detail(mesh), lambda trial: 30.0, MeshSettings())
    assert len(reduced.faces) < 0.2 * len(mesh.faces)
    distance_m, _, _ = closest_points_on_mesh(mesh.vertices, reduced)
    assert distance_m.max() < 0.002
    radial = reduced.vertices[reduced.faces].mean(axis=1)
    radial /= np.linalg.norm(radial, axis=1, keepdims=True)
    assert np.sum(reduced.face_normals() * radial, axis=1).min() > 0.95


def test_a_mesh_that_needs_its_faces_stays() -> None:
    mesh = sphere()
    count = len(mesh.faces)
    assert reduce_faces(mesh, no_detail(mesh), lambda trial: -abs(len(trial.faces) - count), MeshSettings()) is mesh


def test_a_limit_holds_at_any_loss_and_only_where_it_is_exceeded() -> None:
    mesh = sphere()
    limit = len(mesh.faces) // 3
    psnr_db = lambda trial: float(len(trial.faces))  # noqa: E731
    assert reduce_faces(mesh, no_detail(mesh), psnr_db, MeshSettings(), len(mesh.faces)) is mesh
    reduced = reduce_faces(mesh, no_detail(mesh), psnr_db, MeshSettings(), limit)
    assert limit - 6 <= len(reduced.faces) <= limit
    assert is_closed_manifold(reduced)


def test_a_limit_holds_where_most_faces_are_detailed() -> None:
    mesh = sphere()
    detailed, limit = np.ones(len(mesh.faces), dtype=bool), len(mesh.faces) // 3
    detailed[:10] = False
    assert (
        len(reduce_faces(mesh, np.where(detailed, DETAILED, FREE), lambda trial: 30.0, MeshSettings(), limit).faces)
        <= limit
    )


@pytest.mark.parametrize("part", [DETAILED, HEAD])
def test_a_part_with_more_faces_than_its_share_is_collapsed_to_it(part: int) -> None:
    """An eighth of the sphere has the share of its part afterwards, not that of its area."""
    mesh = sphere()
    octant = (mesh.vertices[mesh.faces].mean(axis=1) > 0.0).all(axis=1)
    limit = int(octant.sum() / 0.5)
    assert octant.sum() > MAX_SHARES[part] * limit
    reduced = reduce_faces(
        mesh, np.where(octant, part, FREE), lambda trial: float(len(trial.faces)), MeshSettings(), limit
    )
    kept = (reduced.vertices[reduced.faces].mean(axis=1) > 0.0).all(axis=1)
    assert limit - 6 <= len(reduced.faces) <= limit
    assert np.count_nonzero(kept) == pytest.approx(MAX_SHARES[part] * limit, rel=0.05)
    assert is_closed_manifold(reduced)


def test_the_head_stays_round_while_the_rest_is_reduced() -> None:
    mesh = sphere()
    above = mesh.vertices[mesh.faces].mean(axis=1)[:, 1] > 0.05
    limit = int(above.sum() / MAX_SHARES[HEAD])
    reduced = reduce_faces(mesh, np.where(above, HEAD, FREE), lambda trial: 30.0, MeshSettings(), limit)
    still_above = reduced.vertices[reduced.faces].mean(axis=1)[:, 1] > 0.05
    assert still_above.sum() >= 0.97 * above.sum()
    assert len(reduced.faces) < 0.4 * len(mesh.faces)


def test_a_number_of_final_faces_is_reached_at_any_loss() -> None:
    mesh = sphere()
    settings, wanted = MeshSettings(final_faces=len(mesh.faces) // 3), len(mesh.faces) // 3
    reduced = reduce_faces(mesh, no_detail(mesh), lambda trial: float(len(trial.faces)), settings)
    assert abs(len(reduced.faces) - wanted) <= 2
    assert is_closed_manifold(reduced)
    settings = MeshSettings(final_faces=len(mesh.faces))
    assert reduce_faces(mesh, no_detail(mesh), lambda trial: 30.0, settings) is mesh


def test_detail_keeps_what_the_rest_leaves_of_a_limit() -> None:
    """A mesh just above the limit, half of whose faces are detailed, is not reduced far below it."""
    mesh = sphere()
    detailed = mesh.vertices[mesh.faces].mean(axis=1)[:, 1] > 0.0
    wanted = len(mesh.faces) - 100
    reduced = reduce_faces(
        mesh, np.where(detailed, DETAILED, FREE), lambda trial: 0.0, MeshSettings(final_faces=wanted)
    )
    assert wanted - 4 <= len(reduced.faces) <= wanted


def test_a_limit_that_costs_more_is_judged_once_and_a_cheap_one_is_passed() -> None:
    mesh, judged = sphere(), []
    limit = len(mesh.faces) // 3

    def psnr_db(trial: Mesh) -> float:
        judged.append(len(trial.faces))
        return len(trial.faces) / 1000.0

    reduced = reduce_faces(mesh, no_detail(mesh), psnr_db, MeshSettings(max_reduction_loss_db=0.05), limit)
    assert judged == [len(mesh.faces), len(reduced.faces)]
    cheap = reduce_faces(mesh, no_detail(mesh), lambda trial: 30.0, MeshSettings(), limit)
    assert len(cheap.faces) < 0.8 * limit
