"""Mirrored forearms of a person who turns: found, and put back with elbows, picture and hinge as they are."""

import math

import pytest
import torch
from torch import Tensor

from pipeline.body.body import load_anny
from pipeline.body.fit.linear_body import ACTIVE_JOINTS, LinearBody, linearise_body
from pipeline.body.fit.posed_points import pose_skeleton
from pipeline.body.fit.prior.forearm_flips import flipped_frames, unflip_forearms
from pipeline.body.fit.state import FitState
from pipeline.geometry.camera import Camera
from pipeline.geometry.rotation import axis_angle_to_matrix

FRAMES = 48
CAMERA = Camera(600.0, 600.0, 240.0, 320.0, 480, 640)
ARM, FOREARM, HAND = (ACTIVE_JOINTS.index(f"Left{part}") for part in ("Arm", "ForeArm", "Hand"))


@pytest.fixture(scope="module")
def model() -> LinearBody:
    body = load_anny()
    return linearise_body(body, body.shape_defaults)


def turning_person(model: LinearBody, elbow_rad: Tensor, turn_rad: float = 2.0) -> FitState:
    """A person who turns to both sides, with the left elbow bent by some angle in each frame."""
    angles = torch.zeros(FRAMES, len(ACTIVE_JOINTS), 3, dtype=torch.float64)
    angles[:, 0, 1] = torch.linspace(-turn_rad, turn_rad, FRAMES, dtype=torch.float64)
    angles[:, FOREARM, 1] = -elbow_rad
    root_m = torch.tensor([[0.0, 0.0, -3.0]], dtype=torch.float64).expand(FRAMES, 3).clone()
    none = torch.zeros(3, dtype=torch.float64)
    return FitState(axis_angle_to_matrix(angles), root_m, model.shape, none, none)


def joints_m(model: LinearBody, state: FitState) -> Tensor:
    return pose_skeleton(model, state.rotations, state.root_m).position_m


def mirrored(model: LinearBody, state: FitState, rows: Tensor) -> FitState:
    """The state with the left wrist of some frames mirrored along the view, by the shortest rotation of the forearm.

    Those whose wrist moves by less than 15 cm stay as they are.
    """
    skeleton = pose_skeleton(model, state.rotations, state.root_m)
    lower_m = skeleton.position_m[:, HAND] - skeleton.position_m[:, FOREARM]
    view = torch.nn.functional.normalize(skeleton.position_m[:, FOREARM], dim=-1)  # the camera is at the origin
    other_m = lower_m - 2.0 * (lower_m * view).sum(-1, keepdim=True) * view
    axis = torch.linalg.cross(lower_m, other_m)
    angle = torch.atan2(axis.norm(dim=-1), (lower_m * other_m).sum(-1))
    turn = axis_angle_to_matrix(angle[:, None] * torch.nn.functional.normalize(axis, dim=-1))
    rotations = state.rotations.clone()
    forearm = skeleton.rotation[:, ARM].mT @ turn @ skeleton.rotation[:, FOREARM]
    rows = rows & ((other_m - lower_m).norm(dim=-1) > 0.15)
    rotations[rows, FOREARM] = forearm[rows]
    return FitState(rotations, state.root_m, state.shape, state.landmark_offsets_m, state.intrinsics_delta)


def test_forearms_are_put_back(model: LinearBody) -> None:
    state = turning_person(model, torch.full((FRAMES,), 1.4, dtype=torch.float64))
    rows = state.rotations[:, 0, 0, 2].abs() > 0.6
    wrong = mirrored(model, state, rows)
    true_m, wrong_m = joints_m(model, state), joints_m(model, wrong)
    assert 10 < int(((wrong_m - true_m)[:, HAND].norm(dim=-1) > 0.15).sum()) < FRAMES - 10
    found_m = joints_m(model, unflip_forearms(model, wrong, CAMERA))
    assert float((found_m - true_m)[:, [ARM, FOREARM, HAND]].norm(dim=-1).max()) < 1e-6


