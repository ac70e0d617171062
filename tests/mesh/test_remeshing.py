"""Remeshing to an edge length and to the image error; steps that would leave holes are skipped with a warning."""

from dataclasses import replace

import numpy as np
import pytest

from pipeline.core.progress import take_warnings
from pipeline.geometry.mesh import Mesh
from pipeline.geometry.surface import OpenSurfaceError, is_closed_manifold, subdivide
from pipeline.mesh import remeshing as remeshing_module
from pipeline.mesh.extraction.isosurface import extract_mesh, sample_canonical_grid
from pipeline.mesh.remeshing import remesh_adaptively, remesh_to_edge_length, remesh_uniformly
from tests.mesh import capsule
from tests.mesh.egg import EDGE_M, SETTINGS


@pytest.fixture(scope="module")
def extracted() -> Mesh:
    samples = sample_canonical_grid(
        capsule.shell_density, capsule.BOUNDS_M, capsule.capsule_body(), capsule.VOXEL_SIZE_M, capsule.SETTINGS
    )
    return extract_mesh(samples, 50.0, capsule.SETTINGS)


def raise_open_surface_error(*_: object, **__: object) -> Mesh:
    raise OpenSurfaceError("a surface still has holes after 4 repair iterations")


def test_the_edge_length_is_reached(extracted: Mesh) -> None:
    mesh = remesh_to_edge_length(extracted, 0.04, capsule.capsule_body())
    edges = mesh.vertices[mesh.edges()]
    lengths, x_m = np.linalg.norm(edges[:, 0] - edges[:, 1], axis=1), edges[..., 0].mean(axis=1)
    assert np.median(lengths[x_m < -0.05]) == pytest.approx(0.04, rel=0.25)
    assert np.median(lengths[x_m > 0.2]) == pytest.approx(0.02, rel=0.25)  # the hand
    assert is_closed_manifold(mesh)


@pytest.mark.parametrize(
    ("failing_function", "expected_warning"),
    [("remesh_isotropic", "the mesh is not remeshed"), ("repair", "the mesh is not decimated before remeshing")],
)
def test_a_step_that_leaves_holes_is_skipped(
    extracted: Mesh, monkeypatch: pytest.MonkeyPatch, failing_function: str, expected_warning: str
) -> None:
    monkeypatch.setattr(remeshing_module, failing_function, raise_open_surface_error)
    take_warnings()
    mesh = remesh_to_edge_length(extracted, 0.05, capsule.capsule_body())
    assert is_closed_manifold(mesh)
    assert len(mesh.faces) < len(extracted.faces)  # the other step still reduces the number of faces
    (warning,) = take_warnings()
    assert expected_warning in warning


def no_detail(mesh: Mesh) -> np.ndarray:
    return np.zeros(len(mesh.faces), dtype=bool)


def test_detailed_faces_are_not_decimated(egg: Mesh) -> None:
    detailed = egg.vertices[egg.faces].mean(axis=1)[:, 1] > 0.1
    settings = replace(SETTINGS, subdivide_percentile=100.0, decimate_percentile=100.0)
    adapted = remesh_adaptively(egg, np.zeros(len(egg.faces)), detailed, EDGE_M, 3000, settings)
    after = adapted.vertices[adapted.faces].mean(axis=1)[:, 1] > 0.1
    assert after.sum() == pytest.approx(detailed.sum(), rel=0.05)
    assert (~after).sum() < 0.8 * (~detailed).sum()


def test_faces_are_subdivided_where_the_error_is_large(egg: Mesh) -> None:
    centres = egg.vertices[egg.faces].mean(axis=1)
    errors = np.exp(8 * centres[:, 1])
    adapted = remesh_adaptively(egg, errors, no_detail(egg), EDGE_M, 3000, replace(SETTINGS, subdivide_percentile=90.0))
    assert is_closed_manifold(adapted)

    def fraction_above(mesh: Mesh) -> float:
        return float((mesh.vertices[mesh.faces].mean(axis=1)[:, 1] > 0.2).mean())

    assert fraction_above(adapted) > 1.5 * fraction_above(egg)
    below = adapted.vertices[adapted.faces].mean(axis=1)[:, 1] < -0.05
    assert below.sum() < (centres[:, 1] < -0.05).sum()


def test_a_decimation_that_leaves_holes_is_skipped(egg: Mesh, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(remeshing_module, "remesh_isotropic", raise_open_surface_error)
    take_warnings()
    adapted = remesh_adaptively(
        egg, np.arange(len(egg.faces), dtype=np.float64), no_detail(egg), EDGE_M, 3000, SETTINGS
    )
    assert is_closed_manifold(adapted)
    assert len(adapted.faces) > len(egg.faces)  # the faces with a large error are subdivided nevertheless
    (warning,) = take_warnings()
    assert "faces with a small image error are not decimated" in warning


def test_the_face_limit_stops_the_subdivision(egg: Mesh) -> None:
    errors = np.arange(len(egg.faces), dtype=np.float64)
    settings = replace(SETTINGS, decimate_percentile=0.0)
    assert len(remesh_adaptively(egg, errors, no_detail(egg), EDGE_M, 100, settings).faces) <= len(egg.faces)


def test_the_faces_with_the_largest_errors_fill_the_face_budget(egg: Mesh) -> None:
    errors = np.arange(len(egg.faces), dtype=np.float64)
    chosen = remeshing_module._faces_to_subdivide(errors, len(egg.faces) + 8, 50.0)
    np.testing.assert_array_equal(np.flatnonzero(chosen), [len(errors) - 2, len(errors) - 1])


@pytest.mark.parametrize("ratio", [0.5, 2.0])
def test_uniform_remeshing_reaches_the_number_of_faces_with_equal_edges(egg: Mesh, ratio: float) -> None:
    fine_half = egg.vertices[egg.faces].mean(axis=1)[:, 1] > 0.0
    uneven = subdivide(egg, fine_half)[0]
    wanted = int(ratio * len(egg.faces))
    mesh = remesh_uniformly(uneven, no_detail(uneven), wanted)
    assert is_closed_manifold(mesh)
    assert wanted <= len(mesh.faces) <= 1.02 * wanted

    def area_ratio(mesh: Mesh) -> float:
        """Median area of the faces below over that of the faces above, which are finer in the input."""
        above = mesh.vertices[mesh.faces].mean(axis=1)[:, 1] > 0.0
        return float(np.median(mesh.face_areas_m2()[~above]) / np.median(mesh.face_areas_m2()[above]))

    assert area_ratio(uneven) > 3.0
    assert area_ratio(mesh) == pytest.approx(1.0, abs=0.25)


def test_uniform_remeshing_keeps_detailed_faces(egg: Mesh) -> None:
    detailed = egg.vertices[egg.faces].mean(axis=1)[:, 1] > 0.1
    mesh = remesh_uniformly(egg, detailed, 2 * len(egg.faces))
    kept = {tuple(np.sort(np.round(face, 6).ravel())) for face in egg.vertices[egg.faces[detailed]]}
    found = {tuple(np.sort(np.round(face, 6).ravel())) for face in mesh.vertices[mesh.faces]}
    assert kept <= found


def test_uniform_remeshing_that_leaves_holes_is_skipped(egg: Mesh, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(remeshing_module, "remesh_isotropic", raise_open_surface_error)
    take_warnings()
    assert remesh_uniformly(egg, no_detail(egg), 100) is egg
    assert len(take_warnings()) == 1
