"""Legs of the canonical pose: which clothes hang from leg to leg, and the same posed body from another rest pose."""

import numpy as np
import pytest
import torch

from pipeline.body.body import Body, Motion, canonical_to_world, load_anny
from pipeline.body.filmed_legs import HEIGHTS, LegProfile, leg_profile, rest_with_filmed_legs
from pipeline.body.fit.silhouette_icp import crop_mask_window
from pipeline.geometry.camera import Camera, project
from pipeline.geometry.rotation import axis_angle_to_matrix, matrix_to_quaternion
from pipeline.geometry.skinning import linear_blend_skinning
from pipeline.kernels.raster import rasterize

SIDE_PX, FRAMES = 400, 3
WORLD_TO_CAMERA = np.diag([1.0, -1.0, -1.0, 1.0]).astype(np.float32)
WORLD_TO_CAMERA[:3, 3] = (0.0, 0.85, 3.0)
CAMERA = Camera(600.0, 600.0, 200.0, 200.0, SIDE_PX, SIDE_PX, WORLD_TO_CAMERA)


@pytest.fixture(scope="module")
def body() -> Body:
    anny = load_anny()
    return anny.at_shape(anny.shape_defaults)


def motion_of(body: Body, bends: dict[str, tuple[float, float, float]], frames: int = FRAMES) -> Motion:
    """The A-pose with some joints rotated (rad), in every frame."""
    rotations = torch.eye(3).repeat(frames, len(body.joint_names), 1, 1)
    for name, vector in bends.items():
        rotations[:, body.joint(name)] = axis_angle_to_matrix(torch.tensor([vector]))[0]
    root_m = np.tile(body.joints_m[:1], (frames, 1)) + [[0.1, 0.0, 0.2]]
    index = np.arange(frames)
    return Motion(index, index / 10.0, matrix_to_quaternion(rotations).numpy(), root_m.astype(np.float32))


def silhouette(body: Body) -> np.ndarray:
    return mask_of(body.vertices, body.faces, CAMERA)


def mask_of(vertices_m: np.ndarray, faces: np.ndarray, camera: Camera) -> np.ndarray:
    vertices_px, depth_m = project(torch.as_tensor(vertices_m, dtype=torch.float32), camera)
    return rasterize(vertices_px, depth_m, torch.as_tensor(faces, dtype=torch.int32), SIDE_PX, SIDE_PX)[0].numpy() >= 0


def camera_at(height_m: float) -> Camera:
    """A camera 3 m in front of the axis of the body that looks at its middle."""
    pitch_rad = np.arctan2(height_m - 0.85, 3.0)
    down, forward = np.sin(pitch_rad), np.cos(pitch_rad)
    pose = np.eye(4, dtype=np.float32)
    pose[:3, :3] = [[1.0, 0.0, 0.0], [0.0, -forward, down], [0.0, -down, -forward]]
    pose[:3, 3] = -pose[:3, :3] @ [0.0, height_m, 3.0]
    return Camera(600.0, 600.0, 200.0, 200.0, SIDE_PX, SIDE_PX, pose)


def skirt_surface(body: Body, hem_m: float, radius_m: float) -> tuple[np.ndarray, np.ndarray]:
    """Vertices and faces of a cone without ends, from the hips to a hem of a radius."""
    angle_rad = np.linspace(0.0, 2.0 * np.pi, 64, endpoint=False)
    ring = np.stack([np.cos(angle_rad), 0.0 * angle_rad, np.sin(angle_rad)], axis=1)
    middle_m = body.joints_m[body.joint("LeftUpLeg")] * [0.0, 0.0, 1.0]
    vertices_m = np.concatenate([0.17 * ring + [0.0, 0.95, 0.0], radius_m * ring + [0.0, hem_m, 0.0]]) + middle_m
    k, after = np.arange(64), (np.arange(64) + 1) % 64
    return vertices_m, np.concatenate([np.stack([k, after, k + 64], 1), np.stack([after, after + 64, k + 64], 1)])


def row_px(height_m: float) -> int:
    return int(project(torch.tensor([[0.0, height_m, 0.0]]), CAMERA)[0][0, 1])


def dressed(body: Body, hem_m: float, margin_px: int, between: bool) -> np.ndarray:
    """The silhouette with cloth from the hips to a hem, wider than the legs, with or without a gap between them."""
    mask = silhouette(body)
    centre_px = int(project(torch.zeros(1, 3), CAMERA)[0][0, 0])
    for row in range(row_px(0.9), row_px(hem_m)):
        legs = np.flatnonzero(mask[row, centre_px - 80 : centre_px + 80]) + centre_px - 80
        cloth = np.zeros(SIDE_PX, dtype=bool)
        cloth[legs.min() - margin_px : legs.max() + margin_px + 1] = True
        if not between:
            inside = ~mask[row] & (np.arange(SIDE_PX) > legs.min()) & (np.arange(SIDE_PX) < legs.max())
            cloth &= ~inside
        mask[row] |= cloth
    return mask


