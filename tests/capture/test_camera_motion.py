"""A hand-held camera, against rays that are turned by known angles, and pictures that it took of a painted wall."""

import json
from dataclasses import replace

import cv2
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from pipeline.capture.camera_motion import (
    CameraMotion,
    apply_homography,
    camera_motion_px,
    estimate_camera_motion,
    stabilise_detections,
    warp_image,
)
from pipeline.capture.capture import image_path, mask_path
from pipeline.capture.detection import Detections
from pipeline.capture.frame_writing import write_frames
from pipeline.capture.user_files import load_user_files
from pipeline.capture.video import open_frame_source
from pipeline.capture.worker_pool import start_worker_pool
from pipeline.core.progress import take_warnings
from pipeline.io.image import read_gray, read_rgb, write_gray, write_rgb
from stages.frames import comparison_noise, stabilise_camera
from tests.capture.test_input_checks import make_detections

WIDTH, HEIGHT, FOCAL_RATIO = 320, 180, 1.2
COUNT = 12
CENTRE = np.array([WIDTH / 2, HEIGHT / 2])


def true_motion(seed: int = 0, size: float = 1.0) -> np.ndarray:
    """Yaw, pitch, roll (rad) and logarithm of the scale of each frame."""
    return size * np.random.default_rng(seed).normal(0.0, (0.02, 0.012, 0.01, 0.004), (COUNT, 4))


def see(points_px: np.ndarray, motion: np.ndarray, ratio: float = FOCAL_RATIO) -> np.ndarray:
    """Where a turned camera sees points of the picture of one that is not: rays, a rotation, and a projection."""
    yaw, pitch, roll, log_scale = motion
    focal = ratio * WIDTH
    rays = np.column_stack([(points_px - CENTRE) / focal, np.ones(len(points_px))])
    turned = Rotation.from_euler("yxz", (yaw, pitch, roll)).apply(rays)
    return np.exp(log_scale) * focal * turned[:, :2] / turned[:, 2:] + CENTRE


