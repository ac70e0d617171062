"""Image error of a render against a held-out frame.

Full images are composited on white and rounded to 8 bits before they are compared, as InstantAvatar (Jiang et al.,
CVPR 2023) does, and PSNR and SSIM follow torchmetrics' definitions (data range 1, one value an image). Much of such an
image is white on white, which flatters: hence the same figures on body pixels and on the body's bounding box.
"""

import math
from collections.abc import Iterable, Mapping

import cv2
import numpy as np
from jaxtyping import Bool, Float, UInt8
from skimage.measure import perimeter_crofton
from torch import Tensor

from pipeline.metrics.flip import flip_map
from pipeline.metrics.lpips import MIN_SIDE_PX, lpips

SSIM_SIGMA_PX = 1.5
SSIM_RADIUS_PX = 5  # torchmetrics: int(3.5 sigma + 0.5), so an 11 x 11 window
_SSIM_C1, _SSIM_C2 = 0.01**2, 0.03**2
_VALID_REGION = slice(SSIM_RADIUS_PX, -SSIM_RADIUS_PX)

PIXEL_BOX_SIGMA_PX = math.sqrt(1.0 / 12.0)
"""Standard deviation of a square pixel: what a sharp outline is blurred by in any picture."""


def composite_on_white(rgb: UInt8[np.ndarray, "h w 3"], alpha: UInt8[np.ndarray, "h w"]) -> UInt8[np.ndarray, "h w 3"]:
    """The image with its background (straight alpha) replaced by white, rounded to 8 bits."""
    opacity = alpha[..., None].astype(np.float32) / 255.0
    return np.rint(rgb * opacity + 255.0 * (1.0 - opacity)).astype(np.uint8)


def composite_premultiplied_on_white(rgba: Float[np.ndarray, "h w 4"]) -> UInt8[np.ndarray, "h w 3"]:
    """A render with premultiplied colours in [0, 1] laid over white, clipped and rounded to 8 bits."""
    colour = rgba[..., :3] + (1.0 - rgba[..., 3:])
    return np.rint(255.0 * np.clip(colour, 0.0, 1.0)).astype(np.uint8)


def foreground_mask(alpha: UInt8[np.ndarray, "h w"]) -> Bool[np.ndarray, "h w"]:
    """Pixels that the mask gives to the person (alpha of one half and more)."""
    return alpha >= 128


def foreground_bounding_box(body: Bool[np.ndarray, "h w"]) -> tuple[slice, slice]:
    """Rows and columns of the smallest box around the body; ValueError when there is no body pixel."""
    rows, columns = np.flatnonzero(body.any(axis=1)), np.flatnonzero(body.any(axis=0))
    if not len(rows):
        raise ValueError("the mask holds no body pixel")
    return slice(int(rows[0]), int(rows[-1]) + 1), slice(int(columns[0]), int(columns[-1]) + 1)


def reason_not_scorable(mask: UInt8[np.ndarray, "h w"]) -> str | None:
    """Why `frame_scores` refuses a frame with this mask; None when it does not."""
    body = foreground_mask(mask)
    if not body.any():
        return "no pixel of its mask reaches one half"
    height_px, width_px = (part.stop - part.start for part in foreground_bounding_box(body))
    if min(height_px, width_px) <= 2 * SSIM_RADIUS_PX:
        return f"the person in it has {width_px} x {height_px} px, less than the window of SSIM"
    return None if body[_VALID_REGION, _VALID_REGION].any() else "the person in it only lines the picture's border"


def psnr_db(
    render: UInt8[np.ndarray, "h w 3"],
    image: UInt8[np.ndarray, "h w 3"],
    pixel_mask: Bool[np.ndarray, "h w"] | None = None,
) -> float:
    """Peak signal-to-noise ratio, -10 log10(mean squared error on [0, 1]); infinite for equal images.

    Args:
        where: pixels that count; all when None. ValueError when it is empty.
    """
    difference = (render.astype(np.float64) - image) / 255.0
    if pixel_mask is not None:
        if not pixel_mask.any():
            raise ValueError("no pixel to compare")
        difference = difference[pixel_mask]
    mean_squared_error = float(np.mean(difference**2))
    return math.inf if mean_squared_error == 0.0 else -10.0 * math.log10(mean_squared_error)


