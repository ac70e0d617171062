"""Finding the person: MediaPipe's 33 pose landmarks and its person mask. The only file that touches MediaPipe.

Both models ship inside the package, nothing is downloaded. Every frame is looked at on its own (no tracking), so the
result does not depend on which process saw which frame before.
"""

import os
import sys
from collections.abc import Iterator
from contextlib import contextmanager, nullcontext
from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float, UInt8

LANDMARK_NAMES = (
    "nose", "left_eye_inner", "left_eye", "left_eye_outer", "right_eye_inner", "right_eye", "right_eye_outer",
    "left_ear", "right_ear", "mouth_left", "mouth_right", "left_shoulder", "right_shoulder", "left_elbow",
    "right_elbow", "left_wrist", "right_wrist", "left_pinky", "right_pinky", "left_index", "right_index",
    "left_thumb", "right_thumb", "left_hip", "right_hip", "left_knee", "right_knee", "left_ankle", "right_ankle",
    "left_heel", "right_heel", "left_foot_index", "right_foot_index",
)  # fmt: skip
TORSO = (11, 12, 23, 24)
KNEES, ANKLES = (25, 26), (27, 28)
SKELETON = (
    (11, 12), (11, 23), (12, 24), (23, 24), (11, 13), (13, 15), (12, 14), (14, 16), (15, 19), (16, 20),
    (23, 25), (25, 27), (24, 26), (26, 28), (27, 31), (28, 32), (27, 29), (28, 30), (0, 11), (0, 12),
)  # fmt: skip

# Two detections are two people when their masks share less than this part of the smaller one. On the four test captures
# with one person the crops' masks share at least 0.5, on the one with three people 0.00.
_SEPARATE_OVERLAP = 0.2
_SURE_TORSO_VISIBILITY = 0.9
_SAME_SIZE = 0.3


@dataclass(frozen=True)
class Detection:
    """One person in one image. Landmarks may lie outside of the image where the model guesses."""

    landmarks_px: Float[np.ndarray, "33 2"]
    visibility: Float[np.ndarray, "33"]
    landmarks_world_m: Float[np.ndarray, "33 3"]
    mask: UInt8[np.ndarray, "h w"]


class PersonDetector:
    """MediaPipe's pose model in its middle size; about 35 ms an image on one core, whatever the image's size."""

    def __init__(self) -> None:
        with _quiet_stderr():
            import mediapipe  # here: its import takes seconds and writes to stderr

            self._pose = mediapipe.solutions.pose.Pose(
                static_image_mode=True, model_complexity=1, enable_segmentation=True, min_detection_confidence=0.5
            )
            self._pose.process(np.zeros((64, 64, 3), dtype=np.uint8))
        self._has_spoken = False

    def detect(self, rgb: UInt8[np.ndarray, "h w 3"]) -> Detection | None:
        """The most prominent person, or None.

        Landmarks in pixels (centres at +0.5) with visibility in [0, 1]; world landmarks in metres about the hips'
        centre, in camera axes (x right, y down, z away). The mask is soft, 0..255, and smooth at the scale of about
        1/200 of the person's height, where the model's own grid ends.
        """
        with nullcontext() if self._has_spoken else _quiet_stderr():
            found = self._pose.process(rgb)
        if found.pose_landmarks is None or found.segmentation_mask is None:
            return None
        self._has_spoken = True
        height, width = rgb.shape[:2]
        points = np.array(
            [(p.x * width, p.y * height, p.visibility) for p in found.pose_landmarks.landmark], np.float32
        )
        world = np.array([(p.x, p.y, p.z) for p in found.pose_world_landmarks.landmark], np.float32)
        mask = np.rint(np.clip(found.segmentation_mask, 0.0, 1.0) * 255.0).astype(np.uint8)
        return Detection(points[:, :2].copy(), points[:, 2].copy(), world, mask)

    def count_people(self, rgb: UInt8[np.ndarray, "h w 3"]) -> int:
        """How many people of similar size are in the image.

        The model finds one person an image, so it is asked about the whole image and about overlapping square crops;
        sure detections whose masks do not overlap are different people.
        """
        people: list[Bool[np.ndarray, "h w"]] = []
        for left, top, right, bottom in _crops(*rgb.shape[:2]):
            found = self.detect(np.ascontiguousarray(rgb[top:bottom, left:right]))
            if found is None or found.visibility[list(TORSO)].min() < _SURE_TORSO_VISIBILITY:
                continue
            mask = np.zeros(rgb.shape[:2], dtype=bool)
            mask[top:bottom, left:right] = found.mask > 127
            if all(_overlap(mask, other) < _SEPARATE_OVERLAP for other in people):
                people.append(mask)
        largest = max((mask.sum() for mask in people), default=0)
        return sum(bool(mask.sum() > _SAME_SIZE * largest) for mask in people)


def legs_in_image(
    landmarks_px: Float[np.ndarray, "n 33 2"], visibility: Float[np.ndarray, "n 33"], height_px: int
) -> Bool[np.ndarray, "n"]:
    """True where an ankle can be seen: inside the image, and at least possibly visible.

    A person cut off at the thigh has ankles guessed below the image with a visibility near 0; a leg hidden behind the
    other one in a side view still leaves the first.
    """
    inside = landmarks_px[:, ANKLES, 1] < height_px
    return (inside & (visibility[:, ANKLES] > 0.1)).any(axis=1)


def _crops(height: int, width: int) -> Iterator[tuple[int, int, int, int]]:
    """The whole image, then half-overlapping squares of the full and of 0.6 of the shorter side."""
    yield 0, 0, width, height
    for share in (1.0, 0.6):
        side = int(min(height, width) * share)
        if side == max(height, width):
            continue
        for top in _starts(height, side):
            for left in _starts(width, side):
                yield left, top, left + side, top + side


def _starts(length: int, side: int) -> list[int]:
    count = int(np.ceil((length - side) / (0.5 * side))) + 1
    return [int(start) for start in np.linspace(0, length - side, count)]


def _overlap(first: Bool[np.ndarray, "h w"], second: Bool[np.ndarray, "h w"]) -> float:
    """Shared area over the smaller area."""
    return float((first & second).sum() / max(1, min(first.sum(), second.sum())))


@contextmanager
def _quiet_stderr() -> Iterator[None]:
    """Keep the C++ libraries' notes, at loading and at the first person, off the terminal.

    They write to the descriptor itself.
    """
    os.environ.setdefault("GLOG_minloglevel", "2")
    os.environ.setdefault("TF_CPP_MIN_LOG_LEVEL", "2")
    sys.stderr.flush()
    kept = os.dup(2)
    null = os.open(os.devnull, os.O_WRONLY)
    try:
        os.dup2(null, 2)
        yield
    finally:
        os.dup2(kept, 2)
        os.close(kept)
        os.close(null)
