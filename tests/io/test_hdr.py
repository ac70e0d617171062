"""Against BT.2100's own curves in their other direction, and a colour matrix derived from the primaries."""

import numpy as np
import pytest

from pipeline.io.hdr import BT_2020, HLG, PQ, to_srgb

WHITE_XY = (0.3127, 0.3290)
BT_2020_XY = ((0.708, 0.292), (0.170, 0.797), (0.131, 0.046))
BT_709_XY = ((0.640, 0.330), (0.300, 0.600), (0.150, 0.060))


def to_xyz(primaries_xy):
    """Linear RGB to XYZ: the primaries' directions, scaled so that equal parts are white."""
    xyz = np.array([[x / y, 1.0, (1 - x - y) / y] for x, y in (*primaries_xy, WHITE_XY)]).T
    return xyz[:, :3] * np.linalg.solve(xyz[:, :3], xyz[:, 3])


def hlg_signal(nits):
    """BT.2100 table 5 forwards: display light to scene light (the inverse of the OOTF), then the camera's curve."""
    luminance = nits @ np.array([0.2627, 0.6780, 0.0593])
    scene = nits / 1000 * np.where(luminance > 0, luminance / 1000, 1)[..., None] ** (1 / 1.2 - 1)
    a, b, c = 0.17883277, 0.28466892, 0.55991073
    return np.where(scene <= 1 / 12, np.sqrt(3 * scene), a * np.log(np.maximum(12 * scene - b, 1e-9)) + c)


def pq_signal(nits):
    """SMPTE ST 2084's equation."""
    y = (nits / 10000) ** 0.1593017578125
    return ((0.8359375 + 18.8515625 * y) / (1 + 18.6875 * y)) ** 78.84375


@pytest.mark.parametrize(("transfer", "encode"), [(HLG, hlg_signal), (PQ, pq_signal)])
@pytest.mark.parametrize("primaries", [BT_2020, 1])
def test_an_srgb_picture_shown_on_an_hdr_display_comes_back(transfer, encode, primaries):
    picture = np.random.default_rng(0).integers(0, 256, (16, 20, 3))
    coded = picture / 255
    linear = np.where(coded <= 0.04045, coded / 12.92, ((coded + 0.055) / 1.055) ** 2.4)
    if primaries == BT_2020:
        linear = linear @ (np.linalg.inv(to_xyz(BT_2020_XY)) @ to_xyz(BT_709_XY)).T
    signal = np.rint(65535 * encode(203.0 * np.clip(linear, 0, None))).astype(np.uint16)
    shown = to_srgb(signal, transfer, primaries)
    np.testing.assert_allclose(shown.astype(int), picture, atol=1)


@pytest.mark.parametrize(
    ("transfer", "signal", "nits"), [(HLG, 0.75, 203), (HLG, 1.0, 1000), (PQ, 0.58, 203), (PQ, 0.51, 100), (PQ, 0, 0)]
)
def test_known_levels_of_bt_2408(transfer, signal, nits):
    """Table 1 of BT.2408 and the curves' ends, to the two digits that it has."""
    shown = to_srgb(np.full((1, 1, 3), round(65535 * signal), dtype=np.uint16), transfer, BT_2020)[0, 0]
    linear = min(1.0, nits / 203)
    truth = 255 * (1.055 * linear ** (1 / 2.4) - 0.055 if linear > 0.0031308 else 12.92 * linear)
    np.testing.assert_allclose(shown, truth, atol=4)
    assert shown.max() - shown.min() <= 1
