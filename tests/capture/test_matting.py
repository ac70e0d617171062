"""Sharpened masks against composites whose alpha is known by construction."""

import cv2
import numpy as np
import pytest
from scipy.stats import multivariate_normal

from pipeline.capture.masks import matting as matte
from pipeline.capture.masks.colour_distribution import ColourDistribution, log_density, solve_symmetric

SIDE_PX = 64


def intersection_over_union(first: np.ndarray, second: np.ndarray) -> float:
    return float((first & second).sum() / (first | second).sum())


def figure(size: int = 320) -> np.ndarray:
    """A body with arms, legs and a gap between arm and trunk, drawn 4 times too large and averaged down: true alpha."""
    big = np.zeros((4 * size, 4 * size), np.uint8)
    for centre, axes in (
        ((640, 260), (90, 110)),
        ((640, 600), (150, 260)),
        ((560, 960), (60, 240)),
        ((720, 960), (60, 240)),
    ):
        cv2.ellipse(big, centre, axes, 0, 0, 360, 255, -1)
    for elbow, hand in (((380, 620), (500, 800)), ((900, 620), (780, 800))):
        cv2.polylines(big, [np.array([(640, 420), elbow, hand])], False, 255, 50)
    return cv2.resize(big, (size, size), interpolation=cv2.INTER_AREA).astype(np.float32) / 255.0


