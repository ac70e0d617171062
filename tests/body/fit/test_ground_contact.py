"""Floor contact of people with known standing, sliding or raised feet."""

from dataclasses import replace

import numpy as np
import pytest
import torch

from pipeline.body.body import load_anny
from pipeline.body.fit.ground_contact import (
    CONTACT_STD_M,
    Contact,
    compute_speed_m_s,
    estimate_floor_contact,
    fit_plane,
    sole_points,
)
from pipeline.body.fit.levenberg_marquardt import NormalEquations
from pipeline.body.fit.linear_body import ACTIVE_JOINTS
from pipeline.body.fit.posed_points import pose_points, pose_skeleton
from pipeline.body.fit.state import FitState
from pipeline.body.fit.terms import ContactTerm, Linearisation
from tests.body.acting import SyntheticRecording, synthetic_recording

FRAMES = 12
PARAMETERS = 3 * len(ACTIVE_JOINTS) + 3


@pytest.fixture(scope="module")
def standing() -> SyntheticRecording:
    """Return a person in the A-pose, flat on the floor and stationary."""
    scene = synthetic_recording(load_anny(), FRAMES)
    upright = torch.eye(3, dtype=torch.float64).expand_as(scene.state.rotations)
    root_m = scene.state.root_m[:1].repeat(FRAMES, 1)
    return replace(scene, state=replace(scene.state, rotations=upright, root_m=root_m))


def contact_of(
    scene: SyntheticRecording, root_m: torch.Tensor, foot_confidence: float = 1.0, fps: float = 10.0
) -> Contact | None:
    confidence = torch.full((FRAMES, 33), foot_confidence, dtype=torch.float64)
    time_s = torch.arange(FRAMES, dtype=torch.float64) / fps
    return estimate_floor_contact(scene.model, scene.state.rotations, root_m, confidence, time_s)


def soles_m(scene: SyntheticRecording, root_m: torch.Tensor) -> torch.Tensor:
    skeleton = pose_skeleton(scene.model, scene.state.rotations, root_m)
    return pose_points(scene.model, skeleton, sole_points(scene.model)).world_m


def contact_system(scene: SyntheticRecording, state: FitState, contact: Contact) -> NormalEquations:
    system = NormalEquations.zeros(FRAMES, PARAMETERS, 0)
    skeleton = pose_skeleton(scene.model, state.rotations, state.root_m)
    soles = pose_points(scene.model, skeleton, contact.points)
    ContactTerm(contact).add_to(system, Linearisation(state, scene.camera, scene.model, skeleton, soles, False))
    return system


def test_plane_is_fitted_to_weighted_points() -> None:
    random = np.random.default_rng(1)
    slope, height = np.array([0.05, -0.10]), -0.9
    positions = random.uniform(-0.5, 0.5, (40, 4, 3))
    positions[..., 1] = height + positions[..., [0, 2]] @ slope
    weight = torch.ones(40, 4, dtype=torch.float64)
    positions[7], weight[7] = 3.0, 0.0
    normal, offset_m = fit_plane(torch.tensor(positions), weight)
    expected = np.array([-slope[0], 1.0, -slope[1]]) / np.sqrt(1.0 + slope @ slope)
    # the prior of an upright camera reduces the slope slightly
    assert normal.tolist() == pytest.approx(expected, abs=0.012)
    assert float(normal @ torch.tensor([0.0, height, 0.0], dtype=torch.float64)) == pytest.approx(
        float(offset_m), abs=0.002
    )


def test_a_single_contact_point_gives_no_tilt() -> None:
    random = np.random.default_rng(2)
    positions = random.normal(0.0, 0.01, (30, 4, 3)) + [0.2, -0.9, -3.0]
    normal, offset_m = fit_plane(torch.tensor(positions), torch.ones(30, 4, dtype=torch.float64))
    assert normal.tolist() == pytest.approx([0.0, 1.0, 0.0], abs=0.01)
    assert float(offset_m / normal[1]) == pytest.approx(-0.9, abs=0.04)


def test_speed_of_uniform_motion_does_not_depend_on_the_frame_rate() -> None:
    time_s = torch.tensor([0.0, 0.1, 0.2, 0.35, 0.4, 0.6, 0.8], dtype=torch.float64)
    positions = time_s[:, None, None] * torch.tensor([0.3, 0.0, -0.4], dtype=torch.float64).expand(7, 4, 3)
    assert compute_speed_m_s(positions, time_s).flatten().tolist() == pytest.approx([0.5] * 28)


def test_standing_feet_keep_their_position(standing: SyntheticRecording) -> None:
    contact = contact_of(standing, standing.state.root_m)
    assert contact is not None
    assert torch.equal(contact.weight, torch.ones(FRAMES, 4, 3, dtype=torch.float64))
    held = contact.target_m @ contact.axes
    assert (held - soles_m(standing, standing.state.root_m)).norm(dim=-1).max() < 0.01


def test_sliding_feet_are_tied_to_the_floor_only(standing: SyntheticRecording) -> None:
    slide = torch.arange(FRAMES, dtype=torch.float64)[:, None] * torch.tensor([0.08, 0.0, 0.0], dtype=torch.float64)
    contact = contact_of(standing, standing.state.root_m + slide)
    assert contact is not None
    assert contact.weight[..., 0].min() == 1.0
    assert contact.weight[..., 1:].max() == 0.0


def test_jumping_feet_have_no_contact(standing: SyntheticRecording) -> None:
    root_m = standing.state.root_m.clone()
    root_m[5:7, 1] += 0.3
    contact = contact_of(standing, root_m)
    assert contact is not None
    assert contact.weight[5:7].max() == 0.0
    assert contact.weight[:4, :, 0].min() > 0.9


def test_undetected_feet_give_no_floor(standing: SyntheticRecording) -> None:
    assert contact_of(standing, standing.state.root_m, foot_confidence=0.1) is None


def test_gradient_agrees_with_differences_of_the_cost(standing: SyntheticRecording) -> None:
    contact = contact_of(standing, standing.state.root_m)
    assert contact is not None
    generator = torch.Generator().manual_seed(3)
    nothing = torch.zeros(0, dtype=torch.float64)
    moved = standing.state.retract(
        0.02 * torch.randn(FRAMES, PARAMETERS, generator=generator, dtype=torch.float64), nothing, standing.camera
    )
    direction = torch.randn(FRAMES, PARAMETERS, generator=generator, dtype=torch.float64)

    def system_at(step: float) -> NormalEquations:
        state = moved.retract(step * direction, nothing, standing.camera)
        return contact_system(standing, state, contact)

    slope = 2.0 * float((system_at(0.0).frame_gradient * direction).sum())
    assert (system_at(1e-6).cost - system_at(-1e-6).cost) / 2e-6 == pytest.approx(slope, rel=1e-4)


def test_contact_cost_is_the_robust_cost_of_the_distance(standing: SyntheticRecording) -> None:
    contact = contact_of(standing, standing.state.root_m)
    assert contact is not None
    only = torch.zeros_like(contact.weight)
    only[3, 2, 0] = 1.0
    contact = replace(contact, weight=only)
    root_m = standing.state.root_m + 0.5 * CONTACT_STD_M * contact.axes[0]
    system = contact_system(standing, replace(standing.state, root_m=root_m), contact)
    distance_m = float(soles_m(standing, root_m)[3, 2] @ contact.axes[0] - contact.target_m[3, 2, 0])
    squared = (distance_m / CONTACT_STD_M) ** 2
    assert system.cost == pytest.approx(squared / (1.0 + squared / 9.0))
