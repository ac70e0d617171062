"""What is saved comes back, images and masks are found by position, and the contact sheet shows what it should."""

import dataclasses

import numpy as np
import pytest

from pipeline.capture.capture import (
    IMAGES_FOLDER,
    MASKS_FOLDER,
    Capture,
    image_path,
    load_capture,
    mask_path,
    save_capture,
)
from pipeline.capture.contact_sheet import contact_sheet
from pipeline.capture.hand_detector import HandLandmarks
from pipeline.core.errors import UserError
from pipeline.geometry.camera import Camera
from pipeline.io.image import write_gray, write_rgb
from tests.capture.test_smpl_poses import make_poses

HAND_SHAPES = ((4, 2, 21, 2), (4, 2, 21, 3), (4, 2))


@pytest.fixture
def capture(tmp_path) -> Capture:
    rng = np.random.default_rng(0)
    frame_index = np.array([0, 3, 4, 8], np.int32)
    for folder in (IMAGES_FOLDER, MASKS_FOLDER):
        (tmp_path / folder).mkdir()
    for index in frame_index:
        write_rgb(image_path(tmp_path, index), np.full((60, 40, 3), 10 * index, np.uint8))
        mask = np.zeros((60, 40), np.uint8)
        mask[10:50, 10:30] = 255
        write_gray(mask_path(tmp_path, index), mask)
    return Capture(
        folder=tmp_path,
        frame_index=frame_index,
        time_s=frame_index / 25.0,
        split=np.array([2, 0, 1, 2], np.uint8),
        fps=25.0,
        width=40,
        height=60,
        landmarks_px=rng.uniform(0, 40, (4, 33, 2)).astype(np.float32),
        landmarks_visibility=np.ones((4, 33), np.float32),
        landmarks_world_m=rng.normal(size=(4, 33, 3)).astype(np.float32),
        camera=Camera(100.0, 101.0, 20.0, 30.0, 40, 60),
        mask_source="detector",
        n_video_frames=9,
        scale=0.5,
        metadata_focal_px=88.0,
        split_rule="split.json",
        camera_pose_is_known=True,
    )


def test_round_trip(capture):
    save_capture(capture)
    loaded = load_capture(capture.folder)
    for field in dataclasses.fields(Capture):
        if field.name != "camera":
            np.testing.assert_array_equal(getattr(loaded, field.name), getattr(capture, field.name), err_msg=field.name)
    assert dataclasses.astuple(loaded.camera)[:6] == dataclasses.astuple(capture.camera)[:6]
    assert len(loaded) == 4


def test_hands_come_back(capture):
    hands = HandLandmarks(*(np.random.default_rng(1).random(shape).astype(np.float32) for shape in HAND_SHAPES))
    save_capture(dataclasses.replace(capture, hands=hands))
    loaded = load_capture(capture.folder).hands
    assert loaded is not None
    for name, values in vars(hands).items():
        np.testing.assert_array_equal(getattr(loaded, name), values, err_msg=name)


def test_supplied_poses_round_trip(capture):
    save_capture(dataclasses.replace(capture, smpl_poses=make_poses()))
    poses = load_capture(capture.folder).smpl_poses
    assert poses is not None
    np.testing.assert_array_equal(poses.body_pose, make_poses().body_pose)


def test_unknown_camera_stays_unknown(capture):
    save_capture(dataclasses.replace(capture, camera=None, metadata_focal_px=None))
    assert load_capture(capture.folder).camera is None
    assert load_capture(capture.folder).metadata_focal_px is None


def test_pictures_are_found_by_position(capture):
    assert capture.image(1).mean() == pytest.approx(30 / 255)
    assert capture.image(1).dtype == np.float32
    assert capture.mask(3).mean() == pytest.approx(40 * 20 / 2400)
    np.testing.assert_array_equal(capture.positions(2), [0, 3])


def test_folder_without_frames_is_an_error(tmp_path):
    with pytest.raises(UserError, match="frames.npz"):
        load_capture(tmp_path)


def test_contact_sheet_shows_every_frame_with_its_outline(capture):
    sheet = contact_sheet(capture)
    width = sheet.shape[1] // 8
    assert sheet.shape[0] == 320
    for k in range(4):
        tile = sheet[:, k * width : (k + 1) * width].astype(int)
        outline = (np.abs(tile - (255, 0, 255)).sum(axis=2) == 0).sum()
        assert outline > 500
    assert not sheet[:, 4 * width :].any()


def test_contact_sheet_of_landmarks_that_are_unknown(capture):
    unknown = dataclasses.replace(capture, landmarks_px=np.full_like(capture.landmarks_px, np.nan))
    assert contact_sheet(unknown).shape == contact_sheet(capture).shape