def composite(alpha: np.ndarray, seed: int = 0) -> np.ndarray:
    """Shirt above, trousers below, in front of a striped wall that changes its colour along x; video noise on top."""
    rng = np.random.default_rng(seed)
    rows, columns = np.mgrid[: alpha.shape[0], : alpha.shape[1]]
    stripes = np.where(columns // 24 % 2 == 0, 1.0, 0.8)[..., None]
    wall = np.stack([90 + 0.2 * columns, 130 - 0.1 * columns, 110 + 0.1 * rows], axis=-1) * stripes
    person = np.where((rows < 190)[..., None], (190, 60, 50), (40, 45, 90)).astype(np.float64)
    mixed = alpha[..., None] * person + (1 - alpha[..., None]) * wall + rng.normal(0, 2, (*alpha.shape, 3))
    return np.clip(np.rint(mixed), 0, 255).astype(np.uint8)


def detector_mask(alpha: np.ndarray, cell_px: float = 4.0, shift_px: int = 1) -> np.ndarray:
    """What a coarse detector would say: averaged over cells, enlarged, a pixel off."""
    small = cv2.resize(alpha, None, fx=1 / cell_px, fy=1 / cell_px, interpolation=cv2.INTER_AREA)
    blurred = cv2.GaussianBlur(small, (0, 0), 1.0)
    large = cv2.resize(blurred, alpha.shape[::-1], interpolation=cv2.INTER_LINEAR)
    return np.rint(np.roll(large, shift_px, axis=(0, 1)) * 255).astype(np.uint8)


def test_sharpened_mask_follows_the_image():
    alpha = figure()
    guess = detector_mask(alpha)
    sharp = matte.estimate_alpha_matte(composite(alpha), guess)
    before = intersection_over_union(guess > 127, alpha > 0.5)
    after = intersection_over_union(sharp > 0.5, alpha > 0.5)
    assert before < 0.94
    assert after > 0.98
    assert np.abs(sharp - alpha).mean() < 0.35 * np.abs(guess / 255.0 - alpha).mean()


def test_the_gap_between_arm_and_trunk_stays():
    alpha = figure()
    gap = (slice(150, 158), slice(112, 121))
    assert alpha[gap].max() == 0
    assert matte.estimate_alpha_matte(composite(alpha), detector_mask(alpha))[gap].max() < 0.5


def test_a_trim_in_the_walls_colour_stays_with_the_person():
    alpha = figure()
    image = np.where(alpha[..., None] > 0.5, np.uint8([190, 40, 40]), np.uint8([200, 205, 200])).astype(np.uint8)
    image[150:153][alpha[150:153] > 0.5] = (212, 214, 210)
    sharp = matte.estimate_alpha_matte(image, detector_mask(alpha, shift_px=0))
    assert sharp[150:153, 130:190].min() > 0.5


def test_without_a_person_the_mask_is_empty():
    assert not matte.estimate_alpha_matte(composite(figure()), np.zeros((320, 320), np.uint8)).any()


def test_person_and_wall_of_one_colour_keep_the_detectors_outline():
    alpha = figure()
    guess = detector_mask(alpha, shift_px=0)
    sharp = matte.estimate_alpha_matte(np.full((320, 320, 3), 90, np.uint8), guess)
    assert intersection_over_union(sharp > 0.5, guess > 127) > 0.97


def test_clean_alpha_drops_specks_and_pinholes_and_keeps_the_rim_soft():
    alpha = np.zeros((240, 240), np.float32)
    alpha[20:220, 30:190] = 1.0
    alpha[20, 30:190] = 0.7
    alpha[150, 150] = 0.0
    alpha[40:60, 40:50] = 0.1
    alpha[230:233, 5:8] = 1.0
    clean = matte.clean_alpha_matte(alpha)
    assert clean[230:233, 5:8].max() == 0
    assert clean[150, 150] == 1
    assert clean[45:55, 44:46].max() == 0
    assert clean[20, 60] == pytest.approx(0.7)
    assert clean[18, 60] == clean[24, 10] == 0
    assert set(np.unique(clean[70:210, 40:180])) == {1.0}


def test_a_large_part_that_is_cut_off_stays():
    alpha = np.zeros((100, 100), np.float32)
    alpha[5:60, 20:80] = 1.0
    alpha[65:95, 40:60] = 1.0
    assert matte.clean_alpha_matte(alpha)[80, 50] == 1


def test_flicker_goes_where_the_image_stands_still_and_motion_stays():
    images = np.full((3, 40, 60, 3), 100, np.uint8)
    masks = np.zeros((3, 40, 60), np.uint8)
    masks[[0, 2], 10:30, 5:20] = 255
    images[1, 5:35, 35:55] = 200
    masks[1, 8:32, 38:52] = 255
    smoothed = matte.smooth_mask_temporally(images, masks, centre=1, noise=1.0)
    np.testing.assert_array_equal(smoothed[12:28, 7:18], 170)
    np.testing.assert_array_equal(smoothed[10:30, 40:50], 255)


def test_one_mask_alone_is_left_as_it_is():
    mask = detector_mask(figure())
    image = composite(figure())
    np.testing.assert_array_equal(matte.smooth_mask_temporally(image[None], mask[None], 0, 1.0), mask)


def test_what_the_detector_misses_before_a_painted_backdrop_is_added():
    alpha = figure()
    image = np.where(alpha[..., None] > 0.5, np.uint8(180), np.uint8(0)).repeat(3, axis=2)
    image[3:7, 3:7] = 90
    guess = detector_mask(alpha, shift_px=0)
    guess[260:] = 0
    extended = matte.extend_mask_on_uniform_background(image, guess)
    assert (
        intersection_over_union(extended > 127, alpha > 0.5) > 0.95 > intersection_over_union(guess > 127, alpha > 0.5)
    )
    assert extended[:10, :10].max() == 0


def test_a_camera_sees_no_painted_backdrop():
    alpha = figure()
    guess = detector_mask(alpha)
    guess[260:] = 0
    np.testing.assert_array_equal(matte.extend_mask_on_uniform_background(composite(alpha), guess), guess)


def test_outline_is_the_border_of_a_square():
    mask = np.zeros((9, 9), bool)
    mask[2:7, 2:7] = True
    expected = mask.copy()
    expected[3:6, 3:6] = False
    np.testing.assert_array_equal(matte.inner_boundary(mask), expected)


def test_shadow_far_from_the_outline_gains_no_area():
    alpha = figure()
    image = composite(alpha)
    image[290:310, 40:100] = (40, 45, 90)
    assert matte.estimate_alpha_matte(image, detector_mask(alpha))[290:310, 40:100].max() == 0


def make_soft_disc(soft_px: float = 1.0) -> np.ndarray:
    """Alpha of a disc with a soft rim, 0..255."""
    rows, columns = np.mgrid[:SIDE_PX, :SIDE_PX] + 0.5
    distance = 20.0 - np.hypot(rows - 32.0, columns - 32.0)
    return np.rint(255.0 * np.clip(0.5 + distance / (2.0 * soft_px), 0.0, 1.0)).astype(np.uint8)


def composite_colours(person: tuple, backdrop: tuple, alpha: np.ndarray) -> np.ndarray:
    share = alpha[..., None] / 255.0
    return np.rint(share * np.array(person) + (1.0 - share) * np.array(backdrop)).astype(np.uint8)


@pytest.mark.parametrize(
    ("person", "backdrop"), [((200, 40, 90), (20, 180, 60)), ((250, 250, 255), (0, 0, 3)), ((9, 0, 4), (255, 255, 255))]
)
def test_plain_colours_are_found_again_to_the_level(person: tuple, backdrop: tuple) -> None:
    alpha = make_soft_disc()
    assert ((alpha > 0) & (alpha < 255)).sum() > 100
    found = matte.decontaminate_colours(composite_colours(person, backdrop, alpha), alpha)
    np.testing.assert_allclose(found[alpha > 0], np.broadcast_to(person, (int((alpha > 0).sum()), 3)), atol=1)


def test_a_person_before_a_striped_wall_loses_most_of_it() -> None:
    """Shirt and trousers, wall of changing colour, video noise: error of the rim against the person's true colour."""
    true_alpha = figure()
    image, alpha = composite(true_alpha), np.rint(255 * true_alpha).astype(np.uint8)
    rows = np.mgrid[: alpha.shape[0], : alpha.shape[1]][0]
    person = np.where((rows < 190)[..., None], (190, 60, 50), (40, 45, 90))
    rim = (alpha > 0) & (alpha < 255)
    before, after = (
        np.abs(found.astype(float) - person)[rim].mean() for found in (image, matte.decontaminate_colours(image, alpha))
    )
    assert after < 0.25 * before


def test_the_person_as_seen_in_a_soft_pixel_stays() -> None:
    """A rim of its own colour, half covered: half of what differs from the person further in is still there."""
    alpha = make_soft_disc()
    rim = (alpha > 0) & (alpha < 255)
    share = alpha[rim, None] / 255.0
    image = composite_colours((100, 100, 100), (0, 200, 0), alpha)
    image[rim] = np.rint(share * (180, 100, 100) + (1.0 - share) * (0, 200, 0))
    found = matte.decontaminate_colours(image, alpha)[rim]
    np.testing.assert_allclose(found, 100 + share * (80, 0, 0), atol=1)


def test_pixels_that_are_not_soft_stay_as_they_are() -> None:
    image = np.random.default_rng(0).integers(0, 256, (SIDE_PX, SIDE_PX, 3), dtype=np.uint8)
    alpha = make_soft_disc()
    sure = (alpha == 0) | (alpha == 255)
    found = matte.decontaminate_colours(image, alpha)
    np.testing.assert_array_equal(found[sure], image[sure])
    assert (found[~sure] != image[~sure]).any()


@pytest.mark.parametrize(
    "alpha",
    [
        np.where(make_soft_disc() > 127, 255, 0),
        make_soft_disc() * 0,
        np.maximum(make_soft_disc(), 99),
        np.minimum(make_soft_disc(), 99),
    ],
)
def test_without_a_rim_or_without_one_of_its_sides_nothing_changes(alpha: np.ndarray) -> None:
    image = np.random.default_rng(0).integers(0, 256, (SIDE_PX, SIDE_PX, 3), dtype=np.uint8)
    np.testing.assert_array_equal(matte.decontaminate_colours(image, alpha.astype(np.uint8)), image)


@pytest.mark.parametrize("reduction", [1, 2, 4])
@pytest.mark.parametrize("is_straight", [True, False], ids=["straight", "blended with black"])
def test_cut_outs_have_the_colour_of_the_person_in_their_soft_pixels(is_straight: bool, reduction: int) -> None:
    """Transparent black around a person of one colour, reduced by area averages as frames are."""
    alpha = make_soft_disc()
    image = np.where(alpha[..., None] > 0, (100, 120, 60), 0).astype(np.uint8)
    if not is_straight:
        image = composite_colours((100, 120, 60), (0, 0, 0), alpha)
    side_px = SIDE_PX // reduction
    image, alpha = (cv2.resize(one, (side_px, side_px), interpolation=cv2.INTER_AREA) for one in (image, alpha))
    found = matte.decontaminate_colours(image, alpha, is_own_alpha=True).astype(float)
    error = np.abs(found - (100, 120, 60)).mean(axis=-1)[alpha > 0] * alpha[alpha > 0] / 255.0
    assert error.mean() < (0.1 if reduction == 1 else 1.5)
    if is_straight and reduction == 1:
        np.testing.assert_array_equal(found, image)


def test_a_picture_of_one_colour_stays() -> None:
    image = np.full((SIDE_PX, SIDE_PX, 3), 77, np.uint8)
    np.testing.assert_array_equal(matte.decontaminate_colours(image, make_soft_disc(3.0)), image)


def test_a_strand_too_thin_to_be_sure_takes_the_colours_around_it() -> None:
    """The nearest sure pixels of each side are asked for, wherever they lie; a hair of two soft pixels has them far."""
    alpha = make_soft_disc()
    alpha[:11, 30:32] = 128
    image = composite_colours((200, 40, 90), (20, 180, 60), alpha)
    np.testing.assert_allclose(
        matte.decontaminate_colours(image, alpha)[:11, 30:32], np.broadcast_to((200, 40, 90), (11, 2, 3)), atol=1
    )


def test_input_image_is_not_modified() -> None:
    image = composite_colours((200, 40, 90), (20, 180, 60), make_soft_disc())
    before = image.copy()
    matte.decontaminate_colours(image, make_soft_disc())
    np.testing.assert_array_equal(image, before)


@pytest.mark.parametrize("factor", [1.0, 0.8, 0.37])
def test_a_smaller_picture_of_a_person_holds_no_backdrop(factor: float) -> None:
    """A premultiplied picture shrinks like any other; the straight colours must be those that it then has."""
    alpha = make_soft_disc().astype(np.float32) / 255.0
    image = np.random.default_rng(0).random((SIDE_PX, SIDE_PX, 3), dtype=np.float32)
    size = (round(factor * SIDE_PX), round(factor * SIDE_PX) - 3)
    colour, reduced = matte.resize_premultiplied(image, alpha, size)
    assert colour.shape == (*size[::-1], 3)
    np.testing.assert_allclose(
        colour * reduced[..., None], cv2.resize(image * alpha[..., None], size, interpolation=cv2.INTER_AREA), atol=1e-6
    )
    plain, _ = matte.resize_premultiplied(np.where(alpha[..., None] > 0, np.float32(0.7), image), alpha, size)
    np.testing.assert_allclose(plain[reduced > 1e-3], 0.7, atol=1e-3)
    assert 0.1 < (reduced > 1e-3).mean() < 0.5


def test_real_video_gets_closer_to_the_green_screen_key(shared_data):
    """The key at half of the local green, see docs/decisions/capture.md; three frames of the full turn."""
    from pipeline.capture.person_detector import PersonDetector
    from pipeline.capture.video import open_frame_source, read_frames

    detector = PersonDetector()
    source = open_frame_source(shared_data / "real" / "dakse" / "video.mp4")
    for frame in read_frames(source, {0, 64, 140}.__contains__, 2000):
        found = detector.detect(frame.rgb)
        assert found is not None
        truth = half_key(frame.rgb)
        before = intersection_over_union(found.mask > 127, truth)
        after = intersection_over_union(matte.estimate_alpha_matte(frame.rgb, found.mask) > 0.5, truth)
        assert after > max(0.98, before + 0.005)


def half_key(rgb: np.ndarray) -> np.ndarray:
    """Green-screen key: the person is where greenness is nearer to that of the person around than to the screen's."""
    r, g, b = (rgb[..., i].astype(np.float32) for i in range(3))
    rough = (g - np.maximum(r, b) < 14).astype(np.uint8)
    _, labels, stats, _ = cv2.connectedComponentsWithStats(rough)
    rough = (labels == 1 + stats[1:, cv2.CC_STAT_AREA].argmax()).astype(np.uint8)
    green, disc = g - (r + b) / 2, cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (9, 9))

    def around(weight: np.ndarray) -> np.ndarray:
        near, far = (
            (cv2.GaussianBlur(weight * green, (0, 0), sigma), cv2.GaussianBlur(weight, (0, 0), sigma))
            for sigma in (6, 24)
        )
        return (near[0] + 1e-4 * far[0] / (far[1] + 1e-9)) / (near[1] + 1e-4)

    person = around(cv2.erode(rough, disc).astype(np.float32))
    screen = around(1 - cv2.dilate(rough, disc).astype(np.float32))
    _, labels, stats, _ = cv2.connectedComponentsWithStats((green < (person + screen) / 2).astype(np.uint8))
    return labels == 1 + stats[1:, cv2.CC_STAT_AREA].argmax()


