"""Image error of a render against a held-out frame.

Both images are composited on white and rounded to 8 bits before the comparison, as in InstantAvatar (Jiang et al., CVPR
2023). PSNR and SSIM follow the definitions of torchmetrics (data range 1, one value per image). A large part of such an
image is white in both, which raises the scores; therefore the same scores are also computed on the foreground pixels
and on the bounding box of the foreground.
"""

import math
from collections.abc import Iterable, Mapping
from itertools import repeat

import numpy as np
from jaxtyping import Bool, Float, UInt8
from skimage.measure import perimeter_crofton
from skimage.metrics import structural_similarity
from torch import Tensor

from pipeline.metrics.flip import flip_map
from pipeline.metrics.lpips import MIN_SIDE_PX, lpips

SSIM_SIGMA_PX = 1.5
SSIM_RADIUS_PX = 5
"""Radius of the Gaussian window of SSIM: int(3.5 sigma + 0.5), an 11 x 11 window."""
_VALID_REGION = slice(SSIM_RADIUS_PX, -SSIM_RADIUS_PX)

MARGIN_PX = 16
"""Margin around the pixels that differ within which SSIM and FLIP are computed: above twice the radius of the window of
SSIM and above that of the filters of FLIP (10 px), so that the scores are those of the whole image."""

PIXEL_BOX_SIGMA_PX = math.sqrt(1.0 / 12.0)
"""Standard deviation of a square pixel: the blur of a sharp outline in any image."""


def composite_on_white(rgb: UInt8[np.ndarray, "h w 3"], alpha: UInt8[np.ndarray, "h w"]) -> UInt8[np.ndarray, "h w 3"]:
    """Composite an image with straight alpha on white, rounded to 8 bits."""
    opacity = alpha[..., None].astype(np.float32) / 255.0
    return np.rint(rgb * opacity + 255.0 * (1.0 - opacity)).astype(np.uint8)


def composite_premultiplied_on_white(rgba: Float[np.ndarray, "h w 4"]) -> UInt8[np.ndarray, "h w 3"]:
    """Composite a render with premultiplied colours in [0, 1] on white, clipped and rounded to 8 bits."""
    colour = rgba[..., :3] + (1.0 - rgba[..., 3:])
    return np.rint(255.0 * np.clip(colour, 0.0, 1.0)).astype(np.uint8)


def foreground_mask(alpha: UInt8[np.ndarray, "h w"]) -> Bool[np.ndarray, "h w"]:
    """Return the foreground pixels, which have an alpha of at least one half."""
    return alpha >= 128


def foreground_bounding_box(foreground: Bool[np.ndarray, "h w"]) -> tuple[slice, slice]:
    """Return the rows and columns of the bounding box of the foreground.

    Raises:
        ValueError: there is no foreground pixel.
    """
    rows, columns = np.flatnonzero(foreground.any(axis=1)), np.flatnonzero(foreground.any(axis=0))
    if not len(rows):
        raise ValueError("the mask has no foreground pixel")
    return slice(int(rows[0]), int(rows[-1]) + 1), slice(int(columns[0]), int(columns[-1]) + 1)


def reason_not_scorable(mask: UInt8[np.ndarray, "h w"]) -> str | None:
    """Return the reason for which `frame_scores` refuses a frame with this mask, or None if it accepts the mask."""
    foreground = foreground_mask(mask)
    if not foreground.any():
        return "no pixel of its mask has an alpha of at least one half"
    height_px, width_px = (part.stop - part.start for part in foreground_bounding_box(foreground))
    if min(height_px, width_px) <= 2 * SSIM_RADIUS_PX:
        return f"the foreground has {width_px} x {height_px} px, which is smaller than the SSIM window of 11 x 11 px"
    if not foreground[_VALID_REGION, _VALID_REGION].any():
        return f"all foreground pixels are within {SSIM_RADIUS_PX} px of the border of the image"
    return None


