"""Small recordings for tests."""

from fractions import Fraction
from pathlib import Path

import av
import numpy as np

IDENTITY = (0x10000).to_bytes(4, "big") + bytes(12) + (0x10000).to_bytes(4, "big") + bytes(12)
IDENTITY += (0x40000000).to_bytes(4, "big")
"""The display matrix of a track header that leaves the picture as it is (16.16 and 2.30 fixed point)."""


def select_all(index: int) -> bool:
    return True


def write_video(path: Path, pictures: list[np.ndarray], times: list[int] | None = None, aspect: Fraction | None = None):
    """H.264 at 25 frames a second; `times` in units of 1/25 s."""
    with av.open(str(path), "w") as container:
        stream = container.add_stream("libx264", rate=25, options={"crf": "4", "bf": "0"})
        stream.height, stream.width = pictures[0].shape[:2]
        stream.pix_fmt = "yuv420p"
        stream.codec_context.time_base = Fraction(1, 25)
        if aspect is not None:
            stream.codec_context.sample_aspect_ratio = aspect
        for k, picture in enumerate(pictures):
            frame = av.VideoFrame.from_ndarray(picture, format="rgb24")
            frame.pts = k if times is None else times[k]
            container.mux(stream.encode(frame))
        container.mux(stream.encode(None))


def ramp(level: int, height: int = 48, width: int = 64) -> np.ndarray:
    return np.full((height, width, 3), level, np.uint8)
