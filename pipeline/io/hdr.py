"""Tone mapping of high-dynamic-range video (ITU-R BT.2100: HLG, recorded by phones, and PQ) to sRGB.

The signal is displayed on a reference display of 1000 cd/m². HDR reference white (BT.2408, 203 cd/m²) becomes white, so
that a person is as bright as in a standard recording; brighter values are clipped.
"""

from collections.abc import Callable
from functools import cache

import numpy as np
from jaxtyping import Float, UInt8, UInt16

from pipeline.geometry.colour import linear_to_srgb

PQ, HLG = 16, 18
"""Codes of transfer characteristics (ITU-T H.273, table 3)."""
BT_2020 = 9
"""Code of the colour primaries (H.273, table 2)."""

REFERENCE_WHITE_NITS, PEAK_LUMINANCE_NITS, SYSTEM_GAMMA = 203.0, 1000.0, 1.2
BT_2020_LUMINANCE_WEIGHTS = np.array([0.2627, 0.6780, 0.0593], dtype=np.float32)
BT_2020_TO_BT_709 = np.array(
    [[1.6605, -0.5876, -0.0728], [-0.1246, 1.1329, -0.0083], [-0.0182, -0.1006, 1.1187]], dtype=np.float32
)
"""Linear RGB of BT.2020 to linear RGB of BT.709, the primaries of sRGB (ITU-R BT.2407, section 2)."""


def to_srgb(signal: UInt16[np.ndarray, "h w 3"], transfer: int, primaries: int) -> UInt8[np.ndarray, "h w 3"]:
    """Convert an image to sRGB. signal: full 16-bit range. transfer: `HLG` or `PQ`. primaries: code of H.273."""
    nits = _EOTF[transfer](signal)
    linear = nits / REFERENCE_WHITE_NITS
    if primaries == BT_2020:
        linear = linear @ BT_2020_TO_BT_709.T
    return np.rint(255.0 * linear_to_srgb(np.clip(linear, 0.0, 1.0))).astype(np.uint8)


def _hlg_eotf(signal: UInt16[np.ndarray, "h w 3"]) -> Float[np.ndarray, "h w 3"]:
    """Return cd/m² (BT.2100, table 5): inverse camera curve, then the display's gamma, which depends on luminance."""
    scene = _hlg_inverse_oetf_table()[signal]
    return PEAK_LUMINANCE_NITS * (scene @ BT_2020_LUMINANCE_WEIGHTS)[..., None] ** np.float32(SYSTEM_GAMMA - 1) * scene


def _pq_eotf(signal: UInt16[np.ndarray, "h w 3"]) -> Float[np.ndarray, "h w 3"]:
    return _pq_eotf_table()[signal]


@cache
def _hlg_inverse_oetf_table() -> Float[np.ndarray, "65536"]:
    """Return the scene light of every signal value."""
    a, b, c = 0.17883277, 0.28466892, 0.55991073
    level = np.linspace(0.0, 1.0, 1 << 16)
    return np.where(level <= 0.5, level**2 / 3, (np.exp((level - c) / a) + b) / 12).astype(np.float32)


@cache
def _pq_eotf_table() -> Float[np.ndarray, "65536"]:
    """Return cd/m² of every signal value (BT.2100, table 4)."""
    m1, m2, c1, c2, c3 = 0.1593017578125, 78.84375, 0.8359375, 18.8515625, 18.6875
    root = np.linspace(0.0, 1.0, 1 << 16) ** (1 / m2)
    nits = 10000.0 * (np.maximum(root - c1, 0.0) / (c2 - c3 * root)) ** (1 / m1)
    return nits.astype(np.float32)


_EOTF: dict[int, Callable[[np.ndarray], np.ndarray]] = {HLG: _hlg_eotf, PQ: _pq_eotf}
HDR_TRANSFERS = tuple(_EOTF)