def psnr_db(
    render: UInt8[np.ndarray, "h w 3"],
    image: UInt8[np.ndarray, "h w 3"],
    pixel_mask: Bool[np.ndarray, "h w"] | None = None,
) -> float:
    """Return the peak signal-to-noise ratio, -10 log10(mean squared error on [0, 1]); infinite for equal images.

    Args:
        render, image: the two images.
        pixel_mask: pixels that are compared; all pixels if None.

    Raises:
        ValueError: the mask is empty.
    """
    difference = (render.astype(np.float64) - image) / 255.0
    if pixel_mask is not None:
        if not pixel_mask.any():
            raise ValueError("the pixel mask is empty: there is no pixel to compare")
        difference = difference[pixel_mask]
    mean_squared_error = float(np.mean(difference**2))
    return math.inf if mean_squared_error == 0.0 else -10.0 * math.log10(mean_squared_error)


def validation_psnr_db(
    renders: Iterable[UInt8[np.ndarray, "_ _ 3"]],
    images: Iterable[UInt8[np.ndarray, "_ _ 3"]],
    pixel_masks: Iterable[Bool[np.ndarray, "_ _"]] | None = None,
) -> float:
    """Return the validation PSNR of field, mesh and texture: the mean over frames of `psnr_db`.

    Args:
        renders, images: one pair per validation frame, composited on white; the frames may have different sizes.
        pixel_masks: pixels that are compared, one mask per frame; all pixels if None. Frames with an empty mask are
            ignored.

    Returns:
        The mean in dB; NaN if no frame has a pixel to compare.
    """
    pairs = zip(renders, images, strict=True)
    masked = zip(pairs, repeat(None), strict=False) if pixel_masks is None else zip(pairs, pixel_masks, strict=True)
    values = [psnr_db(*pair, mask) for pair, mask in masked if mask is None or mask.any()]
    return float(np.mean(values)) if values else math.nan


def ssim(
    render: UInt8[np.ndarray, "h w 3"],
    image: UInt8[np.ndarray, "h w 3"],
    pixel_mask: Bool[np.ndarray, "h w"] | None = None,
) -> float:
    """Return the structural similarity in [-1, 1] (Wang et al. 2004), the mean over channels and windows.

    Only windows that are completely inside the image count. The window is Gaussian with sigma 1.5 px, truncated to
    11 x 11 px; k1 = 0.01, k2 = 0.03, population variances: the defaults of torchmetrics.

    Args:
        render, image: the two images.
        pixel_mask: windows centred at these pixels count; all windows if None.

    Raises:
        ValueError: a side is shorter than the window, or no window counts.
    """
    if min(image.shape[:2]) <= 2 * SSIM_RADIUS_PX:
        raise ValueError(f"an image of {image.shape[1]} x {image.shape[0]} px is smaller than the 11 px window of SSIM")
    return _mean_of_windows(ssim_map(render, image), pixel_mask)


def ssim_map(render: UInt8[np.ndarray, "h w 3"], image: UInt8[np.ndarray, "h w 3"]) -> Float[np.ndarray, "h w"]:
    """Return the similarity of the window at each pixel, see `ssim`; windows that leave the image do not count."""
    _, similarity = structural_similarity(
        render.astype(np.float64) / 255.0,
        image.astype(np.float64) / 255.0,
        channel_axis=2,
        data_range=1.0,
        gaussian_weights=True,
        sigma=SSIM_SIGMA_PX,
        use_sample_covariance=False,
        full=True,
    )
    return np.asarray(similarity.mean(axis=2))


def _mean_of_windows(similarity: Float[np.ndarray, "h w"], pixel_mask: Bool[np.ndarray, "h w"] | None = None) -> float:
    similarity = similarity[_VALID_REGION, _VALID_REGION]
    if pixel_mask is not None:
        window_centres = pixel_mask[_VALID_REGION, _VALID_REGION]
        if not window_centres.any():
            raise ValueError("the pixel mask contains no window centre: there is no window to compare")
        similarity = similarity[window_centres]
    return float(np.mean(similarity))