def ssim(
    render: UInt8[np.ndarray, "h w 3"],
    image: UInt8[np.ndarray, "h w 3"],
    pixel_mask: Bool[np.ndarray, "h w"] | None = None,
) -> float:
    """Structural similarity (Wang et al. 2004) in [-1, 1], mean over channels and over windows inside the image.

    Gaussian window of sigma 1.5 px cut at 11 x 11, k1 = 0.01, k2 = 0.03, population variances: torchmetrics' defaults.

    Args:
        where: windows with these pixels in their middle count; all when None.

    Raises:
        ValueError: a side is shorter than the window, or no window counts.
    """
    if min(image.shape[:2]) <= 2 * SSIM_RADIUS_PX:
        raise ValueError(f"an image of {image.shape[1]} x {image.shape[0]} px is smaller than the 11 px window")
    x, y = render.astype(np.float64) / 255.0, image.astype(np.float64) / 255.0
    mean_x, mean_y = _window_mean(x), _window_mean(y)
    variance_x = np.maximum(_window_mean(x * x) - mean_x**2, 0.0)
    variance_y = np.maximum(_window_mean(y * y) - mean_y**2, 0.0)
    covariance = _window_mean(x * y) - mean_x * mean_y
    luminance = (2.0 * mean_x * mean_y + _SSIM_C1) / (mean_x**2 + mean_y**2 + _SSIM_C1)
    structure = (2.0 * covariance + _SSIM_C2) / (variance_x + variance_y + _SSIM_C2)
    similarity = luminance * structure
    if pixel_mask is not None:
        middles = pixel_mask[_VALID_REGION, _VALID_REGION]
        if not middles.any():
            raise ValueError("no window to compare")
        similarity = similarity[middles]
    return float(np.mean(similarity))


def edge_blur_sigma_px(alpha: UInt8[np.ndarray, "h w"]) -> float:
    """How soft a mask's outline is: standard deviation in pixels of the blur that would make it from a step.

    Across an edge with that profile, a Gaussian's, alpha (1 - alpha) integrates to spread / sqrt(pi); the length of the
    outline is Crofton's. A sharp outline seen by square pixels has `PIXEL_BOX_SIGMA_PX`; a mask without outline has 0.
    """
    opacity = alpha.astype(np.float64) / 255.0
    length_px = perimeter_crofton(alpha >= 128, directions=4)
    return math.sqrt(math.pi) * float((opacity * (1.0 - opacity)).sum()) / length_px if length_px > 0.0 else 0.0


def additional_blur_sigma_px(edge_sigma_px: float) -> float:
    """Standard deviation of the Gaussian that gives a sharp outline of square pixels this spread (variances add)."""
    return math.sqrt(max(0.0, edge_sigma_px**2 - PIXEL_BOX_SIGMA_PX**2))


def mask_iou(a: Bool[np.ndarray, "h w"], b: Bool[np.ndarray, "h w"]) -> float:
    """Intersection over union; 1 when both are empty."""
    union = np.count_nonzero(a | b)
    return np.count_nonzero(a & b) / union if union else 1.0


def frame_scores(
    rgba: Float[np.ndarray, "h w 4"],
    image: UInt8[np.ndarray, "h w 3"],
    mask: UInt8[np.ndarray, "h w"],
    lpips_weights: Mapping[str, Tensor] | None = None,
) -> dict[str, float]:
    """All image scores of one frame.

    Args:
        rgba: the render, premultiplied colours and alpha in [0, 1].
        image: the video frame.
        mask: the person's soft alpha in that frame.
        lpips_weights: see `pipeline.metrics.lpips`; without them there is no LPIPS.

    Returns:
        psnr, ssim (higher is better) and flip (lower) each of the full image, of the body's pixels and of the body's
        box: psnr_full (dB), psnr_body, ..., flip_box. mask_iou of the two silhouettes. lpips_full (lower) with weights,
        for images of 63 px and more.

    Raises:
        ValueError: see `reason_not_scorable`.
    """
    render, target, body = (
        composite_premultiplied_on_white(rgba),
        composite_on_white(image, mask),
        foreground_mask(mask),
    )
    box = foreground_bounding_box(body)
    flip = flip_map(render, target)
    perceptual: dict[str, float] = {}
    if lpips_weights is not None and min(mask.shape) >= MIN_SIDE_PX:
        perceptual["lpips_full"] = lpips(render, target, lpips_weights)
    return {
        "psnr_full": psnr_db(render, target),
        "psnr_body": psnr_db(render, target, body),
        "psnr_box": psnr_db(render[box], target[box]),
        "ssim_full": ssim(render, target),
        "ssim_body": ssim(render, target, body),
        "ssim_box": ssim(render[box], target[box]),
        "flip_full": float(flip.mean()),
        "flip_body": float(flip[body].mean()),
        "flip_box": float(flip[box].mean()),
        "mask_iou": mask_iou(rgba[..., 3] >= 0.5, body),
        **perceptual,
    }


def mean_scores(frames: Iterable[Mapping[str, float]]) -> dict[str, float]:
    """Mean of each score over frames (of the dB values, as the literature does); ValueError without frames."""
    rows = list(frames)
    if not rows:
        raise ValueError("no frame was scored")
    return {name: float(np.mean([row[name] for row in rows])) for name in rows[0]}


def _window_mean(values: Float[np.ndarray, "h w 3"]) -> Float[np.ndarray, "h2 w2 3"]:
    """Gaussian-weighted mean of each window that lies wholly inside the image."""
    offsets = np.arange(-SSIM_RADIUS_PX, SSIM_RADIUS_PX + 1)
    window = np.exp(-0.5 * (offsets / SSIM_SIGMA_PX) ** 2)
    window /= window.sum()
    return cv2.sepFilter2D(values, -1, window, window)[_VALID_REGION, _VALID_REGION]
