"""Floor contact against people whose feet are known to stand, to step or to be off the floor."""

from dataclasses import replace

import numpy as np
import pytest
import torch

from pipeline.body.body import load_anny
from pipeline.body.fit.ground_contact import (
    CONTACT_STD_M,
    Contact,
    add_contact_term,
    compute_speed_m_s,
    estimate_floor_contact,
    fit_plane,
    sole_points,
)
from pipeline.body.fit.levenberg_marquardt import NormalEquations
from pipeline.body.fit.linear_body import ACTIVE_JOINTS, pose_points, pose_skeleton
from tests.body.acting import SyntheticRecording, synthetic_recording

FRAMES = 12
NUMBERS = 3 * len(ACTIVE_JOINTS) + 3


@pytest.fixture(scope="module")
def standing() -> SyntheticRecording:
    """The A-pose, which stands flat, held in one place."""
    scene = synthetic_recording(load_anny(), FRAMES)
    upright = torch.eye(3, dtype=torch.float64).expand_as(scene.state.rotations)
    root_m = scene.state.root_m[:1].repeat(FRAMES, 1)
    return replace(scene, state=replace(scene.state, rotations=upright, root_m=root_m))


def contact_of(scene: SyntheticRecording, root_m: torch.Tensor, seen: float = 1.0, fps: float = 10.0) -> Contact | None:
    confidence = torch.full((FRAMES, 33), seen, dtype=torch.float64)
    time_s = torch.arange(FRAMES, dtype=torch.float64) / fps
    return estimate_floor_contact(scene.model, scene.state.rotations, root_m, confidence, time_s)


def soles_m(scene: SyntheticRecording, root_m: torch.Tensor) -> torch.Tensor:
    skeleton = pose_skeleton(scene.model, scene.state.rotations, root_m)
    return pose_points(scene.model, skeleton, sole_points(scene.model))[0]


def test_a_plane_is_found_among_points_of_different_weight() -> None:
    random = np.random.default_rng(1)
    slope, height = np.array([0.05, -0.10]), -0.9
    places = random.uniform(-0.5, 0.5, (40, 4, 3))
    places[..., 1] = height + places[..., [0, 2]] @ slope
    weight = torch.ones(40, 4, dtype=torch.float64)
    places[7], weight[7] = 3.0, 0.0
    normal, offset_m = fit_plane(torch.tensor(places), weight)
    expected = np.array([-slope[0], 1.0, -slope[1]]) / np.sqrt(1.0 + slope @ slope)
    # the prior for an upright camera holds the slope back a little
    assert normal.tolist() == pytest.approx(expected, abs=0.012)
    assert float(normal @ torch.tensor([0.0, height, 0.0], dtype=torch.float64)) == pytest.approx(
        float(offset_m), abs=0.002
    )


def test_a_single_contact_point_gives_no_tilt() -> None:
    random = np.random.default_rng(2)
    places = random.normal(0.0, 0.01, (30, 4, 3)) + [0.2, -0.9, -3.0]
    normal, offset_m = fit_plane(torch.tensor(places), torch.ones(30, 4, dtype=torch.float64))
    assert normal.tolist() == pytest.approx([0.0, 1.0, 0.0], abs=0.01)
    assert float(offset_m / normal[1]) == pytest.approx(-0.9, abs=0.04)


def test_speed_is_that_of_an_even_motion_whatever_the_frame_rate() -> None:
    time_s = torch.tensor([0.0, 0.1, 0.2, 0.35, 0.4, 0.6, 0.8], dtype=torch.float64)
    places = time_s[:, None, None] * torch.tensor([0.3, 0.0, -0.4], dtype=torch.float64).expand(7, 4, 3)
    assert compute_speed_m_s(places, time_s).flatten().tolist() == pytest.approx([0.5] * 28)


def test_feet_that_stand_are_held_where_they_are(standing: SyntheticRecording) -> None:
    contact = contact_of(standing, standing.state.root_m)
    assert contact is not None
    assert torch.equal(contact.weight, torch.ones(FRAMES, 4, 3, dtype=torch.float64))
    held = contact.target_m @ contact.axes
    assert (held - soles_m(standing, standing.state.root_m)).norm(dim=-1).max() < 0.01


def test_feet_that_slide_are_held_to_the_floor_only(standing: SyntheticRecording) -> None:
    slide = torch.arange(FRAMES, dtype=torch.float64)[:, None] * torch.tensor([0.08, 0.0, 0.0], dtype=torch.float64)
    contact = contact_of(standing, standing.state.root_m + slide)
    assert contact is not None
    assert contact.weight[..., 0].min() == 1.0
    assert contact.weight[..., 1:].max() == 0.0


def test_a_jump_is_not_pulled_down(standing: SyntheticRecording) -> None:
    root_m = standing.state.root_m.clone()
    root_m[5:7, 1] += 0.3
    contact = contact_of(standing, root_m)
    assert contact is not None
    assert contact.weight[5:7].max() == 0.0
    assert contact.weight[:4, :, 0].min() > 0.9


def test_undetected_feet_give_no_floor(standing: SyntheticRecording) -> None:
    assert contact_of(standing, standing.state.root_m, seen=0.1) is None


def test_gradient_agrees_with_differences_of_the_cost(standing: SyntheticRecording) -> None:
    contact = contact_of(standing, standing.state.root_m)
    assert contact is not None
    generator = torch.Generator().manual_seed(3)
    nothing = torch.zeros(0, dtype=torch.float64)
    moved = standing.state.moved(
        0.02 * torch.randn(FRAMES, NUMBERS, generator=generator, dtype=torch.float64), nothing, standing.camera
    )
    direction = torch.randn(FRAMES, NUMBERS, generator=generator, dtype=torch.float64)

    def system_at(step: float) -> NormalEquations:
        state = moved.moved(step * direction, nothing, standing.camera)
        system = NormalEquations.zeros(FRAMES, NUMBERS, 0)
        skeleton = pose_skeleton(standing.model, state.rotations, state.root_m)
        add_contact_term(system, standing.model, skeleton, state.root_m, standing.camera, contact)
        return system

    slope = 2.0 * float((system_at(0.0).frame_gradient * direction).sum())
    assert (system_at(1e-6).cost - system_at(-1e-6).cost) / 2e-6 == pytest.approx(slope, rel=1e-4)


def test_cost_of_one_sole_off_the_floor_is_that_of_its_distance(standing: SyntheticRecording) -> None:
    contact = contact_of(standing, standing.state.root_m)
    assert contact is not None
    only = torch.zeros_like(contact.weight)
    only[3, 2, 0] = 1.0
    contact = replace(contact, weight=only)
    root_m = standing.state.root_m + 0.5 * CONTACT_STD_M * contact.axes[0]
    system = NormalEquations.zeros(FRAMES, NUMBERS, 0)
    skeleton = pose_skeleton(standing.model, standing.state.rotations, root_m)
    add_contact_term(system, standing.model, skeleton, root_m, standing.camera, contact)
    off_m = float(soles_m(standing, root_m)[3, 2] @ contact.axes[0] - contact.target_m[3, 2, 0])
    squared = (off_m / CONTACT_STD_M) ** 2
    assert system.cost == pytest.approx(squared / (1.0 + squared / 9.0))
