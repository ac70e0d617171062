"""Image metrics against a slow reference implementation and closed forms."""

import math

import cv2
import numpy as np
import pytest
from skimage.metrics import structural_similarity

from pipeline.metrics.flip import flip_map
from pipeline.metrics.images import (
    additional_blur_sigma_px,
    composite_on_white,
    composite_premultiplied_on_white,
    edge_blur_sigma_px,
    foreground_bounding_box,
    foreground_mask,
    frame_scores,
    mask_iou,
    mean_scores,
    psnr_db,
    reason_not_scorable,
    ssim,
    validation_psnr_db,
)
from pipeline.metrics.lpips import lpips
from tests.metrics.narrow_alexnet import narrow_alexnet


@pytest.fixture
def pair(rng: np.random.Generator) -> tuple[np.ndarray, np.ndarray]:
    image = rng.integers(0, 256, (40, 31, 3)).astype(np.uint8)
    noisy = np.clip(image + rng.normal(0, 20, image.shape), 0, 255).astype(np.uint8)
    return noisy, image


def reference_ssim(x: np.ndarray, y: np.ndarray) -> float:
    """The definition, window by window, as documented by torchmetrics (which crops its reflection padding again)."""
    offsets = np.arange(-5, 6)
    window = np.exp(-(offsets[:, None] ** 2 + offsets[None] ** 2) / (2 * 1.5**2))
    window /= window.sum()
    values = []
    for channel in range(3):
        for row in range(5, x.shape[0] - 5):
            for column in range(5, x.shape[1] - 5):
                a = x[row - 5 : row + 6, column - 5 : column + 6, channel] / 255.0
                b = y[row - 5 : row + 6, column - 5 : column + 6, channel] / 255.0
                mean_a, mean_b = (window * a).sum(), (window * b).sum()
                variance_a, variance_b = (window * (a - mean_a) ** 2).sum(), (window * (b - mean_b) ** 2).sum()
                covariance = (window * (a - mean_a) * (b - mean_b)).sum()
                top = (2 * mean_a * mean_b + 1e-4) * (2 * covariance + 9e-4)
                values.append(top / ((mean_a**2 + mean_b**2 + 1e-4) * (variance_a + variance_b + 9e-4)))
    return float(np.mean(values))


def test_ssim_agrees_with_the_definition(pair):
    assert ssim(*pair) == pytest.approx(reference_ssim(*pair), abs=1e-9)


def test_ssim_of_all_pixels_is_that_of_scikit_image(pair):
    expected = structural_similarity(
        *pair, channel_axis=2, gaussian_weights=True, sigma=1.5, use_sample_covariance=False, data_range=255
    )
    assert ssim(*pair) == pytest.approx(expected, abs=1e-9)


def test_ssim_of_equal_images_is_one_and_small_images_are_refused(pair):
    assert ssim(pair[0], pair[0]) == pytest.approx(1.0)
    with pytest.raises(ValueError, match="11 px window"):
        ssim(pair[0][:10], pair[1][:10])


def test_masked_ssim_is_the_mean_over_the_windows_centred_in_the_mask(pair):
    noisy, image = pair
    where = np.zeros(image.shape[:2], dtype=bool)
    where[12, 9] = where[30, 20] = True
    expected = [
        ssim(noisy[r - 5 : r + 6, c - 5 : c + 6], image[r - 5 : r + 6, c - 5 : c + 6]) for r, c in ((12, 9), (30, 20))
    ]
    assert ssim(noisy, image, where) == pytest.approx(np.mean(expected))
    with pytest.raises(ValueError, match="no window"):
        ssim(noisy, image, np.zeros_like(where))


@pytest.mark.parametrize("step", [1, 10, 255])
def test_psnr_of_a_constant_offset_is_closed_form(step):
    dark = np.zeros((5, 7, 3), dtype=np.uint8)
    assert psnr_db(dark + np.uint8(step), dark) == pytest.approx(20 * math.log10(255 / step))


def test_masked_psnr_compares_only_the_pixels_of_the_mask(pair):
    noisy, image = pair
    where = np.zeros(image.shape[:2], dtype=bool)
    where[3:9, 4:20] = True
    assert psnr_db(noisy, image, where) == pytest.approx(psnr_db(noisy[3:9, 4:20], image[3:9, 4:20]))
    assert psnr_db(image, image) == math.inf
    with pytest.raises(ValueError, match="no pixel"):
        psnr_db(noisy, image, np.zeros_like(where))


