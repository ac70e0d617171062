"""Evidence: what frames show, from which side, and how much of a full turn is enough."""

from dataclasses import replace

import numpy as np
import pytest
import torch

from pipeline.body.body import Body
from pipeline.geometry.camera import Camera
from pipeline.geometry.rotation import axis_angle_to_matrix
from pipeline.mesh.extraction import evidence
from pipeline.mesh.extraction.evidence import (
    AMBIGUOUS_FADE_M,
    AMBIGUOUS_REACH_M,
    CONTRADICTED_SHARE,
    DEPTH_SHARE,
    is_copy,
    is_told_by_colours_alone,
    share_beside_masks,
    surface_evidence,
    with_emptiness,
)
from pipeline.mesh.extraction.isosurface import sample_canonical_grid
from pipeline.mesh.views import PosedView
from tests.mesh.capsule import BOUNDS_M, RADIUS_M, SETTINGS, VOXEL_SIZE_M, capsule_body, capsule_distance, shell_density

CAMERA, DISTANCE_M = Camera(600.0, 600.0, 80.0, 60.0, 160, 120), 3.0


@pytest.fixture(scope="module")
def body() -> Body:
    return capsule_body()


def view_from(angle_rad: float) -> PosedView:
    """The capsule, turned about its own axis (x) before a camera that looks along -Z."""
    turn = torch.eye(4)
    turn[:3, :3] = axis_angle_to_matrix(torch.tensor([angle_rad, 0.0, 0.0]))
    turn[:3, 3] = torch.tensor([0.0, 0.0, -DISTANCE_M]) - turn[:3, :3] @ torch.tensor([0.0, 0.5, 0.0])
    blank = torch.zeros(CAMERA.height, CAMERA.width, dtype=torch.uint8)
    return PosedView(blank[..., None].expand(-1, -1, 3), blank, CAMERA, turn.expand(2, 4, 4))


def height_on_side(body: Body) -> np.ndarray:
    """Cosine between the normal of a vertex on the straight part and +Z; nan at the caps."""
    straight = np.abs(body.vertices[:, 0]) < 0.2
    return np.where(straight, body.vertices[:, 2] / 0.1, np.nan)


def test_one_side_is_seen_and_the_other_is_not(body: Body) -> None:
    evidence, cosine = surface_evidence(body, [view_from(angle) for angle in (-0.9, 0.0, 0.9)]), height_on_side(body)
    assert (evidence[cosine > 0.9] > 0.95).all()
    assert (evidence[cosine < -0.9] == 0.0).all()


def test_frames_from_one_side_tell_outlines_and_no_depth(body: Body) -> None:
    """The evidence of a side is 1; that of the front rises with the filmed arc, from one minus `DEPTH_SHARE`."""
    front, side = height_on_side(body) > 0.97, np.abs(height_on_side(body) - 0.1) < 0.05
    assert (surface_evidence(body, [view_from(0.0)])[side] == 1.0).all()
    arcs_rad = np.radians([0.0, 80.0, 110.0, 160.0])
    found = [
        surface_evidence(body, [view_from(angle) for angle in np.linspace(-0.5, 0.5, 9) * arc])[front].mean()
        for arc in arcs_rad
    ]
    assert found[0] == pytest.approx(1.0 - DEPTH_SHARE, abs=1e-4)
    assert found[0] < found[1] < found[2] - 0.1 < found[3] - 0.2


def test_a_turn_shows_all_sides(body: Body) -> None:
    views = [view_from(2.0 * np.pi * k / 12) for k in range(12)]
    assert (surface_evidence(body, views)[np.isfinite(height_on_side(body))] == 1.0).all()


def test_evidence_is_the_mean_squared_cosine(body: Body) -> None:
    """Two views in 80 from the front, the others from behind: the middle of the front has 1/40 cos², half of enough."""
    evidence = surface_evidence(body, [view_from(-0.6), view_from(0.6), *[view_from(np.pi)] * 78])
    assert evidence[height_on_side(body) > 0.97].mean() == pytest.approx(0.5 * np.cos(0.6) ** 2, abs=0.05)


def masked_view_from(angle_rad: float, radius_m: float = 0.15) -> PosedView:
    """The view with the mask of a capsule of that radius, which looks the same from all sides."""
    view, rows = view_from(angle_rad), np.arange(CAMERA.height)[:, None]
    x_m = (np.arange(CAMERA.width)[None] + 0.5 - CAMERA.cx) * DISTANCE_M / CAMERA.fx
    y_m = (rows + 0.5 - CAMERA.cy) * DISTANCE_M / CAMERA.fy
    covered = capsule_distance(np.stack(np.broadcast_arrays(x_m, 0.5 - y_m, 0.0), axis=-1)) < radius_m
    return replace(view, mask=torch.from_numpy(255 * covered.astype(np.uint8)))


