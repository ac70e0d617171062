"""Optimisation of the vertices of a known mesh: shape, global offset, colours, and the implicit smoothing."""

from dataclasses import replace

import numpy as np
import pytest
import torch
from scipy.sparse import csr_array

from pipeline.body.body import Body
from pipeline.field.field import FieldColours, RadianceField, hash_grid_layout
from pipeline.geometry.mesh import Mesh
from pipeline.geometry.surface import laplacian
from pipeline.kernels.cholesky_solve import cholesky_solve
from pipeline.mesh.skin_transfer import transfer_skin
from pipeline.mesh.vertex_optimisation import (
    STIFFNESS,
    factorise_smoothing_matrix,
    optimise_vertices,
    regularisation_gradients,
)
from pipeline.mesh.views import mesh_psnr_db
from tests.mesh.egg import PATTERN, SETTINGS, Pattern, Views, refinement_inputs


def mean_normal_distance_m(mesh: Mesh, truth: Mesh) -> float:
    """Mean distance of corresponding vertices along the normal (same faces)."""
    return float(np.abs(np.sum((mesh.vertices - truth.vertices) * truth.vertex_normals(), axis=1)).mean())


def test_optimisation_recovers_the_shape(egg: Mesh, dented_egg: Mesh, egg_body: Body, egg_views: Views) -> None:
    skin = transfer_skin(dented_egg, egg_body)
    result = optimise_vertices(dented_egg, skin, refinement_inputs(egg_body, egg_views, steps=80), seed=0)
    assert mean_normal_distance_m(result, egg) < 0.4 * mean_normal_distance_m(dented_egg, egg)
    before_db, after_db = (mesh_psnr_db(mesh, skin, egg_views[1], PATTERN) for mesh in (dented_egg, result))
    assert after_db - before_db > 4.0
    np.testing.assert_array_equal(result.faces, dented_egg.faces)


def test_the_global_offset_translates_all_vertices(egg: Mesh, egg_body: Body, egg_views: Views) -> None:
    shift_m = np.array([0.01, -0.015, 0.0], dtype=np.float32)
    settings = replace(SETTINGS, learning_rate=1e-9, global_learning_rate=0.002)
    shifted = Mesh(egg.vertices + shift_m, egg.faces)
    inputs = refinement_inputs(egg_body, egg_views, steps=60, settings=settings)
    result = optimise_vertices(shifted, transfer_skin(shifted, egg_body), inputs, seed=0)
    offset_m = result.vertices - shifted.vertices
    np.testing.assert_allclose(offset_m, np.broadcast_to(offset_m[0], offset_m.shape), atol=1e-5)
    np.testing.assert_allclose(offset_m[0], -shift_m, atol=0.003)


def test_the_first_steps_optimise_only_the_colours(egg: Mesh, egg_body: Body, egg_views: Views) -> None:
    pale = Pattern(0.1)
    settings = replace(
        SETTINGS,
        appearance_learning_rate=0.05,
        appearance_steps=40,
        learning_rate=1e-9,
        global_learning_rate=0.0,
    )
    inputs = refinement_inputs(egg_body, egg_views, steps=1, settings=settings, shader=pale)
    result = optimise_vertices(egg, transfer_skin(egg, egg_body), inputs, seed=0)
    assert float(pale.contrast) == pytest.approx(0.4, abs=0.03)
    np.testing.assert_allclose(result.vertices, egg.vertices, atol=1e-6)


class AutogradColours(torch.nn.Module):
    """The colours of a field with all gradients by autograd."""

    def __init__(self, field: RadianceField) -> None:
        super().__init__()
        self.field = field

    def forward(self, points: torch.Tensor) -> torch.Tensor:
        return self.field(points)[0]


def test_the_colours_of_a_field_are_optimised_as_by_autograd(egg: Mesh, egg_body: Body, egg_views: Views) -> None:
    settings = replace(SETTINGS, appearance_learning_rate=0.01, appearance_steps=4)
    bounds_m = np.array([[-0.6] * 3, [0.6] * 3])
    results = []
    for colours in (FieldColours, AutogradColours):
        field = RadianceField(bounds_m, hash_grid_layout(bounds_m, 0.05, 4, 4, 12), hidden_width=16)
        start = field.table.detach().clone()
        inputs = refinement_inputs(egg_body, egg_views, steps=3, settings=settings, shader=colours(field))
        moved = optimise_vertices(egg, transfer_skin(egg, egg_body), inputs, seed=0)
        results.append((torch.from_numpy(moved.vertices), *(parameter.detach() for parameter in field.parameters())))
        assert (field.table.detach() - start).abs().max() > 0.001
    for mine, theirs in zip(*results, strict=True):
        torch.testing.assert_close(mine, theirs, rtol=1e-3, atol=1e-4)


def test_smoothed_offsets_solve_their_equation(egg: Mesh) -> None:
    stiff = egg.vertices[egg.faces].mean(axis=1)[:, 1] > 0.1
    stiff_vertices = set(egg.faces[stiff].ravel().tolist())
    factors = factorise_smoothing_matrix(egg, stiff, 5.0)
    generator = torch.Generator().manual_seed(0)
    u = torch.rand(len(egg.vertices), 3, generator=generator, dtype=torch.float64)
    offset = cholesky_solve(factors, u)
    dense = torch.eye(len(u), dtype=torch.float64)
    lengths = {(a, b): float(np.linalg.norm(egg.vertices[a] - egg.vertices[b])) for a, b in egg.edges().tolist()}
    median = float(np.median(list(lengths.values())))
    for (a, b), length in lengths.items():
        weight = 5.0 * min((median / length) ** 2, 16.0)
        weight *= STIFFNESS if a in stiff_vertices and b in stiff_vertices else 1.0
        dense[a, a] += weight
        dense[b, b] += weight
        dense[a, b] -= weight
        dense[b, a] -= weight
    # The factors are in single precision.
    torch.testing.assert_close(dense @ offset, u, rtol=1e-5, atol=2e-5)


def test_the_regularisation_has_the_gradients_of_its_formula(egg: Mesh, egg_body: Body, egg_views: Views) -> None:
    settings = replace(SETTINGS, laplacian_weight=1.5, offset_weight=0.3, global_offset_weight=0.2)
    inputs = refinement_inputs(egg_body, egg_views, steps=1, settings=settings)
    generator = torch.Generator().manual_seed(0)
    offset = torch.rand(len(egg.vertices), 3, generator=generator).requires_grad_()
    global_offset = torch.rand(3, generator=generator).requires_grad_()
    operator = laplacian(egg).astype(np.float32)
    bent = torch.from_numpy(operator.toarray()) @ offset
    loss = 1.5 * bent.square().sum(1).mean() + 0.3 * offset.square().sum(1).mean() + 0.2 * global_offset.square().sum()
    expected = torch.autograd.grad(loss / inputs.target_edge_m**2, [offset, global_offset])
    found = regularisation_gradients(offset.detach(), global_offset.detach(), csr_array(operator.T @ operator), inputs)
    for mine, theirs in zip(found, expected, strict=True):
        torch.testing.assert_close(mine, theirs, rtol=1e-4, atol=1e-4)
