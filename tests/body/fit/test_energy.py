from dataclasses import replace

import numpy as np
import pytest
import torch

from pipeline.body.body import load_anny
from pipeline.body.fit import energy
from pipeline.body.fit.camera_parameters import INTRINSICS_COUNT
from pipeline.body.fit.detections.landmarks_3d import (
    MAX_DEPTH_SCALE_RATIO,
    MIN_DEPTH_SCALE_RATIO,
    fit_3d_landmark_scale,
)
from pipeline.body.fit.energy import VERTICAL_PRINCIPAL_POINT_RATIO, EnergyParameters, Objective, compute_px_per_m
from pipeline.body.fit.initialisation import solve_root_position
from pipeline.body.fit.landmark_regressor import LANDMARK_COUNT, LANDMARK_OFFSET_COUNT, landmark_regressor
from pipeline.body.fit.levenberg_marquardt import NormalEquations
from pipeline.body.fit.linear_body import ACTIVE_JOINTS, linearise_body
from pipeline.body.fit.posed_points import pose_skeleton
from pipeline.body.fit.prior.priors import default_motion_std, pose_prior, shape_prior
from pipeline.body.fit.silhouette_icp import match_silhouettes
from pipeline.body.fit.state import FitState
from pipeline.body.fit.terms import SharedPriorTerm, face_landmark_confidence
from pipeline.geometry.rotation import axis_angle_to_matrix
from tests.body.acting import synthetic_recording

FRAMES = 4
NUMBERS = 3 * len(ACTIVE_JOINTS) + 3
EXACT = EnergyParameters(free_landmark_offsets=True, free_focal=True, free_principal_point=True)


def build(
    parameters: EnergyParameters, outlines: bool = True, motion_std_factor: float = 1.0
) -> tuple[Objective, FitState]:
    """Return an objective and a state near its minimum; a factor of 1e5 leaves the motion term without weight."""
    body = load_anny()
    scene = synthetic_recording(body, FRAMES, turn_rad=0.6, noise_m=0.02)
    model = linearise_body(body, body.shape_defaults)
    generator = torch.Generator().manual_seed(5)
    step = 0.03 * torch.randn(FRAMES, NUMBERS, generator=generator, dtype=torch.float64)
    shared = 0.01 * torch.randn(
        len(model.shape) + LANDMARK_OFFSET_COUNT + INTRINSICS_COUNT, generator=generator, dtype=torch.float64
    )
    state = scene.state.retract(step, shared, scene.camera)
    observations = scene.observations(scene.camera)
    contour = match_silhouettes(model, state, observations, scene.windows())[0] if outlines else None
    scale = compute_px_per_m(state, scene.camera)
    priors = pose_prior(model), shape_prior(body.shape_names, body.shape_defaults)
    objective = Objective(model, landmark_regressor(model), *priors, observations, parameters, scale, contour)
    return replace(objective, motion_std=motion_std_factor * default_motion_std(len(ACTIVE_JOINTS))), state


@pytest.mark.parametrize(
    "parameters",
    [
        EXACT,
        replace(EXACT, free_shape=False, free_landmark_offsets=False, free_focal=False, free_principal_point=False),
    ],
)
def test_gradient_agrees_with_differences_of_the_cost(parameters: EnergyParameters) -> None:
    # the Jacobian of the motion term is a first-order approximation
    objective, state = build(parameters, motion_std_factor=1e5)
    system = objective(state)
    generator = torch.Generator().manual_seed(6)
    frame_step = torch.randn(FRAMES, NUMBERS, generator=generator, dtype=torch.float64)
    camera = objective.observations.camera
    shared_step = 0.1 * torch.randn(len(system.shared_gradient), generator=generator, dtype=torch.float64)
    ahead = objective(state.retract(1e-6 * frame_step, 1e-6 * shared_step, camera)).cost
    behind = objective(state.retract(-1e-6 * frame_step, -1e-6 * shared_step, camera)).cost
    slope = 2.0 * float((system.frame_gradient * frame_step).sum() + system.shared_gradient @ shared_step)
    # the shape derivative of a surface point is that of the nearest vertex, hence the tolerance
    assert (ahead - behind) / 2e-6 == pytest.approx(slope, rel=5e-3)


def test_gradient_of_the_shared_priors_agrees_with_differences_of_their_cost() -> None:
    """With feet longer than those of anyone; their direction counts as constant, hence the tolerance."""
    objective, state = build(EXACT, outlines=False)
    (prior,) = (term for term in objective._prior_terms() if isinstance(term, SharedPriorTerm))
    shape = state.shape.clone()
    shape[load_anny().shape_names.index("foot-size")] = 0.6
    count = len(shape) + LANDMARK_OFFSET_COUNT + INTRINSICS_COUNT

    def evaluate(of_shape: torch.Tensor) -> NormalEquations:
        system = NormalEquations.zeros(FRAMES, NUMBERS, count)
        prior.add_to(system, objective._linearise(replace(state, shape=of_shape)))
        return system

    step = 1e-6 * torch.randn(len(shape), generator=torch.Generator().manual_seed(7), dtype=torch.float64)
    slope = 2.0 * float(evaluate(shape).shared_gradient[: len(shape)] @ step)
    assert evaluate(shape + step).cost - evaluate(shape - step).cost == pytest.approx(2.0 * slope, rel=2e-3)
    assert float(evaluate(shape).shared_gradient[load_anny().shape_names.index("foot-size")]) > 10.0