def test_a_point_beside_some_masks_has_their_share(body: Body) -> None:
    """20 cm above the axis of the capsule, towards the camera in two of the four views."""
    views = [masked_view_from(0.5 * np.pi * k) for k in range(4)]
    points_m = np.array([[0.0, 0.7, 0.0], [0.0, 0.5, 0.2], [0.0, 0.55, 0.0], [3.0, 0.7, 0.0]])
    np.testing.assert_array_equal(share_beside_masks(points_m, body, views), [0.5, 0.5, 0.0, 0.0])


def test_density_that_masks_contradict_is_empty(body: Body) -> None:
    """The shell reaches 0.14 m from the axis, the floater 0.23 m; masks reach 0.15 m."""
    samples = sample_canonical_grid(shell_density, BOUNDS_M, body, 0.5 * VOXEL_SIZE_M, SETTINGS)
    views = [masked_view_from(2.0 * np.pi * k / 12) for k in range(12)]
    emptiness = with_emptiness(samples, body, views).emptiness
    indices = np.argwhere(samples.density > 0.0)
    distance_m = capsule_distance(indices * samples.spacing_m + samples.origin_m)
    found = emptiness[tuple(indices.T)]
    assert found[distance_m > 0.2].mean() > 0.9
    assert found[distance_m < 0.13].max() == 0.0
    few = [*views[:1], *[masked_view_from(0.0, 1.0)] * round(1.0 / CONTRADICTED_SHARE)]
    assert not with_emptiness(samples, body, few).emptiness.any()


def bent_view(angle_rad: float) -> PosedView:
    """The capsule with its end at positive x turned up about the joint, over the other half at 130 degrees."""
    bent, joint_m = torch.eye(4).repeat(2, 1, 1), torch.tensor([0.05, 0.5, 0.0])
    bent[1, :3, :3] = axis_angle_to_matrix(torch.tensor([0.0, 0.0, angle_rad]))
    bent[1, :3, 3] = joint_m - bent[1, :3, :3] @ joint_m
    return replace(view_from(0.0), canonical_to_world=bent)


def test_what_a_pose_brings_to_the_body_is_a_copy(body: Body) -> None:
    """Above the end, inside the crook, but not below it, and nothing in a straight pose or next to the surface."""
    above_m, below_m, near_m = ([0.2, 0.5 + height_m, 0.0] for height_m in (0.16, -0.16, 0.11))
    points_m = np.array([above_m, below_m, near_m])
    bent, straight = bent_view(np.radians(130.0)), bent_view(0.0)
    np.testing.assert_array_equal(is_copy(points_m, body, [bent] * 3), [True, False, False])
    assert not is_copy(points_m, body, [straight, straight, bent]).any()


def test_the_copy_of_a_shell_is_empty(body: Body) -> None:
    """All of the shell inside the crook that is not next to the body; the outside stays."""
    samples = sample_canonical_grid(shell_density, BOUNDS_M, body, 0.5 * VOXEL_SIZE_M, SETTINGS)
    view = replace(bent_view(np.radians(130.0)), mask=torch.full((CAMERA.height, CAMERA.width), 255, dtype=torch.uint8))
    emptiness = with_emptiness(samples, body, [view]).emptiness
    points_m = np.argwhere(samples.density > 0.0) * samples.spacing_m + samples.origin_m
    found = emptiness[samples.density > 0.0]
    along, far = np.abs(points_m[:, 0] - 0.2) < 0.05, capsule_distance(points_m) > RADIUS_M + 0.025
    assert found[along & far & (points_m[:, 1] > 0.6)].mean() > 0.9
    assert found[along & (points_m[:, 1] < 0.5)].max() == 0.0


