import itertools
from dataclasses import replace

import numpy as np
import pytest
import torch

from pipeline.body.body import load_anny
from pipeline.body.fit.detections.left_right_swaps import (
    LIMB_SWAP_PAIRS,
    detect_body_swaps,
    detect_limb_swaps,
    swap_body_left_right,
    swap_limb_left_right,
    viterbi_two_labels,
)
from pipeline.body.fit.landmark_regressor import POSE_LANDMARK_COUNT, mirror_permutation
from pipeline.body.fit.linear_body import ACTIVE_JOINTS
from pipeline.geometry.camera import Camera
from pipeline.geometry.rotation import axis_angle_to_matrix
from tests.body.acting import SyntheticRecording, simulate_detections, swap_left_right, synthetic_recording
from tests.body.fit.test_initialisation import rest_landmarks_m


@pytest.fixture(scope="module")
def clean() -> SyntheticRecording:
    return synthetic_recording(load_anny(), 40, noise_m=0.01)


@pytest.fixture
def scene(clean: SyntheticRecording) -> SyntheticRecording:
    """Return a full turn whose landmarks a test may change."""
    return replace(clean, landmarks_px=clean.landmarks_px.copy(), landmarks_world_m=clean.landmarks_world_m.copy())


def test_viterbi_path_equals_exhaustive_search() -> None:
    random = np.random.default_rng(0)
    unary, same, other = random.random((7, 2)), random.random(6), random.random(6)

    def cost(labels: tuple[int, ...]) -> float:
        steps = sum((same, other)[int(a != b)][k] for k, (a, b) in enumerate(itertools.pairwise(labels)))
        return steps + sum(unary[k, label] for k, label in enumerate(labels))

    best = min(itertools.product((0, 1), repeat=7), key=cost)
    assert viterbi_two_labels(unary, same, other).tolist() == [bool(label) for label in best]


def test_no_swap_is_detected_in_a_clean_full_turn(scene: SyntheticRecording) -> None:
    observations = scene.observations(scene.camera)
    assert not detect_body_swaps(observations, rest_landmarks_m()).any()
    for limb in LIMB_SWAP_PAIRS:
        assert not detect_limb_swaps(observations, limb).any()


def turned(camera: Camera, about_y_rad: float, tilt_rad: float) -> Camera:
    """Return the camera with the world rotated about +Y, then tilted; the image stays the same."""
    rotation = camera.world_to_camera.copy()
    for axis in ([0.0, about_y_rad, 0.0], [tilt_rad, 0.0, 0.0]):
        rotation[:3, :3] = rotation[:3, :3] @ axis_angle_to_matrix(torch.tensor([axis]))[0].numpy()
    return replace(camera, world_to_camera=rotation)


@pytest.mark.parametrize("wrong", [slice(14, 19), slice(23, 27)])
@pytest.mark.parametrize(("about_y_deg", "tilt_deg"), [(0, 0), (60, 0), (-100, 0), (60, 20)])
def test_a_body_swap_is_detected_and_corrected(
    scene: SyntheticRecording, wrong: slice, about_y_deg: int, tilt_deg: int
) -> None:
    """The detection does not depend on the orientation of the camera."""
    camera = turned(scene.camera, np.radians(about_y_deg), np.radians(tilt_deg))
    truth = scene.observations(camera)
    swap_left_right(scene, wrong)
    observations = scene.observations(camera)
    left_right_swapped = detect_body_swaps(observations, rest_landmarks_m())
    assert np.flatnonzero(left_right_swapped).tolist() == list(range(wrong.start, wrong.stop))
    corrected = swap_body_left_right(observations, left_right_swapped)
    assert np.allclose(corrected.landmarks_px, truth.landmarks_px)
    assert np.allclose(corrected.landmarks_3d_m, truth.landmarks_3d_m)


def test_large_yaw_changes_over_long_intervals_are_no_swaps(scene: SyntheticRecording) -> None:
    """A turn of 3.6 s in eight frames, 51 degrees between frames."""
    observations = synthetic_recording(load_anny(), 8).observations(scene.camera)
    assert not detect_body_swaps(replace(observations, time_s=5 * observations.time_s), rest_landmarks_m()).any()


def test_a_body_swap_after_a_short_gap_is_detected() -> None:
    """At 30 frames per second: seven frames without a person, then three swapped ones."""
    scene = synthetic_recording(load_anny(), 20, turn_rad=0.8)
    swap_left_right(scene, slice(17, 20))
    scene.landmarks_px[10:17] = np.nan
    observations = scene.observations(scene.camera)
    left_right_swapped = detect_body_swaps(replace(observations, time_s=observations.time_s / 3), rest_landmarks_m())
    assert np.flatnonzero(left_right_swapped).tolist() == [17, 18, 19]


@pytest.mark.parametrize(("gap_s", "left_right_swapped"), [(0.1, [4]), (1.0, [])])
def test_legs_cross_within_a_second_but_not_within_a_tenth(gap_s: float, left_right_swapped: list[int]) -> None:
    """A stride seen from the side: four frames, then one frame of the opposite stride."""
    body = load_anny()
    scene = synthetic_recording(body, 5)
    angles = torch.zeros(5, len(ACTIVE_JOINTS), 3, dtype=torch.float64)
    angles[:, 0, 1] = 0.5 * np.pi
    for side, sign in (("Left", 1.0), ("Right", -1.0)):
        angles[:, ACTIVE_JOINTS.index(f"{side}UpLeg"), 0] = 0.45 * sign * torch.tensor([1.0, 1.0, 1.0, 1.0, -1.0])
    state = replace(scene.state, rotations=axis_angle_to_matrix(angles), root_m=scene.state.root_m[:1].repeat(5, 1))
    time_s = np.cumsum([0.0, 0.1, 0.1, 0.1, gap_s])
    observations = simulate_detections(body, scene.model, state, scene.camera, time_s).observations(scene.camera)
    assert np.flatnonzero(detect_limb_swaps(observations, "legs")).tolist() == left_right_swapped


def test_no_swap_is_detected_without_a_person(scene: SyntheticRecording) -> None:
    scene.landmarks_px[:] = np.nan
    observations = scene.observations(scene.camera)
    for left_right_swapped in (
        detect_body_swaps(observations, rest_landmarks_m()),
        detect_limb_swaps(observations, "legs"),
    ):
        assert left_right_swapped.tolist() == [False] * 40


@pytest.mark.parametrize("limb", list(LIMB_SWAP_PAIRS))
@pytest.mark.parametrize("wrong", [slice(0, 4), slice(10, 11), slice(29, 30)])
def test_limb_swaps_are_detected_and_corrected(scene: SyntheticRecording, limb: str, wrong: slice) -> None:
    """Several frames at the start, and single frames in side views (92 and -92 degrees)."""
    truth = scene.observations(scene.camera)
    order = mirror_permutation(LIMB_SWAP_PAIRS[limb].swapped)[:POSE_LANDMARK_COUNT]
    scene.landmarks_px[wrong] = scene.landmarks_px[wrong][:, order]
    scene.landmarks_world_m[wrong] = scene.landmarks_world_m[wrong][:, order]
    observations = scene.observations(scene.camera)
    left_right_swapped = detect_limb_swaps(observations, limb)
    assert np.flatnonzero(left_right_swapped).tolist() == list(range(wrong.start, wrong.stop))
    assert not detect_body_swaps(observations, rest_landmarks_m()).any()
    assert np.allclose(swap_limb_left_right(observations, left_right_swapped, limb).landmarks_px, truth.landmarks_px)
