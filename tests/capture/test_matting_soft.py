"""What is soft or thin in a mask - blur, hair, narrow gaps - against alphas known by construction."""

import cv2
import numpy as np
import pytest

from pipeline.capture.masks import matting as matte
from tests.capture.test_matting import composite, detector_mask, figure

CELL_PX = 1.4
"""Cells of the real detector on a person as high as `figure`."""


def blurred(image: np.ndarray, kind: str) -> np.ndarray:
    """By a lens out of focus, or by a hand that moves during the exposure."""
    if kind == "motion":
        return cv2.blur(image, (9, 1))
    return cv2.GaussianBlur(image, (0, 0), float(kind)) if float(kind) else image


def near_outline(alpha: np.ndarray, reach_px: float) -> np.ndarray:
    inside, outside = (
        cv2.distanceTransform(part.astype(np.uint8), cv2.DIST_L2, 5) for part in (alpha > 0.5, alpha <= 0.5)
    )
    return np.maximum(inside, outside) < reach_px


def soft_share(alpha: np.ndarray, true: np.ndarray) -> float:
    """Soft pixels over those that are truly soft."""
    counts = [((each > 0.02) & (each < 0.98)).sum() for each in (alpha, true)]
    return float(counts[0] / counts[1])


def before_a_busy_wall(alpha: np.ndarray) -> np.ndarray:
    """Dark hair, red shirt, blue trousers before blotches of random colours; video noise."""
    rng, rows = np.random.default_rng(0), np.mgrid[: alpha.shape[0], : alpha.shape[1]][0]
    blotches = rng.uniform(60, 230, (alpha.shape[0] // 8, alpha.shape[1] // 8, 3)).astype(np.float32)
    wall = cv2.resize(blotches, alpha.shape[::-1], interpolation=cv2.INTER_LINEAR)
    person = np.where((rows < 95)[..., None], (40, 28, 20), (190, 60, 50))
    person = np.where((rows < 190)[..., None], person, (40, 45, 90))
    mixed = alpha[..., None] * person + (1 - alpha[..., None]) * wall + rng.normal(0, 2, (*alpha.shape, 3))
    return np.clip(np.rint(mixed), 0, 255).astype(np.uint8)


def with_strands(width_px: int, length_px: int) -> tuple[np.ndarray, np.ndarray]:
    """The figure with nine strands of hair around its head: true alpha, and where the strands are."""
    big, body = np.zeros((1280, 1280), np.uint8), figure()
    for angle in np.deg2rad(np.arange(190, 360, 20)):
        direction = np.array([np.cos(angle), np.sin(angle)])
        root = np.array([640, 260]) + direction * [85, 105]
        ends = [tuple(int(v) for v in np.rint(place)) for place in (root, root + 4 * length_px * direction)]
        cv2.line(big, *ends, 255, 4 * width_px)
    strands = cv2.resize(big, body.shape[::-1], interpolation=cv2.INTER_AREA).astype(np.float32) / 255.0
    return np.maximum(body, strands), (strands > 0.02) & (body < 0.02)


def with_gap(gap_px: int) -> tuple[np.ndarray, tuple[slice, slice]]:
    """A trunk and an arm beside it that are joined at the shoulder: true alpha, and the gap without its ends."""
    alpha = np.zeros((320, 320), np.float32)
    alpha[40:300, 110:180] = 1.0
    alpha[90:220, 180 + gap_px : 205 + gap_px] = 1.0
    alpha[90:100, 180 : 180 + gap_px] = 1.0
    return alpha, (slice(110, 210), slice(180, 180 + gap_px))


@pytest.mark.parametrize("contrast", [0.8, 0.1])
@pytest.mark.parametrize("blur_px", [0.0, 1.0, 2.0, 3.0])
def test_blur_is_measured_whatever_the_contrast(blur_px: float, contrast: float) -> None:
    true = figure()
    image = 0.1 + contrast * blurred(true, str(blur_px))[..., None].repeat(3, axis=2)
    line = matte.inner_boundary(true > 0.5)
    found = float(np.median(matte.estimate_edge_blur_px(image, true > 0.5, 12.0)[line]))
    print(f"{blur_px} px found as {found:.2f}")
    assert found == pytest.approx(blur_px, rel=0.2, abs=0.45)


def test_there_is_no_blur_without_an_edge_nor_far_from_one() -> None:
    body = np.zeros((160, 160), bool)
    body[20:40, 20:40] = True
    plain = np.full((160, 160, 3), 0.5, np.float32)
    assert matte.estimate_edge_blur_px(plain, body, 12.0).max() == 0.0
    soft_wall = cv2.GaussianBlur(np.random.default_rng(0).random((160, 160, 3), dtype=np.float32), (0, 0), 3.0)
    edged = matte.estimate_edge_blur_px(np.where(body[..., None], np.float32(0.9), soft_wall), body, 12.0)
    assert edged[60:].max() == edged[:, 60:].max() == 0.0


@pytest.mark.parametrize(("kind", "error"), [("1.5", 0.025), ("3", 0.065), ("motion", 0.045)])
def test_alpha_follows_a_blurred_outline(kind: str, error: float) -> None:
    """Mean error within 8 px of the outline, beside that of the thin rim of a sharp picture; as wide as the blur is."""
    true = blurred(figure(), kind)
    image, guess, near = composite(true), detector_mask(true, CELL_PX), near_outline(true, 8.0)
    found = matte.estimate_alpha_matte(image, guess)
    off, thin = (float(np.abs(each - true)[near].mean()) for each in (found, matte.clean_alpha_matte(found, 1.0)))
    print(f"{kind}: error {off:.4f}, with a thin rim {thin:.4f}, soft share {soft_share(found, true):.2f}")
    assert off < error
    assert off < 0.6 * thin
    assert 0.45 < soft_share(found, true) < 1.2


def test_a_sharp_outline_stays_sharp() -> None:
    true = figure()
    found = matte.estimate_alpha_matte(composite(true), detector_mask(true, CELL_PX))
    assert soft_share(found, true) < 1.4
    assert np.abs(found - true)[near_outline(true, 3.0)].mean() < 0.02


@pytest.mark.parametrize(("width_px", "error", "least"), [(1, 0.4, 0.3), (2, 0.2, 0.75), (3, 0.1, 0.9)])
def test_strands_of_hair_that_the_detector_suspects_stay(width_px: int, error: float, least: float) -> None:
    """Mean error on the strands, share of them that is found (of one pixel a third), and nothing beside them."""
    true, strands = with_strands(width_px, length_px=12)
    found = matte.estimate_alpha_matte(before_a_busy_wall(true), detector_mask(true, CELL_PX, shift_px=0))
    off, share = np.abs(found - true)[strands].mean(), found[strands].sum() / true[strands].sum()
    beside = (cv2.dilate(strands.astype(np.uint8), np.ones((7, 7))) > 0) & ~strands & (true == 0)
    print(f"{width_px} px: error {off:.3f}, {share:.2f} found, {found[beside].mean():.4f} beside")
    assert off < error
    assert share > least
    assert found[beside].mean() < 0.03


@pytest.mark.parametrize("wall", [composite, before_a_busy_wall])
@pytest.mark.parametrize("gap_px", [2, 3, 5])
def test_a_gap_of_a_few_pixels_stays_open(gap_px: int, wall) -> None:
    """Its two sides are the person, and no wall that is known for sure is near: the wall further off must tell."""
    true, gap = with_gap(gap_px)
    guess = detector_mask(true, CELL_PX, shift_px=0)
    found = matte.estimate_alpha_matte(wall(true), guess)
    print(f"{gap_px} px: alpha {guess[gap].mean() / 255.0:.2f} -> {found[gap].mean():.3f}")
    assert found[gap].mean() < 0.2
    assert found[110:210, 120:170].min() == 1.0