def test_the_surface_is_arbitrary_where_a_copy_was(body: Body) -> None:
    """Ambiguous are emptied samples of the shell; near them views tell nothing, elsewhere as much as before."""
    samples = sample_canonical_grid(shell_density, BOUNDS_M, body, 0.5 * VOXEL_SIZE_M, SETTINGS)
    view = replace(bent_view(np.radians(130.0)), mask=torch.full((CAMERA.height, CAMERA.width), 255, dtype=torch.uint8))
    ambiguous_m = with_emptiness(samples, body, [view]).ambiguous_m
    assert len(ambiguous_m) > 20
    assert (shell_density(torch.from_numpy(ambiguous_m)) > 0.0).all()
    assert len(with_emptiness(replace(samples, crotch_m=2.0), body, [view]).ambiguous_m) == 0
    turn = [view_from(2.0 * np.pi * k / 12) for k in range(12)]
    before, after = surface_evidence(body, turn), surface_evidence(body, turn, ambiguous_m)
    distance_m = np.linalg.norm(body.vertices[:, None] - ambiguous_m[None], axis=2).min(axis=1)
    assert (after[distance_m < AMBIGUOUS_REACH_M] == 0.0).all()
    assert (before[distance_m < AMBIGUOUS_REACH_M] > 0.0).any()
    far = distance_m > AMBIGUOUS_REACH_M + AMBIGUOUS_FADE_M
    np.testing.assert_array_equal(after[far], before[far])


def test_a_pit_in_cloth_is_no_copy(body: Body, monkeypatch: pytest.MonkeyPatch) -> None:
    """Of the samples above the middle those within 2 cm stay in the shell around them, those within 10 cm do not."""
    samples = sample_canonical_grid(shell_density, BOUNDS_M, body, 0.5 * VOXEL_SIZE_M, SETTINGS)
    view = replace(bent_view(0.0), mask=torch.full((CAMERA.height, CAMERA.width), 255, dtype=torch.uint8))

    def emptied_m3(radius_m: float) -> float:
        def is_near_the_middle(points_m: np.ndarray, *_: object) -> np.ndarray:
            return (np.hypot(points_m[:, 0], points_m[:, 2]) < radius_m) & (points_m[:, 1] > 0.5)

        monkeypatch.setattr(evidence, "is_copy", is_near_the_middle)
        found = with_emptiness(samples, body, [view]).emptiness * (samples.density > 0.0)
        return float(found.sum() * samples.spacing_m**3)

    thickness_m = 0.03  # of what is more than a centimetre off the body
    assert emptied_m3(0.02) < 0.1 * np.pi * 0.02**2 * thickness_m
    assert emptied_m3(0.10) > 0.3 * np.pi * 0.10**2 * thickness_m


def covering_view(angle_deg: float = 150.0) -> PosedView:
    """The end at positive x is turned towards the camera, from 120 degrees on in front of the other half."""
    turned, joint_m = torch.eye(4).repeat(2, 1, 1), torch.tensor([0.05, 0.5, 0.0])
    turned[1, :3, :3] = axis_angle_to_matrix(torch.tensor([0.0, -np.radians(angle_deg), 0.0]))
    turned[1, :3, 3] = joint_m - turned[1, :3, :3] @ joint_m
    view, white = view_from(0.0), torch.full((CAMERA.height, CAMERA.width), 255, dtype=torch.uint8)
    return replace(view, mask=white, canonical_to_world=view.canonical_to_world @ turned)


def test_what_covers_another_part_in_most_views_is_told_by_colours_alone(body: Body) -> None:
    """Five centimetres beyond the tip, not as far in front of its own part, and not where an outline shows it."""
    beyond_m, in_front_m, near_m = [0.45, 0.5, 0.0], [0.2, 0.5, 0.15], [0.42, 0.5, 0.0]
    points_m = np.array([beyond_m, in_front_m, near_m])
    covering, beside = covering_view(), covering_view(60.0)
    found = is_told_by_colours_alone(points_m, body, [covering] * 3)
    np.testing.assert_array_equal(found, [True, False, False])
    assert not is_told_by_colours_alone(points_m, body, [covering, beside]).any()
    assert not is_told_by_colours_alone(points_m, body, [beside]).any()


def test_density_that_colours_alone_tell_of_is_empty(body: Body) -> None:
    samples = sample_canonical_grid(shell_density, BOUNDS_M, body, 0.5 * VOXEL_SIZE_M, SETTINGS)
    points_m = np.argwhere(samples.density > 0.0) * samples.spacing_m + samples.origin_m
    beyond = (points_m[:, 0] > 0.43) & (np.abs(points_m[:, 1:] - [0.5, 0.0]) < 0.045).all(axis=1)
    emptiness = with_emptiness(samples, body, [covering_view()]).emptiness[samples.density > 0.0]
    assert beyond.sum() > 10
    assert emptiness[beyond].min() >= 0.5
    assert emptiness[beyond].mean() > 0.7
    outside_the_bend = (np.abs(points_m[:, 0] - 0.2) < 0.05) & (points_m[:, 2] < -0.05)
    assert emptiness[outside_the_bend].max() == 0.0
