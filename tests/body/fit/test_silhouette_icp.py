import cv2
import numpy as np
import pytest
import torch

from pipeline.body.body import load_anny
from pipeline.body.fit.linear_body import ACTIVE_JOINTS
from pipeline.body.fit.silhouette_icp import (
    crop_mask_window,
    distance_px,
    find_correspondences,
    mask_weights,
    match_silhouettes,
    outline_pixels,
    outward_normals,
    posed_vertices,
    signed_distance,
)
from pipeline.geometry.skinning import forward_kinematics, linear_blend_skinning, skinning_transforms
from pipeline.metrics.images import mask_iou
from tests.body.acting import synthetic_recording


def disc(radius: float, x: float = 50.0, y: float = 50.0, size: int = 100) -> np.ndarray:
    rows, columns = np.mgrid[:size, :size] + 0.5
    return (columns - x) ** 2 + (rows - y) ** 2 < radius**2


def test_signed_distance_of_a_disc() -> None:
    rows, columns = np.mgrid[:100, :100] + 0.5
    exact = np.hypot(columns - 50.0, rows - 50.0) - 30.0
    assert np.abs(signed_distance(disc(30.0)) - exact).max() < 1.0
    assert np.abs((signed_distance(disc(30.0)) - exact)[20:80, 20:80].mean()) < 0.3


def test_normals_of_a_disc_point_outward() -> None:
    outline = outline_pixels(disc(30.0))
    normal = outward_normals(signed_distance(disc(30.0)))[outline[:, 0], outline[:, 1]]
    radial = outline[:, ::-1] + 0.5 - 50.0
    assert ((normal * radial).sum(1) / np.linalg.norm(radial, axis=1)).min() > 0.97


def test_distances_and_normals_do_not_depend_on_memory_alignment() -> None:
    """malloc aligns to 16 bytes, so an array may be 32-byte aligned in one process and not in another."""
    area, kept = disc(30.0), []
    for turn in range(64):
        normals = outward_normals(signed_distance(area))
        kept.append((distance_px(area), distance_px(~area), normals, np.empty(2 * turn)))
    inner, outer, normals, _ = zip(*kept, strict=True)
    if len({array.ctypes.data % 32 for array in outer}) == 1:
        pytest.skip("this platform's malloc gives large arrays one alignment only")
    for arrays in (inner, outer, normals):
        assert len({array.tobytes() for array in arrays}) == 1


def test_the_image_border_is_no_outline() -> None:
    inside = np.zeros((10, 10), dtype=bool)
    inside[4:] = True
    assert np.array_equal(np.unique(outline_pixels(inside)[:, 0]), [4])


def test_the_scale_of_a_window_is_that_of_its_mask() -> None:
    """All 333 x 437 px are the window, whose size is rounded to whole pixels: its scale is not quite 240 / 437."""
    window = crop_mask_window(np.full((437, 333), 255, np.uint8))
    assert window is not None
    assert np.allclose(window.scale_xy * [333, 437], window.mask.shape[::-1], rtol=1e-12)


def test_pairs_of_a_shifted_disc_recover_the_shift() -> None:
    window = crop_mask_window((disc(30.0) * 255).astype(np.uint8))
    assert window is not None
    shift = np.array([3.0, 0.0])
    middle = (np.array([50.0, 50.0]) - [window.left_px, window.top_px]) * window.scale_xy
    body_mask = disc(30.0 * window.scale_xy[0], *(middle + shift), size=window.mask.shape[0])[:, : window.mask.shape[1]]
    pairs = find_correspondences(window, body_mask, np.zeros_like(body_mask))
    used = pairs.weight > 0
    gap = ((pairs.pixel[:, ::-1] + 0.5 - pairs.target) * pairs.normal).sum(1)[used]
    normal = pairs.normal[used]
    found, *_ = np.linalg.lstsq(normal, gap, rcond=None)
    assert used.mean() > 0.9
    assert np.allclose(found, shift, atol=0.4)


def test_pairs_inside_the_mask_weigh_less_than_outside() -> None:
    """Clothes extend the mask beyond the body; the body itself never extends beyond the mask."""
    window = crop_mask_window((disc(30.0) * 255).astype(np.uint8))
    assert window is not None
    middle = (np.array([50.0, 50.0]) - [window.left_px, window.top_px]) * window.scale_xy
    weights = []
    for radius in (27.0, 33.0):
        body_mask = disc(radius, *middle, size=window.mask.shape[0])[:, : window.mask.shape[1]]
        weights.append(find_correspondences(window, body_mask, np.zeros_like(body_mask)).weight.mean())
    assert weights[0] < 0.7 * weights[1]
    body_mask = disc(27.0, *middle, size=window.mask.shape[0])[:, : window.mask.shape[1]]
    assert find_correspondences(window, body_mask, body_mask).weight.mean() < 0.5 * weights[0]


