from dataclasses import replace

import pytest
import torch

from pipeline.body.body import load_anny
from pipeline.body.fit.camera_parameters import INTRINSICS_COUNT
from pipeline.body.fit.energy import (
    MAX_DEPTH_SCALE_RATIO,
    MIN_DEPTH_SCALE_RATIO,
    EnergyParameters,
    FitState,
    Objective,
    compute_px_per_m,
    face_landmark_confidence,
    fit_3d_landmark_scale,
)
from pipeline.body.fit.initialisation import solve_root_position
from pipeline.body.fit.landmark_regressor import LANDMARK_COUNT, LANDMARK_OFFSET_COUNT, landmark_regressor
from pipeline.body.fit.linear_body import ACTIVE_JOINTS, linearise_body, pose_skeleton
from pipeline.body.fit.priors import pose_prior, shape_prior
from pipeline.body.fit.silhouette_icp import match_silhouettes
from pipeline.geometry.rotation import axis_angle_to_matrix
from tests.body.acting import synthetic_recording

FRAMES = 4
NUMBERS = 3 * len(ACTIVE_JOINTS) + 3
# Without motion, whose derivative is of first order in the turn between frames, the gradient is exact.
EXACT = EnergyParameters(free_landmark_offsets=True, free_focal=True, free_principal_point=True, motion=1e5)


def build(weights: EnergyParameters, outlines: bool = True) -> tuple[Objective, FitState]:
    """An objective near, not at, its minimum."""
    body = load_anny()
    scene = synthetic_recording(body, FRAMES, turn_rad=0.6, noise_m=0.02)
    model = linearise_body(body, body.shape_defaults)
    generator = torch.Generator().manual_seed(5)
    step = 0.03 * torch.randn(FRAMES, NUMBERS, generator=generator, dtype=torch.float64)
    shared = 0.01 * torch.randn(
        len(model.shape) + LANDMARK_OFFSET_COUNT + INTRINSICS_COUNT, generator=generator, dtype=torch.float64
    )
    state = scene.state.moved(step, shared, scene.camera)
    observations = scene.observations(scene.camera)
    contour = match_silhouettes(model, state, observations, scene.windows())[0] if outlines else None
    scale = compute_px_per_m(state, scene.camera)
    priors = pose_prior(model), shape_prior(body.shape_names, body.shape_defaults)
    return Objective(model, landmark_regressor(model), *priors, observations, weights, scale, contour), state


@pytest.mark.parametrize(
    "weights",
    [
        EXACT,
        replace(EXACT, free_shape=False, free_landmark_offsets=False, free_focal=False, free_principal_point=False),
    ],
)
def test_gradient_agrees_with_differences_of_the_cost(weights: EnergyParameters) -> None:
    objective, state = build(weights)
    system = objective(state)
    generator = torch.Generator().manual_seed(6)
    by_frame = torch.randn(FRAMES, NUMBERS, generator=generator, dtype=torch.float64)
    camera = objective.observations.camera
    by_shared = 0.1 * torch.randn(len(system.shared_gradient), generator=generator, dtype=torch.float64)
    ahead = objective(state.moved(1e-6 * by_frame, 1e-6 * by_shared, camera)).cost
    behind = objective(state.moved(-1e-6 * by_frame, -1e-6 * by_shared, camera)).cost
    slope = 2.0 * float((system.frame_gradient * by_frame).sum() + system.shared_gradient @ by_shared)
    # the surface's derivative by shape is that of the nearest corner, hence the tolerance
    assert (ahead - behind) / 2e-6 == pytest.approx(slope, rel=5e-3)


def test_a_picture_cut_off_centre_costs_the_same() -> None:
    """A window of the picture, with the principal point moved along, says the same about every unknown."""
    left_px, top_px = 21, 10
    objective, state = build(EXACT)
    seen, contour = objective.observations, objective.contour
    assert contour is not None
    corner = seen.landmarks_px.new_tensor([left_px, top_px])
    camera = seen.camera.cropped(left_px, top_px, 230, 300)
    cut = replace(
        objective,
        observations=replace(seen, camera=camera, landmarks_px=seen.landmarks_px - corner),
        contour=replace(contour, target_px=contour.target_px - corner),
    )
    whole, part = objective(state), cut(state)
    assert part.cost == pytest.approx(whole.cost, rel=1e-9)
    assert torch.allclose(part.frame_gradient, whole.frame_gradient)
    assert torch.allclose(part.shared_gradient, whole.shared_gradient)
    start, cut_start = (solve_root_position(each.observations, seen.landmarks_3d_m) for each in (objective, cut))
    assert torch.allclose(cut_start, start)


