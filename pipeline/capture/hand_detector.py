"""Hand landmarks: MediaPipe's 21 points of each hand, in a region of interest from the pose's wrist and knuckles.

Zhang et al., "MediaPipe Hands: On-device real-time hand tracking", 2020; order of the points as in figure 2. The models
are part of the package. Hands that are hidden in the pose, or too small, are skipped.
"""

from collections.abc import Sequence
from contextlib import nullcontext
from dataclasses import dataclass
from typing import Any

import numpy as np
from jaxtyping import Float, UInt8

from pipeline.capture.landmarks import INDEX_FINGERS, PINKIES, WRISTS
from pipeline.capture.person_detector import suppress_stderr

N_HAND_LANDMARKS = 21
MIN_HAND_PX = 24.0
HAND_LENGTH_M = 0.18
"""Hands are detected if a hand of this length, seen from the side, has at least `MIN_HAND_PX` pixels."""

MIN_WRIST_VISIBILITY = 0.3
"""Below this visibility of the wrist the hand is behind the body, and the model would find the other hand."""

_GRAPH = """
input_stream: "image"
input_stream: "wrist_and_knuckles"
input_side_packet: "model_complexity"
output_stream: "landmarks"
output_stream: "world_landmarks"
output_stream: "handedness"
node { calculator: "ImagePropertiesCalculator" input_stream: "IMAGE_CPU:image" output_stream: "SIZE:image_size" }
node {
  calculator: "HandLandmarksFromPoseToRecropRoi"
  input_stream: "HAND_LANDMARKS_FROM_POSE:wrist_and_knuckles"
  input_stream: "IMAGE_SIZE:image_size"
  output_stream: "ROI:guessed_square"
}
node {
  calculator: "HandRecropByRoiCpu"
  input_stream: "IMAGE:image"
  input_stream: "ROI:guessed_square"
  output_stream: "HAND_ROI_FROM_RECROP:square"
}
node {
  calculator: "HandLandmarkCpu"
  input_side_packet: "MODEL_COMPLEXITY:model_complexity"
  input_stream: "IMAGE:image"
  input_stream: "ROI:square"
  output_stream: "LANDMARKS:landmarks"
  output_stream: "WORLD_LANDMARKS:world_landmarks"
  output_stream: "HANDEDNESS:handedness"
}
"""
# The model assumes mirrored images, as from a front camera.
_MIRRORED_LABELS = ("Right", "Left")


@dataclass(frozen=True)
class HandLandmarks:
    """Landmarks of both hands (left, right) in any number of images; nan where no hand was found.

    landmarks_px: pixel centres at +0.5.
    landmarks_m: relative to the centre of the hand, camera axes (x right, y down, z forward).
    handedness_score: probability in [0, 1] that the hand is of this side; 0 where no hand was found.
    """

    landmarks_px: Float[np.ndarray, "*n 2 21 2"]
    landmarks_m: Float[np.ndarray, "*n 2 21 3"]
    handedness_score: Float[np.ndarray, "*n 2"]

    def rows(self, rows: Sequence[int]) -> "HandLandmarks":
        """Return the hands of some of the images."""
        return HandLandmarks(*(values[rows] for values in vars(self).values()))


def undetected_hands(*images: int) -> HandLandmarks:
    """Return a result without hands for so many images (without arguments: for one image)."""
    points = (*images, 2, N_HAND_LANDMARKS)
    nowhere_px, nowhere_m = (np.full((*points, size), np.nan, dtype=np.float32) for size in (2, 3))
    return HandLandmarks(nowhere_px, nowhere_m, np.zeros((*images, 2), dtype=np.float32))


def stack_hands(images: Sequence[HandLandmarks]) -> HandLandmarks:
    """Stack the hands of single images; at least one image."""
    return HandLandmarks(
        *(np.stack(values) for values in zip(*(vars(hands).values() for hands in images), strict=True))
    )


class HandDetector:
    """MediaPipe's hand model, complexity 1; about 12 ms per hand on one core for any image size."""

    def __init__(self) -> None:
        with suppress_stderr():
            from mediapipe.framework.formats.landmark_pb2 import NormalizedLandmarkList
            from mediapipe.python.solutions.pose import SolutionBase  # here: takes seconds and writes to stderr

            self._points = NormalizedLandmarkList
            self._graph = SolutionBase(graph_config=_GRAPH, side_inputs={"model_complexity": 1})
        self._is_stderr_quiet = False

    def close(self) -> None:
        """Free the memory of the model; nothing can be detected afterwards."""
        self._graph.close()

    def detect_hands(
        self,
        rgb: UInt8[np.ndarray, "h w 3"],
        pose_px: Float[np.ndarray, "33 2"],
        visibility: Float[np.ndarray, "33"],
        pose_world_m: Float[np.ndarray, "33 3"],
    ) -> HandLandmarks:
        """Detect the hands of the person with this pose (`person_detector.PersonDetection`)."""
        hands = undetected_hands()
        if HAND_LENGTH_M * image_scale_px_per_m(pose_px, pose_world_m) < MIN_HAND_PX:
            return hands
        size_px = np.array(rgb.shape[1::-1])
        for side, expected_label in enumerate(_MIRRORED_LABELS):
            if visibility[WRISTS[side]] < MIN_WRIST_VISIBILITY:
                continue
            rows = [group[side] for group in (WRISTS, PINKIES, INDEX_FINGERS)]
            with nullcontext() if self._is_stderr_quiet else suppress_stderr():
                found = self._process(rgb, pose_px[rows] / size_px, visibility[rows])
            self._is_stderr_quiet = True
            if found.landmarks is None:
                continue
            hands.landmarks_px[side] = size_px * [(p.x, p.y) for p in found.landmarks.landmark]
            hands.landmarks_m[side] = [(p.x, p.y, p.z) for p in found.world_landmarks.landmark]
            handedness = found.handedness.classification[0]
            hands.handedness_score[side] = (
                handedness.score if handedness.label == expected_label else 1.0 - handedness.score
            )
        return hands

    def _process(self, rgb: UInt8[np.ndarray, "h w 3"], points_normalized: np.ndarray, visibility: np.ndarray) -> Any:
        points = self._points()
        for (x, y), seen in zip(points_normalized.tolist(), visibility.tolist(), strict=True):
            points.landmark.add(x=x, y=y, visibility=seen)
        return self._graph.process({"image": rgb, "wrist_and_knuckles": points})


def image_scale_px_per_m(
    points_px: Float[np.ndarray, "*n p 2"], points_m: Float[np.ndarray, "*n p 3"]
) -> Float[np.ndarray, "*n"]:
    """Return the image scale at a person or a hand: spread of its points in pixels over their spread in metres."""
    squared_px, squared_m = (
        np.square(points - points.mean(-2, keepdims=True)).sum((-2, -1)) for points in (points_px, points_m[..., :2])
    )
    return np.asarray(np.sqrt(squared_px / np.maximum(squared_m, 1e-12)))
