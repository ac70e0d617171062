"""Contact sheet of masks and landmarks, for inspection by eye."""

import cv2
import numpy as np
from jaxtyping import UInt8

from pipeline.capture.capture import Capture
from pipeline.capture.frame_selection import HELDOUT, VALIDATION, evenly_spaced
from pipeline.capture.landmarks import POSE_CONNECTIONS
from pipeline.capture.masks.matting import inner_boundary
from pipeline.io.image import to_uint8

_TILE_HEIGHT_PX, _COLUMNS, _ROWS = 320, 8, 3
_LEFT, _RIGHT, _OUTLINE = (80, 160, 255), (255, 170, 40), (255, 0, 255)
_SPLIT_SIGN = {HELDOUT: " held out", VALIDATION: " validation"}


def contact_sheet(capture: Capture) -> UInt8[np.ndarray, "h w 3"]:
    """Draw up to 24 evenly spaced frames with mask outline, bones (left blue, right orange) and frame index."""
    positions = evenly_spaced(len(capture), _COLUMNS * _ROWS)
    tiles = [_tile(capture, int(position)) for position in positions]
    width = max(tile.shape[1] for tile in tiles)
    tiles = [cv2.copyMakeBorder(tile, 0, 0, 0, width - tile.shape[1], cv2.BORDER_CONSTANT) for tile in tiles]
    tiles += [np.zeros_like(tiles[0])] * (-len(tiles) % _COLUMNS)
    rows = [np.concatenate(tiles[start : start + _COLUMNS], axis=1) for start in range(0, len(tiles), _COLUMNS)]
    return np.concatenate(rows, axis=0)


def _tile(capture: Capture, position: int) -> UInt8[np.ndarray, "h w 3"]:
    """Crop one frame to the person and draw outline, bones and index on it."""
    image, body = to_uint8(capture.image(position)), capture.mask(position) > 0.5
    top, bottom, left, right = _box(body)
    scale = _TILE_HEIGHT_PX / (bottom - top)
    size = (max(1, round((right - left) * scale)), _TILE_HEIGHT_PX)
    tile = cv2.resize(image[top:bottom, left:right], size, interpolation=cv2.INTER_AREA)
    tile[inner_boundary(cv2.resize(body[top:bottom, left:right].astype(np.uint8), size) > 0)] = _OUTLINE
    points = (capture.landmarks_px[position] - (left, top)) * scale
    for first, second in POSE_CONNECTIONS:
        if np.isfinite(points[[first, second]]).all():
            colour = _LEFT if second % 2 else _RIGHT
            ends = [tuple(int(value) for value in np.clip(points[k], -9999, 9999)) for k in (first, second)]
            cv2.line(tile, ends[0], ends[1], colour, 1, cv2.LINE_AA)
    text = f"{capture.frame_index[position]}{_SPLIT_SIGN.get(int(capture.split[position]), '')}"
    cv2.putText(tile, text, (4, 14), cv2.FONT_HERSHEY_SIMPLEX, 0.4, (255, 255, 0), 1, cv2.LINE_AA)
    return tile


def _box(body: np.ndarray) -> tuple[int, int, int, int]:
    """Return (top, bottom, left, right) of the person with a 5 % margin; the whole image without a person."""
    if not body.any():
        return 0, body.shape[0], 0, body.shape[1]
    rows, columns = np.flatnonzero(body.any(axis=1)), np.flatnonzero(body.any(axis=0))
    margin = round(0.05 * (rows[-1] - rows[0])) + 1
    top, left = max(0, int(rows[0]) - margin), max(0, int(columns[0]) - margin)
    return top, min(body.shape[0], int(rows[-1]) + margin + 1), left, min(body.shape[1], int(columns[-1]) + margin + 1)