def test_the_prior_pulls_the_principal_point_to_the_middle() -> None:
    weights = EnergyParameters(
        landmark_std_m=1e4,
        hand_std_m=1e4,
        landmark_3d_std_m=1e4,
        motion=1e4,
        free_principal_point=True,
        principal_point_std=0.02,
    )
    objective, state = build(weights, outlines=False)
    costs = [
        objective(replace(state, intrinsics_delta=torch.tensor([*shift, 0.0], dtype=torch.float64))).cost
        for shift in ((0.0, 0.0), (0.02, 0.0), (0.0, -0.04))
    ]
    assert costs[1] - costs[0] == pytest.approx(1.0, rel=1e-3)
    assert costs[2] - costs[0] == pytest.approx(4.0, rel=1e-3)


def test_gradient_of_motion_is_right_for_small_turns() -> None:
    objective, state = build(
        EnergyParameters(landmark_std_m=1e3, landmark_3d_std_m=1e3, free_shape=False), outlines=False
    )
    system = objective(state)
    generator = torch.Generator().manual_seed(7)
    by_frame = torch.randn(FRAMES, NUMBERS, generator=generator, dtype=torch.float64)
    camera = objective.observations.camera
    nothing = torch.zeros(0, dtype=torch.float64)
    ahead, behind = (objective(state.moved(sign * 1e-6 * by_frame, nothing, camera)).cost for sign in (1.0, -1.0))
    slope = 2.0 * float((system.frame_gradient * by_frame).sum())
    assert (ahead - behind) / 2e-6 == pytest.approx(slope, rel=0.05)


def test_the_truth_costs_less_than_its_neighbourhood() -> None:
    objective, wrong = build(EnergyParameters(motion=1e5), outlines=False)
    scene = synthetic_recording(load_anny(), FRAMES, turn_rad=0.6)
    objective = replace(objective, observations=scene.observations(scene.camera))
    assert objective(scene.state).cost < 0.5 * objective(wrong).cost


def test_faces_seen_from_behind_are_not_trusted() -> None:
    body = load_anny()
    scene = synthetic_recording(body, 3)
    turned = torch.tensor([0.0, torch.pi / 2, torch.pi], dtype=torch.float64)
    angles = torch.zeros(3, len(ACTIVE_JOINTS), 3, dtype=torch.float64)
    angles[:, 0, 1] = turned
    factor = face_landmark_confidence(
        pose_skeleton(scene.model, axis_angle_to_matrix(angles), scene.state.root_m), scene.camera
    )
    assert torch.allclose(factor[0], torch.ones(LANDMARK_COUNT, dtype=torch.float64))
    assert factor[2, 0] == pytest.approx(0.05)
    assert 0.05 < factor[1, 0] < 1.0
    assert torch.equal(factor[:, 11:], torch.ones(3, LANDMARK_COUNT - 11, dtype=torch.float64))


@pytest.mark.parametrize(
    ("flatness", "found"), [(0.6, 0.6), (0.1, MIN_DEPTH_SCALE_RATIO), (3.0, MAX_DEPTH_SCALE_RATIO)]
)
def test_depths_have_a_scale_of_their_own(flatness: float, found: float) -> None:
    """A detector that makes people smaller, flatter, and puts one landmark in a wrong place."""
    generator = torch.Generator().manual_seed(8)
    relative = 0.4 * torch.randn(5, 33, 3, generator=generator, dtype=torch.float64)
    directions = relative * torch.tensor([0.8, 0.8, 0.8 * flatness], dtype=torch.float64)
    directions[:, 15, 1] += 2.0
    inverse = torch.full((5, 33, 3), 1 / 0.08, dtype=torch.float64)
    scale = fit_3d_landmark_scale(relative, directions, inverse, 3.0)
    assert scale.tolist() == pytest.approx([0.8, 0.8, 0.8 * found], rel=0.03)