def test_validation_psnr_is_the_mean_over_frames_in_db(rng):
    images = [rng.integers(0, 256, (height, 7, 3)).astype(np.uint8) for height in (5, 9)]
    renders = [image ^ np.uint8(mask) for image, mask in zip(images, (1, 16), strict=True)]
    expected = [20 * math.log10(255 / step) for step in (1, 16)]
    assert validation_psnr_db(renders, images) == pytest.approx(np.mean(expected))
    masks = [np.zeros((5, 7), dtype=bool), np.ones((9, 7), dtype=bool)]
    assert validation_psnr_db(renders, images, masks) == pytest.approx(expected[1])  # an empty mask is ignored
    assert math.isnan(validation_psnr_db(renders, images, [mask & False for mask in masks]))
    assert math.isnan(validation_psnr_db([], []))


def test_frames_and_premultiplied_renders_are_composited_alike(rng):
    rgb = rng.integers(0, 256, (6, 5, 3)).astype(np.uint8)
    alpha = rng.integers(0, 256, (6, 5)).astype(np.uint8)
    opacity = alpha[..., None] / np.float32(255)
    rgba = np.concatenate([rgb / np.float32(255) * opacity, opacity], axis=2).astype(np.float32)
    difference = composite_premultiplied_on_white(rgba).astype(int) - composite_on_white(rgb, alpha)
    assert np.abs(difference).max() <= 1  # the same value rounded in two ways
    assert (composite_on_white(rgb, np.zeros_like(alpha)) == 255).all()
    assert (composite_on_white(rgb, np.full_like(alpha, 255)) == rgb).all()


def test_bounding_box_is_tight():
    body = np.zeros((20, 30), dtype=bool)
    body[4, 9] = body[11, 17] = True
    assert foreground_bounding_box(body) == (slice(4, 12), slice(9, 18))
    with pytest.raises(ValueError, match="no foreground pixel"):
        foreground_bounding_box(np.zeros((4, 4), dtype=bool))


def test_iou_of_two_overlapping_boxes():
    a, b = np.zeros((10, 10), dtype=bool), np.zeros((10, 10), dtype=bool)
    a[:, :6], b[:, 4:] = True, True
    assert mask_iou(a, b) == pytest.approx(2 / 10)
    assert mask_iou(a & False, b & False) == 1.0


def test_frame_scores_of_a_perfect_and_of_an_empty_render(rng):
    image = rng.integers(0, 200, (48, 40, 3)).astype(np.uint8)
    mask = np.zeros((48, 40), dtype=np.uint8)
    mask[8:40, 10:30] = 255
    solid = (mask[..., None] / 255.0).astype(np.float32)
    perfect = np.concatenate([image / np.float32(255) * solid, solid], axis=2).astype(np.float32)
    scores = frame_scores(perfect, image, mask)
    assert scores["psnr_full"] == scores["psnr_body"] == math.inf
    assert scores["mask_iou"] == 1.0
    empty = frame_scores(np.zeros_like(perfect), image, mask)
    assert empty["mask_iou"] == 0.0
    share = foreground_mask(
        mask
    ).mean()  # all error is in the foreground, so the full image only divides it by more pixels
    assert empty["psnr_full"] - empty["psnr_body"] == pytest.approx(-10 * math.log10(share))
    assert empty["psnr_box"] == pytest.approx(empty["psnr_body"])
    assert scores["flip_full"] == scores["flip_body"] == 0.0
    assert empty["flip_body"] == pytest.approx(empty["flip_box"])
    assert empty["flip_full"] < empty["flip_body"]
    assert scores["ssim_body"] == pytest.approx(1.0)
    assert "lpips_full" not in scores
    assert frame_scores(perfect, image, mask, narrow_alexnet(rng)) == scores  # 48 x 40 px are too few for LPIPS


