"""Checkpoint of an unfinished frames stage: the detections, which take most of its time."""

from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np
import torch

from pipeline.capture.detection import Detections
from pipeline.capture.hand_detector import HandLandmarks
from pipeline.io.tensors import load_tensors, save_tensors

HANDS_PREFIX = "hands."
MASKS, MASK_ENDS = "masks_png", "mask_ends"
"""All masks one after the other, bytes, and where each of them ends."""


def save_detections(path: Path, detections: Detections) -> None:
    """Write the detections, complete or not at all."""
    arrays = {name: value for name, value in vars(detections).items() if isinstance(value, np.ndarray)}
    arrays |= {f"{HANDS_PREFIX}{name}": value for name, value in vars(detections.hands).items()}
    arrays[MASKS] = np.frombuffer(b"".join(detections.masks_png), np.uint8).copy()
    arrays[MASK_ENDS] = np.cumsum([len(mask) for mask in detections.masks_png])
    numbers = {name: getattr(detections, name) for name in ("width", "height", "scale")}
    save_tensors(path, {name: torch.from_numpy(value) for name, value in arrays.items()}, numbers)


def load_detections(path: Path) -> Detections | None:
    """Read what `save_detections` wrote; None if there is no file.

    Raises:
        UserError: the file is damaged.
    """
    if not path.exists():
        return None
    tensors, numbers = load_tensors(path)
    values: dict[str, Any] = {name: tensor.numpy() for name, tensor in tensors.items()} | numbers
    masks, ends = values.pop(MASKS).tobytes(), [0, *values.pop(MASK_ENDS).tolist()]
    hands = {
        name.removeprefix(HANDS_PREFIX): values.pop(name) for name in list(values) if name.startswith(HANDS_PREFIX)
    }
    masks_png = tuple(masks[start:end] for start, end in pairwise(ends))
    return Detections(**values, hands=HandLandmarks(**hands), masks_png=masks_png)
