"""Alignment of poses to a coloured surface: renders in known poses, disturbed poses, and dense linear algebra."""

from dataclasses import replace

import numpy as np
import pytest
import torch

from pipeline.body.body import Body, Motion, canonical_to_world
from pipeline.body.fit.linear_body import descendant_matrix
from pipeline.body.pose_correction import PoseCorrection
from pipeline.geometry.camera import project
from pipeline.geometry.skinning import linear_blend_skinning
from pipeline.mesh.correction_prior import drifting_prior
from pipeline.mesh.pose_alignment import (
    AlignedSurface,
    ImageEvidence,
    PoseOffsets,
    align_poses,
    normal_equations,
)
from pipeline.mesh.skin_transfer import SkinnedTopology, transfer_skin
from pipeline.mesh.views import PosedView
from tests.mesh.capsule import capsule_body
from tests.mesh.egg import PATTERN
from tests.mesh.swaying_capsule import CAMERA, FRAMES, JOINTS, disturbed, render_views, swaying_motion


@pytest.fixture(scope="module")
def body() -> Body:
    return capsule_body()


@pytest.fixture(scope="module")
def skin(body: Body) -> SkinnedTopology:
    return transfer_skin(body.mesh(), body)


@pytest.fixture(scope="module")
def true_motion(body: Body) -> Motion:
    return swaying_motion(body)


@pytest.fixture(scope="module")
def views(body: Body, skin: SkinnedTopology, true_motion: Motion) -> list[PosedView]:
    return render_views(body, skin, true_motion)


def remaining_error(body: Body, offsets: PoseOffsets, wrong: Motion, true_motion: Motion) -> tuple[float, float]:
    """Median distance of the surface from the truth before and after the correction, m."""
    vertices, weights = torch.from_numpy(body.vertices), torch.from_numpy(body.skin_weights)
    true_m, before_m, after_m = (
        linear_blend_skinning(vertices, weights, canonical_to_world(body, motion)).numpy()
        for motion in (true_motion, wrong, offsets.of(body, wrong).apply(wrong))
    )
    return (
        float(np.median(np.linalg.norm(before_m - true_m, axis=-1))),
        float(np.median(np.linalg.norm(after_m - true_m, axis=-1))),
    )


def aligned(body: Body, skin: SkinnedTopology, views: list[PosedView], wrong: Motion) -> PoseOffsets:
    start = PoseCorrection(body, wrong)
    surface = AlignedSurface.with_colours(torch.from_numpy(body.vertices), skin, PATTERN)
    return align_poses(surface, views, start, drifting_prior(wrong.time_s, start.size), iterations=2)


def test_disturbed_poses_are_found_again(
    body: Body, skin: SkinnedTopology, views: list[PosedView], true_motion: Motion
) -> None:
    wrong, _, _ = disturbed(true_motion)
    before_m, after_m = remaining_error(body, aligned(body, skin, views, wrong), wrong, true_motion)
    assert before_m > 0.008
    assert after_m < 0.2 * before_m


def test_true_poses_stay(body: Body, skin: SkinnedTopology, views: list[PosedView], true_motion: Motion) -> None:
    offsets = aligned(body, skin, views, true_motion)
    assert float(offsets.rotation_rad.abs().max()) < np.radians(0.15)
    assert float(offsets.shift_m.abs().max()) < 0.002


def test_light_that_changes_slowly_over_the_image_moves_nobody(
    body: Body, skin: SkinnedTopology, views: list[PosedView], true_motion: Motion
) -> None:
    light = torch.linspace(0.6, 1.0, CAMERA.width)[None, :, None]
    lit = [replace(view, image=(view.image.float() * light).round().byte()) for view in views]
    wrong, _, _ = disturbed(true_motion)
    before_m, after_m = remaining_error(body, aligned(body, skin, lit, wrong), wrong, true_motion)
    assert after_m < 0.4 * before_m


def test_normal_equations_have_the_derivatives_of_skinning_and_projection(body: Body, true_motion: Motion) -> None:
    """Central differences of projected vertices of one joint; blends are linearised at the blended point."""
    weights = torch.from_numpy(body.skin_weights)
    rigid = (weights > 0.999).any(dim=1)
    vertices, weights = torch.from_numpy(body.vertices)[rigid], weights[rigid]
    row = torch.tensor([2])

    def project_corrected(values: np.ndarray) -> np.ndarray:
        correction = PoseCorrection(body, true_motion)
        moved = torch.from_numpy(values).float()
        correction.rotation_rad = moved[:-3].view(1, JOINTS, 3).expand(FRAMES, -1, -1)
        correction.shift_m = moved[-3:].view(1, 3).expand(FRAMES, -1)
        return project(linear_blend_skinning(vertices, weights, correction.canonical_to_world(row))[0], CAMERA)[
            0
        ].numpy()

    size, step = 3 * JOINTS + 3, 0.01
    differences = [project_corrected(step * unit) - project_corrected(-step * unit) for unit in np.eye(size)]
    jacobian = np.stack(differences, axis=-1) / (2.0 * step)
    random = np.random.default_rng(1)
    roots, pull = random.normal(size=(len(vertices), 2, 2)), random.normal(size=(len(vertices), 2))
    structure = roots @ roots.transpose(0, 2, 1)

    pose = canonical_to_world(body, true_motion)[2]
    points_m = linear_blend_skinning(vertices, weights, pose[None])[0].numpy()
    below = (weights @ descendant_matrix(body.parents.tolist()).T.float()).numpy()
    evidence = ImageEvidence(points_m, below, structure.astype(np.float32), pull.astype(np.float32))
    matrix, vector = normal_equations(evidence, CAMERA, body, pose.numpy(), np.arange(JOINTS))
    expected = np.einsum("nip,nij,njq->pq", jacobian, structure, jacobian)
    np.testing.assert_allclose(matrix, expected, rtol=0.01, atol=1e-3 * np.abs(expected).max())
    expected_vector = -np.einsum("nip,ni->p", jacobian, pull)
    np.testing.assert_allclose(vector, expected_vector, rtol=0.01, atol=1e-2 * np.abs(expected_vector).max())


def test_subtrees_hold_a_joint_and_all_below_it() -> None:
    parents = np.array([-1, 0, 1, 0])
    expected = [[1, 0], [1, 1], [1, 1], [1, 0]]
    np.testing.assert_array_equal(descendant_matrix(parents.tolist())[[0, 1]].T, expected)


@pytest.mark.parametrize("beside_m", [0.0, 5.0])
def test_a_view_without_the_person_keeps_its_neighbours_correction(
    body: Body, skin: SkinnedTopology, views: list[PosedView], true_motion: Motion, beside_m: float
) -> None:
    """The mask is empty; or the view is a crop of someone else, beside which the mesh is drawn."""
    empty = replace(views[3], image=torch.zeros_like(views[3].image), mask=torch.zeros_like(views[3].mask))
    empty = replace(empty, camera=replace(empty.camera, cx=empty.camera.cx + beside_m * empty.camera.fx))
    wrong, _, _ = disturbed(true_motion)
    offsets = aligned(body, skin, [*views[:3], empty, *views[4:]], wrong)
    assert torch.isfinite(offsets.rotation_rad).all()
    neighbours = 0.5 * (offsets.rotation_rad[2] + offsets.rotation_rad[4])
    assert float((offsets.rotation_rad[3] - neighbours).abs().max()) < np.radians(1.0)