def profile_of(body: Body, mask: np.ndarray, camera: Camera = CAMERA) -> LegProfile:
    windows = [crop_mask_window(np.where(mask, np.uint8(255), np.uint8(0)))] * FRAMES
    motion = motion_of(body, {})
    motion = motion.with_pose(motion.rotations_wxyz, np.tile(body.joints_m[:1], (FRAMES, 1)))
    return leg_profile(body, motion, camera, windows, np.ones(FRAMES, dtype=bool))


def outline_hem_m(profile: LegProfile, body: Body) -> float:
    """Height at which cloth ends in the pictures, m; nan without a hem."""
    height = profile.outline_hem()
    return float("nan") if height is None else body.height_on_legs_m(height)


def test_bare_legs_and_trousers_hang_apart(body: Body) -> None:
    profile = profile_of(body, silhouette(body))
    assert np.nanmax(profile.margin_m) < 0.01
    assert profile.open_px.sum() > 0.9 * profile.gap_px.sum() > 0.0
    assert profile.hem_height() is None
    assert not profile_of(body, dressed(body, 0.1, 2, False)).cloth_hangs_between_legs()


def test_a_skirt_ends_at_its_hem(body: Body) -> None:
    profile = profile_of(body, dressed(body, 0.6, 12, True))
    assert outline_hem_m(profile, body) == pytest.approx(0.6, abs=0.01)
    knee_m, hip_m = (body.joints_m[body.joint(name), 1] for name in ("LeftLeg", "LeftUpLeg"))
    hem = (hip_m - 0.6) / (hip_m - knee_m)
    above = (HEIGHTS > 0.35) & (hem - 0.1 > HEIGHTS)
    assert np.nanmin(profile.margin_m[above]) == pytest.approx(12 * 3.0 / 600.0, abs=0.01)


@pytest.mark.parametrize(("radius_m", "camera_m"), [(0.4, 2.0), (0.4, 0.5), (0.3, 1.6), (0.25, 1.3)])
def test_the_near_side_of_a_hem_is_not_taken_for_its_height(body: Body, radius_m: float, camera_m: float) -> None:
    """Seen from above the outline ends up to 12 cm below the hem."""
    camera = camera_at(camera_m)
    mask = mask_of(body.vertices, body.faces, camera) | mask_of(*skirt_surface(body, 0.5, radius_m), camera)
    profile = profile_of(body, mask, camera)
    assert body.height_on_legs_m(profile.hem_height() or np.nan) == pytest.approx(0.5, abs=0.025)
    assert camera_m < 1.0 or outline_hem_m(profile, body) < 0.5 - 0.015


def test_a_skirt_with_a_wide_hem_stands_off(body: Body) -> None:
    """A pixel is 5 mm."""
    assert profile_of(body, dressed(body, 0.5, 16, between=True)).stands_off()
    assert not profile_of(body, dressed(body, 0.5, 5, between=True)).stands_off()
    assert not profile_of(body, silhouette(body)).stands_off()


def test_a_close_skirt_covers_the_gap(body: Body) -> None:
    """Its hem is no step: the fitted hips are as wide as the skirt."""
    profile = profile_of(body, dressed(body, 0.6, 2, True))
    assert np.nanmax(profile.margin_m) < 0.02
    assert outline_hem_m(profile, body) == pytest.approx(0.6, abs=0.01)


@pytest.mark.parametrize("hem_m", [0.45, 0.3, 0.2])
def test_long_skirts_end_at_their_hems(body: Body, hem_m: float) -> None:
    """The last is below all heights that tell a skirt."""
    assert outline_hem_m(profile_of(body, dressed(body, hem_m, 14, True)), body) == pytest.approx(hem_m, abs=0.015)


@pytest.mark.parametrize("hem_m", [0.12, 0.05, 0.02])
def test_cloth_down_to_the_floor_ends_where_masks_end(body: Body, hem_m: float) -> None:
    """Below the ankles; the outline of such cloth says little of the legs."""
    profile = profile_of(body, dressed(body, hem_m, 14, True))
    assert profile.reaches_floor()
    assert profile.stands_off()
    assert outline_hem_m(profile, body) == pytest.approx(hem_m, abs=0.015)
    assert not profile_of(body, dressed(body, 0.3, 14, True)).reaches_floor()


def test_through_wide_shorts_the_background_is_seen(body: Body) -> None:
    assert not profile_of(body, dressed(body, 0.6, 12, False)).cloth_hangs_between_legs()


def test_a_long_shirt_ends_above_the_legs(body: Body) -> None:
    assert not profile_of(body, dressed(body, 0.85, 12, True)).cloth_hangs_between_legs()


