import numpy as np
import pytest
import torch

from pipeline.body.body import Body, load_anny
from pipeline.body.fit.silhouette_icp import crop_mask_window
from pipeline.body.foreign_objects import (
    CLOTHING_MARGIN_RATIO,
    MIN_EXCESS_BLOB_SHARE,
    foreign_object_warnings,
    frames_with_foreign_objects,
    residual_blob_share,
    residual_blob_shares,
)
from pipeline.geometry.camera import Camera, project
from pipeline.kernels.raster import rasterize

ROWS = 200.0
"""Height of the body in the test images, pixels."""


def blocks(*corners: tuple[int, int, int, int]) -> np.ndarray:
    mask = np.zeros((300, 300), bool)
    for top, bottom, left, right in corners:
        mask[top:bottom, left:right] = True
    return mask


BODY = (50, 250, 100, 140)


def test_close_clothing_is_no_residual_blob() -> None:
    margin_px = int(CLOTHING_MARGIN_RATIO * ROWS)
    assert residual_blob_share(blocks((50, 250, 100 - margin_px, 140 + margin_px)), blocks(BODY), ROWS) == 0.0
    assert residual_blob_share(blocks((50, 250, 100, 140 + margin_px + 1)), blocks(BODY), ROWS) > 0.0
    assert residual_blob_share(blocks((50, 250, 100, 140 + margin_px)), blocks(BODY), 0.8 * ROWS) > 0.0
    assert residual_blob_share(blocks(), blocks(BODY), ROWS) == 0.0


def test_largest_blob_excludes_the_clothing_margin() -> None:
    """Within 6 px of the body is clothing; 34 x 40 px of the large block and 24 x 10 px of the small one remain."""
    mask = blocks(BODY, (100, 140, 140, 180), (200, 210, 70, 100))
    assert residual_blob_share(mask, blocks(BODY), ROWS) == pytest.approx(34 * 40 / mask.sum())


def test_cloth_in_the_rows_of_a_skirt_is_no_residual_blob() -> None:
    mask = blocks(BODY, (100, 140, 140, 180), (200, 210, 70, 100))
    assert residual_blob_share(mask, blocks(BODY), ROWS, slice(90, 150)) == pytest.approx(24 * 10 / mask.sum())
    assert residual_blob_share(mask, blocks(BODY), ROWS, slice(90, 250)) == 0.0


def test_only_temporary_blobs_are_foreign_objects() -> None:
    wide_skirt = np.full(9, 0.04)
    assert not frames_with_foreign_objects(wide_skirt).any()
    wide_skirt[[2, 6]] += (0.9 * MIN_EXCESS_BLOB_SHARE, 1.1 * MIN_EXCESS_BLOB_SHARE)
    wide_skirt[4] = np.nan
    assert np.flatnonzero(frames_with_foreign_objects(wide_skirt)).tolist() == [6]
    assert not frames_with_foreign_objects(np.full(3, np.nan)).any()
    (warning,) = foreign_object_warnings(wide_skirt, 3 * np.arange(9))
    assert warning == (
        "frames 18: the mask contains another object (a ball, a bag, a caption?), or the pose is wrong; "
        "exclude these frames with split.json, or supply masks/"
    )
    assert foreign_object_warnings(wide_skirt[:6], np.arange(6)) == []


def a_pose() -> tuple[Body, Camera, np.ndarray]:
    """The default body, a camera before it, and its pixels: 10 mm each."""
    anny = load_anny()
    body = anny.at_shape(anny.shape_defaults)
    world_to_camera = np.diag([1.0, -1.0, -1.0, 1.0]).astype(np.float32)
    world_to_camera[:3, 3] = (0.0, 0.85, 3.0)
    camera = Camera(300.0, 300.0, 150.0, 150.0, 300, 300, world_to_camera)
    vertices_px, depth_m = project(torch.as_tensor(body.vertices), camera)
    face_id, _, _ = rasterize(vertices_px, depth_m, torch.as_tensor(body.faces), 300, 300)
    return body, camera, np.where(face_id.numpy() >= 0, np.uint8(255), np.uint8(0))


def test_a_wide_skirt_is_no_object_where_its_hem_is_known() -> None:
    body, camera, mask = a_pose()
    height_m = torch.tensor([[0.0, body.height_on_legs_m(height), 0.0] for height in (-0.2, 0.9)])
    top, bottom = project(height_m, camera)[0][:, 1].int().tolist()
    mask[top:bottom, 105:195] = 255
    identity, windows = torch.eye(4).expand(1, len(body.joint_names), 4, 4), [crop_mask_window(mask)]
    assert residual_blob_shares(body, identity, camera, windows)[0] > 0.02
    assert residual_blob_shares(body, identity, camera, windows, hem=1.0)[0] == 0.0


def test_a_ball_at_the_hand_is_detected_in_its_frame() -> None:
    body, camera, alone = a_pose()
    vertices_px, _ = project(torch.as_tensor(body.vertices), camera)
    hand_px = vertices_px[body.vertices[:, 0].argmax()].numpy()
    rows, columns = np.mgrid[:300, :300] + 0.5
    with_ball = alone.copy()
    with_ball[np.hypot(rows - hand_px[1], columns - hand_px[0]) < 20.0] = 255
    identity = torch.eye(4).expand(4, len(body.joint_names), 4, 4)
    windows = [crop_mask_window(mask) for mask in (alone, with_ball, np.zeros_like(alone), alone)]
    shares = residual_blob_shares(body, identity, camera, windows)
    assert np.isnan(shares).tolist() == [False, False, True, False]
    assert shares[[0, 3]].max() == 0.0
    assert shares[1] == pytest.approx(
        residual_blob_share(with_ball > 0, alone > 0, np.ptp(np.flatnonzero(alone.any(1))) + 1.0), abs=0.001
    )
    assert frames_with_foreign_objects(shares).tolist() == [False, True, False, False]