def test_masks_with_low_iou_have_low_weight() -> None:
    weights = mask_weights(np.array([0.93, 0.92, 0.94, 0.83, 0.6, np.nan]))
    assert weights[[0, 1, 2, 5]].tolist() == [1.0] * 4
    assert 0.3 < weights[3] < 0.8
    assert weights[4] == pytest.approx(0.05)
    assert mask_weights(np.full(3, np.nan)).tolist() == [1.0] * 3


def test_an_empty_mask_has_no_window() -> None:
    assert crop_mask_window(np.zeros((20, 20), dtype=np.uint8)) is None


@pytest.mark.parametrize(("second", "expected"), [(disc(20.0), 1.0), (disc(20.0, x=10.0, y=90.0), 0.0)])
def test_overlap_of_discs(second: np.ndarray, expected: float) -> None:
    assert mask_iou(disc(20.0), second) == pytest.approx(expected, abs=0.05)


def test_the_true_body_matches_its_mask() -> None:
    scene = synthetic_recording(load_anny(), 3)
    windows = [*scene.windows()[:2], None]
    contour, silhouette_iou = match_silhouettes(scene.model, scene.state, scene.observations(scene.camera), windows)
    assert np.nanmin(silhouette_iou) > 0.97
    assert np.isnan(silhouette_iou[2])
    assert contour.weight[2].max() == 0.0
    assert contour.weight[:2].sum(1).min() > 20.0


def test_the_outline_of_a_hidden_leg_has_little_weight() -> None:
    """It ends where the object begins, which says nothing about the leg."""
    scene = synthetic_recording(load_anny(), 2)
    observations = scene.observations(scene.camera)
    observations.confidence[0, 27] = 1e-4
    contour, _ = match_silhouettes(scene.model, scene.state, observations, scene.windows())
    joint = scene.model.skin_weights.argmax(1)[contour.corners[..., 0]]
    leg = torch.tensor([ACTIVE_JOINTS.index(name) for name in ("LeftUpLeg", "LeftLeg", "LeftFoot", "LeftToeBase")])
    on_leg = torch.isin(joint, leg)
    assert contour.weight[0, on_leg[0]].max() < 1e-3
    assert contour.weight[0, ~on_leg[0]].max() > 0.1
    assert contour.weight[1, on_leg[1]].max() > 0.1


def test_hair_and_shoes_have_little_weight() -> None:
    """They make the silhouette taller than the body, which would move the person towards the camera."""
    body = load_anny()
    scene = synthetic_recording(body, 6)
    windows = [crop_mask_window(cv2.dilate(mask, np.ones((7, 7), np.uint8))) for mask in scene.masks()]
    contour, _ = match_silhouettes(scene.model, scene.state, scene.observations(scene.camera), windows)
    default_body = body.at_shape(body.shape_defaults)
    skin_weights = default_body.skin_weights[contour.corners[..., 0].numpy()]
    weight = contour.weight.numpy()
    head = skin_weights[..., default_body.joint_names.index("Head")]
    feet = skin_weights[..., [row for row, name in enumerate(default_body.joint_names) if "Foot" in name]].sum(-1)
    elsewhere = (head + feet < 0.1) & (weight > 0)
    for end in (head, feet):
        at_end = (end > 0.5) & (weight > 0)
        assert at_end.any()
        assert np.median(weight[at_end]) < 0.2 * np.median(weight[elsewhere])


def test_posed_vertices_equal_whole_body_skinning() -> None:
    body = load_anny()
    scene = synthetic_recording(body, 2)
    model, state = scene.model, scene.state
    full = model.all_joint_rotations(state.rotations)
    transforms = skinning_transforms(
        forward_kinematics(full, state.root_m, model.full_joints_m, body.parents), model.full_joints_m
    )
    default_body = body.at_shape(body.shape_defaults)
    expected = linear_blend_skinning(
        torch.as_tensor(default_body.vertices).double(), torch.as_tensor(default_body.skin_weights).double(), transforms
    )
    # hands differ by millimetres where a vertex follows fingers and palm at once
    assert (posed_vertices(model, state) - expected).norm(dim=-1).max() < 0.01