def test_trousers_that_touch_each_other_down_to_the_floor_are_no_skirt() -> None:
    """Shins stand 3 cm from each other. Where the background is seen below, or they stand farther apart, it is one."""
    margin_m, rows = np.full(len(HEIGHTS), 0.004), HEIGHTS
    narrow_px, covered = np.interp(rows, (0.7, 1.2), (0.0, 4.5)), np.zeros(len(rows))

    def is_skirt(gap_px: np.ndarray, open_px: np.ndarray) -> bool:
        return LegProfile(margin_m, gap_px, open_px, 0.1 + margin_m, 0.0 * rows, 0.4).cloth_hangs_between_legs()

    assert not is_skirt(narrow_px, covered)
    assert is_skirt(2.0 * narrow_px, covered)
    assert is_skirt(narrow_px, np.where(rows >= 1.4, narrow_px, 0.0))
    assert not is_skirt(narrow_px, np.where(rows <= 1.0, narrow_px, 0.0))


def test_frames_without_masks_tell_nothing(body: Body) -> None:
    motion = motion_of(body, {})
    profile = leg_profile(body, motion, CAMERA, [None] * FRAMES, np.ones(FRAMES, dtype=bool))
    assert np.isnan(profile.margin_m).all()
    assert not profile.cloth_hangs_between_legs()


CLOSED_LEGS = {
    "LeftUpLeg": (0.05, 0.02, -0.10),
    "RightUpLeg": (0.02, 0.00, 0.12),
    "LeftLeg": (0.06, 0.0, 0.0),
    "LeftFoot": (-0.05, 0.1, 0.0),
    "Spine": (0.1, 0.0, 0.0),
}


def test_the_posed_body_stays(body: Body) -> None:
    motion = motion_of(body, CLOSED_LEGS)
    rest = rest_with_filmed_legs(body, motion, np.ones(FRAMES, dtype=bool))
    weights = torch.from_numpy(body.skin_weights)
    before, after = (
        linear_blend_skinning(torch.from_numpy(each.vertices), weights, canonical_to_world(each, poses))
        for each, poses in ((body, motion), (rest.body, rest.motion))
    )
    distance_mm = 1e3 * (before - after).norm(dim=2)
    rigid = body.skin_weights.max(axis=1) > 0.999
    assert rigid.sum() > 1000
    assert float(distance_mm[:, rigid].max()) < 0.01
    assert float(distance_mm.max()) < 5.0
    assert rest.motion.root_translation_m == pytest.approx(motion.root_translation_m)


def test_the_canonical_legs_are_the_filmed_ones(body: Body) -> None:
    motion = motion_of(body, CLOSED_LEGS)
    rest = rest_with_filmed_legs(body, motion, np.ones(FRAMES, dtype=bool))
    identity = [1.0, 0.0, 0.0, 0.0]
    for name in ("LeftUpLeg", "RightUpLeg", "LeftLeg", "RightLeg"):
        assert np.abs(rest.motion.rotations_wxyz[0, body.joint(name)]) == pytest.approx(identity, abs=1e-5)
    feet = [body.joint("LeftFoot"), body.joint("RightFoot")]
    assert np.ptp(rest.body.joints_m[feet, 0]) < np.ptp(body.joints_m[feet, 0]) - 0.1
    assert rest.body.vertices[:, 1].min() == pytest.approx(0.0, abs=1e-6)
    toes = body.joint("LeftToeBase")
    sole, old = (each.joints_m[toes] - each.joints_m[feet[0]] for each in (rest.body, body))
    assert sole == pytest.approx(old, abs=1e-6)


def test_only_the_chosen_frames_count(body: Body) -> None:
    """The legs of a frame that is not used are not part of the mean."""
    motion = motion_of(body, CLOSED_LEGS)
    rotations = motion.rotations_wxyz.copy()
    rotations[0] = motion_of(body, {"LeftUpLeg": (0.8, 0.0, 0.0)}).rotations_wxyz[0]
    used = np.array([False, True, True])
    rest = rest_with_filmed_legs(body, motion.with_pose(rotations, motion.root_translation_m), used)
    expected = rest_with_filmed_legs(body, motion, used)
    assert rest.body.joints_m == pytest.approx(expected.body.joints_m, abs=1e-6)


def shin_gap_m(body: Body) -> float:
    """Distance between what hangs below the knees, along x."""
    below = body.joints_m[body.joint("LeftLeg"), 1] - 0.05
    shins = body.vertices[body.vertices[:, 1] < below]
    return float(shins[shins[:, 0] > 0.0, 0].min() - shins[shins[:, 0] < 0.0, 0].max())


def test_closed_legs_are_opened_until_trousers_have_room(body: Body) -> None:
    """Feet side by side: below a coat, trousers would grow together."""
    together = {"LeftUpLeg": (0.0, 0.0, -0.14), "RightUpLeg": (0.0, 0.0, 0.14)}
    motion = motion_of(body, together)
    rest = rest_with_filmed_legs(body, motion, np.ones(FRAMES, dtype=bool))
    assert shin_gap_m(rest.body) == pytest.approx(0.06, abs=0.005)
    weights = torch.from_numpy(body.skin_weights)
    before, after = (
        linear_blend_skinning(torch.from_numpy(each.vertices), weights, canonical_to_world(each, poses))
        for each, poses in ((body, motion), (rest.body, rest.motion))
    )
    rigid = body.skin_weights.max(axis=1) > 0.999
    assert float((before - after)[:, rigid].norm(dim=2).max()) < 1e-5