def test_each_score_is_the_named_metric_on_the_named_pixels(rng):
    """Noise with a soft mask, whose scores are all different, so that exchanged scores are found."""
    rows, columns = np.mgrid[:90, :70]
    mask, alpha = (np.clip(30.5 - np.hypot((rows - 42) / 1.1, columns - middle), 0, 1) for middle in (36, 39))
    mask, alpha = np.rint(255 * mask).astype(np.uint8), alpha[..., None].astype(np.float32)
    image = rng.integers(0, 256, (90, 70, 3)).astype(np.uint8)
    noisy = np.clip(image / 255 + rng.normal(0, 0.1, image.shape), 0, 1)
    rgba = np.concatenate([noisy.astype(np.float32) * alpha, alpha], axis=2)
    weights = narrow_alexnet(rng)
    render = np.rint(255 * (rgba[..., :3] + (1 - alpha))).astype(np.uint8)
    target = np.rint(255 - mask[..., None] / 255 * (255.0 - image)).astype(np.uint8)
    body = mask > 127
    box = tuple(slice(where.min(), where.max() + 1) for where in np.nonzero(body))
    differences = flip_map(render, target)
    expected = {
        "psnr_full": psnr_db(render, target),
        "psnr_body": psnr_db(render, target, body),
        "psnr_box": psnr_db(render[box], target[box]),
        "ssim_full": ssim(render, target),
        "ssim_body": ssim(render, target, body),
        "ssim_box": ssim(render[box], target[box]),
        "flip_full": differences.mean(),
        "flip_body": differences[body].mean(),
        "flip_box": differences[box].mean(),
        "mask_iou": ((alpha[..., 0] >= 0.5) & body).sum() / ((alpha[..., 0] >= 0.5) | body).sum(),
        "lpips_full": lpips(render, target, weights),
    }
    assert frame_scores(rgba, image, mask, weights) == pytest.approx(expected)
    assert np.diff(sorted(expected.values())).min() > 1e-3


def masks_near_the_size_limit() -> list[np.ndarray]:
    """Empty, boxes about the size of the SSIM window, and foregrounds along the image border."""
    made = [np.zeros((40, 30), dtype=np.uint8)]
    for height, width in ((10, 20), (11, 11), (20, 10), (12, 13)):
        made.append(np.zeros_like(made[0]))
        made[-1][8 : 8 + height, 7 : 7 + width] = 200
    for thickness in (5, 6):
        made.append(np.full_like(made[0], 200))
        made[-1][thickness:, : 30 - thickness] = 0
    return [*made, np.full_like(made[0], 127)]


@pytest.mark.parametrize("mask", masks_near_the_size_limit())
def test_reason_not_scorable_predicts_the_errors_of_frame_scores(mask):
    image, rgba = np.zeros((*mask.shape, 3), dtype=np.uint8), np.zeros((*mask.shape, 4), dtype=np.float32)
    if reason_not_scorable(mask) is None:
        assert frame_scores(rgba, image, mask)["mask_iou"] == 0.0
    else:
        with pytest.raises(ValueError, match="no pixel of its mask|SSIM window|px of the border"):
            frame_scores(rgba, image, mask)


def test_reasons_name_the_problem():
    reasons = [reason_not_scorable(mask) for mask in masks_near_the_size_limit()]
    assert [bool(reason) for reason in reasons] == [True, True, False, True, False, True, False, True]
    assert "one half" in reasons[0]
    assert "20 x 10 px" in reasons[1]
    assert "border" in reasons[5]


def test_mean_scores():
    assert mean_scores([{"a": 1.0, "b": 2.0}, {"a": 3.0, "b": 4.0}]) == {"a": 2.0, "b": 3.0}
    with pytest.raises(ValueError, match="no scored frame"):
        mean_scores([])


@pytest.mark.parametrize("sigma_px", [0.0, 0.7, 1.5])
def test_edge_blur_is_that_of_the_gaussian(sigma_px):
    rows, columns = np.mgrid[:1200, :1200] / 4.0
    disc = (np.hypot(rows - 149.3, columns - 151.1) < 90.2).astype(np.float32)
    square_pixels = disc.reshape(300, 4, 300, 4).mean((1, 3))
    soft = square_pixels if sigma_px == 0.0 else cv2.GaussianBlur(square_pixels, (0, 0), sigma_px)
    edge_sigma_px = edge_blur_sigma_px(np.rint(255 * soft).astype(np.uint8))
    assert edge_sigma_px == pytest.approx(np.hypot(sigma_px, 12**-0.5), rel=0.04)
    assert additional_blur_sigma_px(float(np.hypot(sigma_px, 12**-0.5))) == pytest.approx(sigma_px, abs=1e-6)
    assert additional_blur_sigma_px(0.2) == 0.0  # a binary mask is sharper than antialiased square pixels


def test_a_mask_without_outline_has_no_edge_blur():
    assert edge_blur_sigma_px(np.zeros((20, 20), dtype=np.uint8)) == 0.0