def edge_blur_sigma_px(alpha: UInt8[np.ndarray, "h w"]) -> float:
    """Estimate the blur of a mask's outline: the standard deviation in pixels of a Gaussian applied to a step edge.

    Across an edge with the profile of a blurred step, alpha (1 - alpha) integrates to sigma / sqrt(pi). The length of
    the outline is estimated with Crofton's formula. A sharp outline sampled by square pixels has `PIXEL_BOX_SIGMA_PX`;
    a mask without outline has 0.
    """
    opacity = alpha.astype(np.float64) / 255.0
    length_px = perimeter_crofton(alpha >= 128, directions=4)
    return math.sqrt(math.pi) * float((opacity * (1.0 - opacity)).sum()) / length_px if length_px > 0.0 else 0.0


def additional_blur_sigma_px(edge_sigma_px: float) -> float:
    """Return the standard deviation of the Gaussian that blurs square pixels to `edge_sigma_px` (variances add)."""
    return math.sqrt(max(0.0, edge_sigma_px**2 - PIXEL_BOX_SIGMA_PX**2))


def mask_iou(a: Bool[np.ndarray, "h w"], b: Bool[np.ndarray, "h w"]) -> float:
    """Return the intersection over union of two masks in [0, 1]; 1 if both are empty."""
    union = np.count_nonzero(a | b)
    return np.count_nonzero(a & b) / union if union else 1.0


def frame_scores(
    rgba: Float[np.ndarray, "h w 4"],
    image: UInt8[np.ndarray, "h w 3"],
    mask: UInt8[np.ndarray, "h w"],
    lpips_weights: Mapping[str, Tensor] | None = None,
) -> dict[str, float]:
    """Return all image scores of one frame.

    Args:
        rgba: the render, premultiplied colours and alpha in [0, 1].
        image: the video frame.
        mask: alpha matte of the person in that frame.
        lpips_weights: see `pipeline.metrics.lpips`; without weights there is no LPIPS.

    Returns:
        psnr (dB) and ssim (higher is better) and flip (lower is better), each for the full image, the foreground pixels
        and the bounding box of the foreground: psnr_full, psnr_body, psnr_box, ..., flip_box. mask_iou of the two
        silhouettes. lpips_full (lower is better) if there are weights and no side is shorter than 63 px.

    Raises:
        ValueError: `reason_not_scorable` has a reason.
    """
    reason = reason_not_scorable(mask)
    if reason is not None:
        raise ValueError(reason)
    render = composite_premultiplied_on_white(rgba)
    target, foreground = composite_on_white(image, mask), foreground_mask(mask)
    perceptual: dict[str, float] = {}
    if lpips_weights is not None and min(mask.shape) >= MIN_SIDE_PX:
        perceptual["lpips_full"] = lpips(render, target, lpips_weights)
    box = foreground_bounding_box(foreground)
    difference = render != target
    difference[box] = True
    rows, columns = foreground_bounding_box(difference.any(axis=2))
    window = tuple(slice(max(0, part.start - MARGIN_PX), part.stop + MARGIN_PX) for part in (rows, columns))
    similarity, flip = np.ones(mask.shape), np.zeros(mask.shape)
    similarity[window] = ssim_map(render[window], target[window])
    flip[window] = flip_map(render[window], target[window])
    return {
        "psnr_full": psnr_db(render, target),
        "psnr_body": psnr_db(render, target, foreground),
        "psnr_box": psnr_db(render[box], target[box]),
        "ssim_full": _mean_of_windows(similarity),
        "ssim_body": _mean_of_windows(similarity, foreground),
        "ssim_box": _mean_of_windows(similarity[box]),
        "flip_full": float(flip.mean()),
        "flip_body": float(flip[foreground].mean()),
        "flip_box": float(flip[box].mean()),
        "mask_iou": mask_iou(rgba[..., 3] >= 0.5, foreground),
        **perceptual,
    }


def mean_scores(frames: Iterable[Mapping[str, float]]) -> dict[str, float]:
    """Return the mean of each score over frames; PSNR is averaged in dB, as in the literature.

    Raises:
        ValueError: there is no frame.
    """
    rows = list(frames)
    if not rows:
        raise ValueError("there is no scored frame to average")
    return {name: float(np.mean([row[name] for row in rows])) for name in rows[0]}