def test_the_elbow_bends_about_its_hinge(model: LinearBody) -> None:
    state = turning_person(model, torch.full((FRAMES,), 1.4, dtype=torch.float64))
    rows = state.rotations[:, 0, 0, 2].abs() > 0.6
    wrong = mirrored(model, state, rows)
    hinges = []
    for changed in (wrong, unflip_forearms(model, wrong, CAMERA)):
        skeleton = pose_skeleton(model, changed.rotations, changed.root_m)
        upper, lower = (
            skeleton.position_m[:, b] - skeleton.position_m[:, a] for a, b in ((ARM, FOREARM), (FOREARM, HAND))
        )
        hinge = torch.nn.functional.normalize(torch.linalg.cross(upper, lower), dim=-1)
        hinges.append((skeleton.rotation[:, ARM].mT @ hinge[..., None])[..., 0])
    torch.testing.assert_close(*hinges)


@pytest.mark.parametrize(("elbow_rad", "turn_rad"), [(0.1, 2.0), (1.4, 2.0), (1.4, 0.3)])
def test_arms_that_are_still_do_not_change(model: LinearBody, elbow_rad: float, turn_rad: float) -> None:
    state = turning_person(model, torch.full((FRAMES,), elbow_rad, dtype=torch.float64), turn_rad)
    assert torch.equal(unflip_forearms(model, state, CAMERA).rotations, state.rotations)


def test_arms_that_move_do_not_change(model: LinearBody) -> None:
    swing = 0.8 + 0.8 * torch.sin(torch.arange(FRAMES, dtype=torch.float64) / 3.0)
    state = turning_person(model, swing)
    assert torch.equal(unflip_forearms(model, state, CAMERA).rotations, state.rotations)


def test_who_is_filmed_from_one_side_does_not_change(model: LinearBody) -> None:
    state = turning_person(model, torch.full((FRAMES,), 1.4, dtype=torch.float64), 0.5)
    wrong = mirrored(model, state, torch.arange(FRAMES) % 2 == 0)
    assert torch.equal(unflip_forearms(model, wrong, CAMERA).rotations, wrong.rotations)


def test_random_directions_have_no_common_one() -> None:
    random = torch.Generator().manual_seed(1)
    directions = torch.nn.functional.normalize(torch.randn(200, 2, 3, generator=random, dtype=torch.float64), dim=-1)
    assert not flipped_frames(directions).any()


def test_a_few_frames_may_do_something_else() -> None:
    """Of forty directions a quarter is mirrored, and three are of another movement."""
    random = torch.Generator().manual_seed(2)
    common = torch.tensor([0.6, -0.6, math.sqrt(0.28)], dtype=torch.float64)
    right = common + 0.05 * torch.randn(40, 3, generator=random, dtype=torch.float64)
    wrong = right + torch.tensor([0.0, 1.0, -1.0]) * (1 + torch.rand(40, 1, generator=random, dtype=torch.float64))
    directions = torch.nn.functional.normalize(torch.stack([right, wrong], dim=1), dim=-1)
    mirrored_rows = torch.arange(40) % 4 == 1
    directions[mirrored_rows] = directions[mirrored_rows].flip(1)
    directions[[3, 10, 18]] = -common
    found = flipped_frames(directions)
    assert torch.equal(found, mirrored_rows)


def test_what_an_arm_that_is_still_sways_is_kept() -> None:
    angle_rad = torch.where(torch.arange(40) % 2 == 0, 0.2, -0.2).double()
    directions = torch.stack([angle_rad.cos(), torch.zeros(40).double(), angle_rad.sin()], dim=-1)
    mirror_image = directions * torch.tensor([1.0, 1.0, -1.0], dtype=torch.float64)
    assert not flipped_frames(torch.stack([directions, mirror_image], dim=1)).any()