def test_chunks_of_frames_do_not_change_the_system(monkeypatch: pytest.MonkeyPatch) -> None:
    """All frames in one chunk, or chunks of two; derivatives are float32, the cost is float64."""
    objective, state = build(EXACT)
    whole = objective(state)
    monkeypatch.setattr(energy, "FRAMES_PER_CHUNK", 2)
    for name, value in vars(objective(state)).items():
        expected = np.asarray(getattr(whole, name))
        largest = np.abs(expected).max()
        tolerance = (1e-9 if name == "cost" else 1e-6) * largest
        np.testing.assert_allclose(value, expected, rtol=0.0, atol=tolerance, err_msg=name)


def test_cropping_does_not_change_the_energy() -> None:
    """Cost and gradients of a cropped image, with the principal point shifted accordingly, stay the same."""
    left_px, top_px = 21, 10
    objective, state = build(EXACT)
    observations, contour = objective.observations, objective.contour
    assert contour is not None
    corner = observations.landmarks_px.new_tensor([left_px, top_px])
    camera = observations.camera.cropped(left_px, top_px, 230, 300)
    cropped = replace(
        objective,
        observations=replace(observations, camera=camera, landmarks_px=observations.landmarks_px - corner),
        contour=replace(contour, target_px=contour.target_px - corner),
    )
    full_system, cropped_system = objective(state), cropped(state)
    assert cropped_system.cost == pytest.approx(full_system.cost, rel=1e-9)
    assert torch.allclose(cropped_system.frame_gradient, full_system.frame_gradient)
    assert torch.allclose(cropped_system.shared_gradient, full_system.shared_gradient)
    start, cropped_start = (
        solve_root_position(each.observations, observations.landmarks_3d_m) for each in (objective, cropped)
    )
    assert torch.allclose(cropped_start, start)


def test_3d_landmarks_do_not_tell_where_a_person_is_in_the_picture() -> None:
    """The detector sees the same crop, and reports the same, when the camera turns about its centre."""
    objective, state = build(replace(EXACT, landmark_std_m=1e4, hand_std_m=1e4), outlines=False)
    observations, camera = objective.observations, objective.observations.camera
    turn = axis_angle_to_matrix(torch.tensor([0.0, 0.35, 0.0], dtype=torch.float64)).numpy()
    pose = camera.world_to_camera.astype(np.float64)
    turned = replace(camera, world_to_camera=np.concatenate([turn @ pose[:3], pose[3:]]))
    to_world = torch.from_numpy(turned.world_to_camera[:3, :3])
    detected_m = observations.landmarks_3d_m @ torch.from_numpy(pose[:3, :3]).T
    elsewhere = replace(observations, camera=turned, landmarks_3d_m=detected_m @ to_world)
    cost = replace(objective, observations=elsewhere)(state).cost
    assert cost == pytest.approx(objective(state).cost, rel=0.01)


def test_principal_point_prior_is_centred() -> None:
    parameters = EnergyParameters(
        landmark_std_m=1e4,
        hand_std_m=1e4,
        landmark_3d_std_m=1e4,
        free_principal_point=True,
        principal_point_std=0.02,
    )
    objective, state = build(parameters, outlines=False, motion_std_factor=1e4)
    costs = [
        objective(replace(state, intrinsics_delta=torch.tensor([*shift, 0.0], dtype=torch.float64))).cost
        for shift in ((0.0, 0.0), (0.02, 0.0), (0.0, -0.04))
    ]
    assert costs[1] - costs[0] == pytest.approx(1.0, rel=1e-3)
    assert costs[2] - costs[0] == pytest.approx(4.0 / VERTICAL_PRINCIPAL_POINT_RATIO**2, rel=1e-3)


def test_motion_gradient_is_correct_for_small_rotations() -> None:
    objective, state = build(
        EnergyParameters(landmark_std_m=1e3, landmark_3d_std_m=1e3, free_shape=False), outlines=False
    )
    system = objective(state)
    generator = torch.Generator().manual_seed(7)
    frame_step = torch.randn(FRAMES, NUMBERS, generator=generator, dtype=torch.float64)
    camera = objective.observations.camera
    nothing = torch.zeros(0, dtype=torch.float64)
    ahead, behind = (objective(state.retract(sign * 1e-6 * frame_step, nothing, camera)).cost for sign in (1.0, -1.0))
    slope = 2.0 * float((system.frame_gradient * frame_step).sum())
    assert (ahead - behind) / 2e-6 == pytest.approx(slope, rel=0.05)


def test_the_true_state_has_a_lower_cost() -> None:
    objective, wrong = build(EnergyParameters(), outlines=False, motion_std_factor=1e5)
    scene = synthetic_recording(load_anny(), FRAMES, turn_rad=0.6)
    objective = replace(objective, observations=scene.observations(scene.camera))
    assert objective(scene.state).cost < 0.5 * objective(wrong).cost


def test_face_landmarks_seen_from_behind_have_low_confidence() -> None:
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
def test_depth_scale_is_estimated_separately(flatness: float, found: float) -> None:
    """The detector scales people down, flattens them, and misplaces one landmark."""
    generator = torch.Generator().manual_seed(8)
    relative = 0.4 * torch.randn(5, 33, 3, generator=generator, dtype=torch.float64)
    directions = relative * torch.tensor([0.8, 0.8, 0.8 * flatness], dtype=torch.float64)
    directions[:, 15, 1] += 2.0
    inverse = torch.full((5, 33, 3), 1 / 0.08, dtype=torch.float64)
    scale = fit_3d_landmark_scale(relative, directions, inverse, 3.0)
    assert scale.tolist() == pytest.approx([0.8, 0.8, 0.8 * found], rel=0.03)