def wall() -> np.ndarray:
    """A large wall with patches and noise, of which the middle is filmed."""
    coarse = np.random.default_rng(3).integers(50, 200, (HEIGHT // 6, WIDTH // 6), dtype=np.uint8)
    return cv2.GaussianBlur(cv2.resize(coarse, (2 * WIDTH, 2 * HEIGHT), interpolation=cv2.INTER_NEAREST), (0, 0), 1.0)


def film(motion: np.ndarray, ratio: float = FOCAL_RATIO) -> np.ndarray:
    """The wall as each turned camera sees it, sampled where the ray of each pixel meets it."""
    columns, rows = np.meshgrid(np.arange(WIDTH) + 0.5, np.arange(HEIGHT) + 0.5)
    pixels = np.column_stack([columns.ravel(), rows.ravel()])
    focal, pictures = ratio * WIDTH, []
    for yaw, pitch, roll, log_scale in motion:
        rays = np.column_stack([(pixels - CENTRE) / (np.exp(log_scale) * focal), np.ones(len(pixels))])
        turned = Rotation.from_euler("yxz", (yaw, pitch, roll)).inv().apply(rays)
        at = focal * turned[:, :2] / turned[:, 2:] + 2.0 * CENTRE - 0.5
        x, y = (values.reshape(HEIGHT, WIDTH).astype(np.float32) for values in at.T)
        pictures.append(cv2.remap(wall(), x, y, cv2.INTER_LINEAR))
    return np.stack(pictures)


def person_boxes() -> np.ndarray:
    """A person in the middle who sways against the motion of the camera."""
    masks = np.zeros((COUNT, HEIGHT, WIDTH), bool)
    for k in range(COUNT):
        masks[k, 40:150, 130 + 2 * k : 180 + 2 * k] = True
    return masks


def recording(motion: np.ndarray, ratio: float = FOCAL_RATIO, levels: int = 0) -> Detections:
    """Detections whose landmarks are points of the wall; the light grows by `levels` from frame to frame."""
    persons, masks_png = person_boxes(), []
    pictures = film(motion, ratio).astype(int) + levels * np.arange(COUNT)[:, None, None]
    stripes = 40 + 150 * (np.arange(WIDTH) // 4 % 2)
    gray = np.clip(np.where(persons, stripes, pictures), 0, 255).astype(np.uint8)
    points = np.random.default_rng(4).uniform((90, 50), (230, 130), (33, 2))
    seen = np.stack([see(points, row, ratio) for row in motion])
    seen[2, 5] = np.nan
    masks_png = [cv2.imencode(".png", 255 * mask.astype(np.uint8))[1].tobytes() for mask in persons]
    return replace(
        make_detections(COUNT),
        gray_thumbnails=gray,
        person_masks=persons,
        landmarks_px=seen.astype(np.float32),
        landmarks_world_m=np.tile(np.eye(33, 3, dtype=np.float32), (COUNT, 1, 1)),
        masks_png=tuple(masks_png),
        width=WIDTH,
        height=HEIGHT,
    )


@pytest.mark.parametrize("ratio", [0.9, 1.6])
def test_angles_scale_and_focal_length_of_a_turning_camera_are_found(ratio):
    motion = true_motion()
    found = estimate_camera_motion(film(motion, ratio), person_boxes(), None)
    assert found.known.all()
    assert found.focal_ratio == ratio
    against_reference = [
        np.linalg.norm(
            apply_homography(matrix, CENTRE[None]) - see_in_median(motion, row, ratio, CENTRE[None]), axis=-1
        ).max()
        for matrix, row in zip(found.to_stabilised_camera((WIDTH, HEIGHT)), motion, strict=True)
    ]
    assert max(against_reference) < 0.35


def see_in_median(motion: np.ndarray, row: np.ndarray, ratio: float, points_px: np.ndarray) -> np.ndarray:
    """Where the median camera sees what the camera of `row` sees at these points."""
    focal, median = ratio * WIDTH, np.median(motion, axis=0)
    rays = np.column_stack([(points_px - CENTRE) / (np.exp(row[3]) * focal), np.ones(len(points_px))])
    scene = Rotation.from_euler("yxz", row[:3]).inv().apply(rays)
    turned = Rotation.from_euler("yxz", median[:3]).apply(scene)
    return np.exp(median[3]) * focal * turned[:, :2] / turned[:, 2:] + CENTRE


def test_a_wall_without_corners_tells_nothing():
    blank = np.full((COUNT, HEIGHT, WIDTH), 120, np.uint8)
    assert not estimate_camera_motion(blank, person_boxes(), FOCAL_RATIO).known.any()


def test_points_of_the_scene_stand_still_in_stabilised_pictures():
    shaken = recording(true_motion())
    stabilised = stabilise_detections(shaken, FOCAL_RATIO * WIDTH)
    assert len(stabilised.frame_index) == COUNT
    spread = np.nanstd(stabilised.landmarks_px, axis=0).max()
    assert np.nanstd(shaken.landmarks_px, axis=0).max() > 5.0
    assert spread < 0.15
    assert np.argwhere(np.isnan(stabilised.landmarks_px[..., 0])).tolist() == [[2, 5]]
    scene = ~np.stack([cv2.dilate(m.astype(np.uint8), np.ones((25, 25))) > 0 for m in person_boxes()]).any(axis=0)
    inner = np.zeros_like(scene)
    inner[25:-25, 25:-25] = True
    varies = [
        images.std(axis=0)[scene & inner].mean() for images in (shaken.gray_thumbnails, stabilised.gray_thumbnails)
    ]
    assert varies[1] < 0.15 * varies[0]


def test_masks_move_with_the_pictures_and_landmarks_in_metres_roll():
    motion = true_motion() * (1.0, 1.0, 3.0, 1.0)
    shaken = recording(motion)
    stabilised = stabilise_detections(shaken, FOCAL_RATIO * WIDTH)
    for k in (0, 3, 7):
        middle = np.argwhere(shaken.person_masks[k]).mean(axis=0)[::-1] + 0.5
        expected = apply_homography(stabilised.to_stabilised[k], middle[None])[0]
        decoded = cv2.imdecode(np.frombuffer(stabilised.masks_png[k], np.uint8), cv2.IMREAD_GRAYSCALE)
        for mask in (stabilised.person_masks[k], decoded > 127):
            np.testing.assert_allclose(np.argwhere(mask).mean(axis=0)[::-1] + 0.5, expected, atol=0.5)
    roll = np.median(motion[:, 2]) - motion[:, 2]
    np.testing.assert_allclose(stabilised.landmarks_world_m[:, 0, 1], np.sin(roll), atol=2e-3)
    np.testing.assert_allclose(stabilised.landmarks_world_m[:, 2], np.tile((0, 0, 1), (COUNT, 1)), atol=1e-6)


@pytest.mark.parametrize(
    "detections",
    [
        recording(np.zeros((COUNT, 4))),
        recording(np.zeros((COUNT, 4)), levels=6),
        replace(recording(true_motion()), gray_thumbnails=np.random.default_rng(5).integers(
            0, 256, (COUNT, HEIGHT, WIDTH), dtype=np.uint8
        )),
        recording(true_motion(size=6.0)),
    ],
    ids=["still", "only the light changes", "no scene", "the person would leave the picture"],
)  # fmt: skip
def test_other_recordings_stay_as_they_are(detections):
    assert stabilise_detections(detections, FOCAL_RATIO * WIDTH) is detections


@pytest.mark.parametrize(
    ("pitch_rad", "rows"), [(-0.06, (17, 163)), (0.06, (17, 163)), (-0.06, (40, 180)), (0.06, (0, 140))]
)
def test_frames_that_cut_off_the_person_before_or_afterwards_are_left_out(pitch_rad, rows):
    """Frame 4 ends 23 px off the others; its picture or the stabilised one ends within the `rows` of the person."""
    motion = 0.3 * true_motion()
    motion[2:7] = np.outer(pitch_rad * np.array((0.17, 0.58, 1.0, 0.58, 0.17)), (0.0, 1.0, 0.0, 0.0))
    shaken = recording(motion)
    whole = stabilise_detections(shaken, FOCAL_RATIO * WIDTH)
    np.testing.assert_array_equal(whole.frame_index, np.arange(COUNT))
    masks = shaken.person_masks.copy()
    masks[4, slice(*rows), 150:160] = True
    cut = stabilise_detections(replace(shaken, person_masks=masks), FOCAL_RATIO * WIDTH)
    np.testing.assert_array_equal(cut.frame_index, np.delete(np.arange(COUNT), 4))
    assert len(cut.masks_png) == len(cut.hands.landmarks_px) == len(cut.to_stabilised) == COUNT - 1


@pytest.mark.parametrize(("pitch_rad", "rows"), [(-0.06, (40, 179)), (0.06, (1, 140))])
def test_a_person_who_ends_just_before_the_edge_is_not_cut_off(pitch_rad, rows):
    """Frame 4 shows the whole person; in the stabilised picture what was not filmed begins one pixel further on."""
    motion = 0.3 * true_motion()
    motion[2:7] = np.outer(pitch_rad * np.array((0.17, 0.58, 1.0, 0.58, 0.17)), (0.0, 1.0, 0.0, 0.0))
    shaken = recording(motion)
    shaken.person_masks[4, slice(*rows), 150:160] = True
    whole = stabilise_detections(shaken, FOCAL_RATIO * WIDTH)
    np.testing.assert_array_equal(whole.frame_index, np.arange(COUNT))


def test_motion_in_pixels_is_that_of_the_farthest_corner():
    motion = CameraMotion(np.zeros((COUNT, 4)), np.ones(COUNT, bool), FOCAL_RATIO)
    assert camera_motion_px(motion.to_stabilised_camera((WIDTH, HEIGHT)), (WIDTH, HEIGHT)) == 0.0
    shift = np.array([[1.0, 0.0, 3.0], [0.0, 1.0, 4.0], [0.0, 0.0, 1.0]])
    assert camera_motion_px(np.tile(shift, (5, 1, 1)), (WIDTH, HEIGHT)) == pytest.approx(5.0)


def test_a_whole_pixel_shift_moves_pixels_unchanged():
    image = np.random.default_rng(6).integers(0, 256, (9, 14, 3), dtype=np.uint8)
    shift = np.array([[1.0, 0.0, 2.0], [0.0, 1.0, -1.0], [0.0, 0.0, 1.0]])
    np.testing.assert_array_equal(warp_image(image, shift)[:-1, 2:], image[1:, :-2])
    assert (warp_image(image[..., 0], shift, is_mask=True)[:, :2] == 0).all()
    np.testing.assert_array_equal(warp_image(image, shift)[:-1, 0], image[1:, 0])


def test_written_frames_and_supplied_masks_are_stabilised(tmp_path):
    shift = np.array([[1.0, 0.0, 3.0], [0.0, 1.0, 0.0], [0.0, 0.0, 1.0]])
    (tmp_path / "in" / "masks").mkdir(parents=True)
    random = np.random.default_rng(7)
    images = random.integers(0, 256, (3, 20, 30, 3), dtype=np.uint8)
    mask = np.zeros((20, 30), np.uint8)
    mask[5:15, 10:20] = 255
    for k, image in enumerate(images):
        write_rgb(tmp_path / "in" / f"{k}.png", image)
        write_gray(tmp_path / "in" / "masks" / f"{k}.png", mask)
    seen = replace(make_detections(3), width=30, height=20, to_stabilised=np.stack([np.eye(3), shift, np.eye(3)]))
    source = open_frame_source(tmp_path / "in")
    (tmp_path / "out").mkdir()
    with start_worker_pool(1) as workers:
        write_frames(source, load_user_files(tmp_path / "in", source), seen, [0, 1], tmp_path / "out", 30, 1.0, workers)
    for k, moved in ((0, 0), (1, 3)):
        np.testing.assert_array_equal(read_gray(mask_path(tmp_path / "out", k)), np.roll(mask, moved, axis=1))
        np.testing.assert_array_equal(read_rgb(image_path(tmp_path / "out", k))[:, moved:], images[k][:, : 30 - moved])


def test_a_moving_camera_is_told_unless_its_place_is_supplied(tmp_path):
    shaken = recording(true_motion())
    for k in range(2):
        write_rgb(tmp_path / f"{k}.png", np.zeros((HEIGHT, WIDTH, 3), np.uint8))
    source = open_frame_source(tmp_path)
    stabilised, moved_px = stabilise_camera(shaken, source, load_user_files(tmp_path, source))
    assert stabilised.to_stabilised is not None
    assert moved_px > 10.0
    assert [f"moves, its picture by up to {moved_px:.0f} px" in text for text in take_warnings()] == [True]
    intrinsics = {"fx": 384, "fy": 384, "cx": 160, "cy": 90}
    (tmp_path / "camera.json").write_text(json.dumps({**intrinsics, "world_to_camera": np.eye(4).tolist()}))
    assert stabilise_camera(shaken, source, load_user_files(tmp_path, source)) == (shaken, 0.0)
    assert take_warnings() == []


def test_supplied_intrinsics_hold_for_stabilised_pictures(tmp_path):
    """Pictures without their left 80 of 320 px, half as large as those of the recording."""
    cut_px, ratio, motion = 80, 1.0, true_motion(size=1.5)
    shaken = recording(motion, ratio)
    shaken = replace(
        shaken,
        gray_thumbnails=shaken.gray_thumbnails[:, :, cut_px:],
        person_masks=shaken.person_masks[:, :, cut_px:],
        width=WIDTH - cut_px,
        scale=0.5,
    )
    write_rgb(tmp_path / "0.png", np.zeros((2 * HEIGHT, 2 * shaken.width, 3), np.uint8))
    intrinsics = {"fx": 2 * ratio * WIDTH, "fy": 2 * ratio * WIDTH, "cx": WIDTH - 2 * cut_px, "cy": HEIGHT}
    (tmp_path / "camera.json").write_text(json.dumps(intrinsics))
    source = open_frame_source(tmp_path)
    stabilised, _ = stabilise_camera(shaken, source, load_user_files(tmp_path, source))
    assert len(take_warnings()) == 1
    corners = np.array([(x, y) for x in (cut_px, WIDTH) for y in (0, HEIGHT)], dtype=float)
    for homography, row in zip(stabilised.to_stabilised, motion, strict=True):
        moved = apply_homography(homography, corners - (cut_px, 0))
        expected = see_in_median(motion, row, ratio, corners) - (cut_px, 0)
        np.testing.assert_allclose(moved, expected, atol=0.3)


def test_frames_of_unknown_motion_are_told_as_such(tmp_path):
    shaken = recording(true_motion())
    shaken.gray_thumbnails[4] = 120
    write_rgb(tmp_path / "0.png", np.zeros((HEIGHT, WIDTH, 3), np.uint8))
    source = open_frame_source(tmp_path)
    stabilised, _ = stabilise_camera(shaken, source, load_user_files(tmp_path, source))
    np.testing.assert_array_equal(stabilised.frame_index, np.delete(np.arange(COUNT), 4))
    (text,) = take_warnings()
    assert "stabilised, 1 left out, which would cut off the person or whose motion is unknown; film" in text


@pytest.mark.parametrize("moves", [True, False])
def test_only_noise_of_a_still_scene_counts_as_large(moves):
    """Noise of 4 levels, of which the mean difference of two pictures is 4 * 2 / sqrt(pi)."""
    detections = recording(true_motion(size=1.0 if moves else 0.0))
    noisy = detections.gray_thumbnails + np.random.default_rng(8).normal(0.0, 4.0, (COUNT, HEIGHT, WIDTH))
    noise = comparison_noise(replace(detections, gray_thumbnails=np.clip(np.rint(noisy), 0, 255).astype(np.uint8)))
    assert noise == pytest.approx(1.0 if moves else 8.0 / np.sqrt(np.pi), rel=0.1)