def test_symmetric_systems_are_solved_as_by_lapack():
    random = np.random.default_rng(5)
    matrix = random.normal(size=(7, 9, 3, 3))
    matrix = matrix @ matrix.swapaxes(-1, -2) + 1e-4 * np.eye(3)
    right = random.normal(size=(7, 9, 3))
    upper = np.stack([matrix[..., i, j] for i in range(3) for j in range(i, 3)])
    found = np.stack(solve_symmetric(upper, np.moveaxis(right, -1, 0)), axis=-1)
    np.testing.assert_allclose(found, np.linalg.solve(matrix, right[..., None])[..., 0], rtol=1e-6)


def test_log_density_is_that_of_scipy_until_the_colour_is_far():
    random = np.random.default_rng(6)
    spread = random.normal(0, 0.05, (4, 5, 3, 3))
    covariance = spread @ spread.swapaxes(-1, -2)
    upper = np.stack([covariance[..., i, j] for i in range(3) for j in range(i, 3)])
    weight = np.ones((4, 5))
    weight[0, 0] = 0
    distribution = ColourDistribution(weight, random.random((4, 5, 3)), upper)
    image = np.float32(distribution.mean.repeat(4, axis=0).repeat(4, axis=1) + random.normal(0, 0.05, (16, 20, 3)))
    rows, columns = np.indices((16, 20)).reshape(2, -1)
    found = log_density(image, distribution, (rows, columns)).reshape(16, 20)
    for row, column in ((5, 9), (15, 19), (8, 0)):
        point = row // 4, column // 4
        normal = multivariate_normal(distribution.mean[point], covariance[point] + (3 / 255) ** 2 * np.eye(3))
        peak = normal.logpdf(normal.mean)
        expected = max(normal.logpdf(image[row, column]), peak - 15) + 1.5 * np.log(2 * np.pi)
        assert found[row, column] == pytest.approx(expected, abs=1e-3)
    assert np.isinf(found[:4, :4]).all()
