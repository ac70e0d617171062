"""Person detection with MediaPipe: 33 pose landmarks and a segmentation mask. Only the detectors of people, hands and
faces use it.

Both models are part of the package; nothing is downloaded. They keep no state between frames: `track` alone starts at
the landmarks of the image before, within the images that it is given, so that the result does not depend on which
thread handled which images.

The first model predicts a square region of interest (ROI) around the person, the second one predicts landmarks and
mask in it. An ROI that is too small cuts off the feet and shifts all landmarks, so it is replaced by the ROI of the
landmarks. The last two predictions are averaged, because the second model is sensitive to the ROI.
"""

import os
import sys
import threading
from collections.abc import Iterator, Sequence
from contextlib import contextmanager, nullcontext
from copy import deepcopy
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Bool, Float, UInt8

from pipeline.capture.landmarks import ANKLES, TORSO

# Two detections are different people if their masks overlap by less than this fraction of the smaller one. Crops of
# one person overlapped by at least 0.5 in four captures, those of three people by 0.00.
_MAX_OVERLAP_BETWEEN_PEOPLE = 0.2
_MIN_TORSO_VISIBILITY = 0.9
_MIN_RELATIVE_AREA = 0.3

# MediaPipe's own graphs smooth the ROI over the frames they have processed; these two are stateless.
_ROI_DETECTION_GRAPH = """
input_stream: "image"
output_stream: "square"
node { calculator: "PoseDetectionCpu" input_stream: "IMAGE:image" output_stream: "DETECTIONS:detections" }
node {
  calculator: "SplitDetectionVectorCalculator"
  input_stream: "detections"
  output_stream: "detection"
  node_options: {
    [type.googleapis.com/mediapipe.SplitVectorCalculatorOptions] { ranges: { begin: 0 end: 1 } element_only: true }
  }
}
node { calculator: "ImagePropertiesCalculator" input_stream: "IMAGE_CPU:image" output_stream: "SIZE:image_size" }
node {
  calculator: "PoseDetectionToRoi"
  input_stream: "DETECTION:detection"
  input_stream: "IMAGE_SIZE:image_size"
  output_stream: "ROI:square"
}
"""
_LANDMARKS_GRAPH = """
input_stream: "image"
input_stream: "square"
input_side_packet: "model_complexity"
input_side_packet: "enable_segmentation"
output_stream: "landmarks"
output_stream: "world_landmarks"
output_stream: "mask"
output_stream: "next_square"
node {
  calculator: "PoseLandmarkByRoiCpu"
  input_side_packet: "MODEL_COMPLEXITY:model_complexity"
  input_side_packet: "ENABLE_SEGMENTATION:enable_segmentation"
  input_stream: "IMAGE:image"
  input_stream: "ROI:square"
  output_stream: "LANDMARKS:landmarks"
  output_stream: "AUXILIARY_LANDMARKS:auxiliary_landmarks"
  output_stream: "WORLD_LANDMARKS:world_landmarks"
  output_stream: "SEGMENTATION_MASK:mask_image"
}
node { calculator: "ImagePropertiesCalculator" input_stream: "IMAGE_CPU:image" output_stream: "SIZE:image_size" }
node {
  calculator: "PoseLandmarksToRoi"
  input_stream: "LANDMARKS:auxiliary_landmarks"
  input_stream: "IMAGE_SIZE:image_size"
  output_stream: "ROI:next_square"
}
node {
  calculator: "FromImageCalculator"
  input_stream: "IMAGE:mask_image"
  output_stream: "IMAGE_CPU:mask"
}
"""
_LANDMARK_MODEL_OPTIONS = {"model_complexity": 1, "enable_segmentation": True}
# The ROI of the first model often ends at the thighs, where the second one may see a whole person; from there on it
# grows by 10 to 20 % per iteration.
_FIRST_ROI_GROWTH, _MAX_ROI_ITERATIONS = 1.25, 3
# An ROI is too small if the ROI of the landmarks is larger by this ratio, even if the mask does not touch its border
# (a mask without feet).
_MAX_ROI_GROWTH = 1.1
_BORDER_SAMPLES_PER_SIDE = 256


@dataclass(frozen=True)
class PersonDetection:
    """One person in one image. Landmarks may be outside of the image where the model extrapolates."""

    landmarks_px: Float[np.ndarray, "33 2"]
    visibility: Float[np.ndarray, "33"]
    landmarks_world_m: Float[np.ndarray, "33 3"]
    mask: UInt8[np.ndarray, "h w"]


class _RoiEstimate(NamedTuple):
    """Prediction of the second model in an ROI. `landmarks`: pixels and visibility. Squares: MediaPipe's
    NormalizedRect.
    """

    landmarks: Float[np.ndarray, "33 3"]
    landmarks_world_m: Float[np.ndarray, "33 3"]
    mask: Float[np.ndarray, "h w"]
    square: Any
    next_square: Any


class PersonDetector:
    """MediaPipe's pose model, complexity 1; about 65 ms per image on one core for any image size."""

    def __init__(self) -> None:
        with suppress_stderr():
            from mediapipe.python.solutions.pose import SolutionBase  # here: takes seconds and writes to stderr

            self._roi_graph = SolutionBase(graph_config=_ROI_DETECTION_GRAPH)
            self._landmark_graph = SolutionBase(graph_config=_LANDMARKS_GRAPH, side_inputs=_LANDMARK_MODEL_OPTIONS)
            self._roi_graph.process(np.zeros((64, 64, 3), dtype=np.uint8))
        self._is_stderr_quiet = False

    def close(self) -> None:
        """Free the memory of the model; nothing can be detected afterwards."""
        self._roi_graph.close()
        self._landmark_graph.close()

    def detect(self, rgb: UInt8[np.ndarray, "h w 3"]) -> PersonDetection | None:
        """Return the most prominent person, or None.

        Landmarks are in pixels (centres at +0.5) with visibility in [0, 1]; world landmarks in metres relative to the
        centre of the hips, in camera axes (x right, y down, z forward). The mask is soft, 0..255, and smooth at the
        scale of about 1/200 of the person's height, the resolution of the model.
        """
        return self.track([rgb])[0]

    def track(self, images: Sequence[UInt8[np.ndarray, "h w 3"]]) -> list[PersonDetection | None]:
        """Return the detections in successive images of a recording, see `detect`.

        The first ROI of an image is that of the landmarks of the image before it, where the person was found there.
        """
        detections: list[PersonDetection | None] = []
        square = None
        for rgb in images:
            with nullcontext() if self._is_stderr_quiet else suppress_stderr():
                estimates = self._estimate_in_successive_rois(rgb, square)
                if not estimates and square is not None:
                    estimates = self._estimate_in_successive_rois(rgb)
            self._is_stderr_quiet |= bool(estimates)
            detections.append(self._mean_detection(estimates))
            square = estimates[-1].next_square if estimates else None
        return detections

    def _mean_detection(self, estimates: list[_RoiEstimate]) -> PersonDetection | None:
        """Return the mean of estimates; None without any."""
        if not estimates:
            return None
        points = np.mean([estimate.landmarks for estimate in estimates], axis=0)
        world = np.mean([estimate.landmarks_world_m for estimate in estimates], axis=0)
        mask = np.mean([estimate.mask for estimate in estimates], axis=0)
        return PersonDetection(points[:, :2].copy(), points[:, 2].copy(), world, np.rint(255.0 * mask).astype(np.uint8))

    def _estimate_in_successive_rois(self, rgb: UInt8[np.ndarray, "h w 3"], square: Any = None) -> list[_RoiEstimate]:
        """Return the estimates in the first ROI that contains the person and in the ROI of its landmarks.

        square: the ROI to begin with; None: that of the first model, enlarged.
        """
        square = self._find_first_roi(rgb) if square is None else square
        previous, current = None, self._estimate_in_roi(rgb, square)
        for _ in range(_MAX_ROI_ITERATIONS):
            if current is None or (previous is not None and not is_roi_too_small(previous)):
                break
            previous, current = current, self._estimate_in_roi(rgb, current.next_square)
        return [estimate for estimate in (previous, current) if estimate is not None]

    def _find_first_roi(self, rgb: UInt8[np.ndarray, "h w 3"]) -> Any:
        """Return the ROI of the first model, enlarged; None without a person."""
        square = deepcopy(self._roi_graph.process(rgb).square)
        if square is not None:
            square.width *= _FIRST_ROI_GROWTH
            square.height *= _FIRST_ROI_GROWTH
        return square

    def _estimate_in_roi(self, rgb: UInt8[np.ndarray, "h w 3"], square: Any) -> _RoiEstimate | None:
        """Return the prediction of the second model in an ROI; None without an ROI or a person."""
        if square is None:
            return None
        found = self._landmark_graph.process({"image": rgb, "square": square})
        if found.landmarks is None or found.mask is None:
            return None
        size = np.array([rgb.shape[1], rgb.shape[0], 1.0], np.float32)
        points = np.array([(p.x, p.y, p.visibility) for p in found.landmarks.landmark], np.float32) * size
        world = np.array([(p.x, p.y, p.z) for p in found.world_landmarks.landmark], np.float32)
        return _RoiEstimate(points, world, np.clip(found.mask, 0.0, 1.0), square, found.next_square)

    def count_people(self, rgb: UInt8[np.ndarray, "h w 3"]) -> int:
        """Count the people of similar size in the image.

        The model finds one person per image, so it runs on the whole image and on overlapping square crops; confident
        detections whose masks do not overlap are different people. The first model, a quarter of the cost, tells which
        crops show nobody new.
        """
        people: list[Bool[np.ndarray, "h w"]] = []
        for left, top, right, bottom in _crops(*rgb.shape[:2]):
            crop = np.ascontiguousarray(rgb[top:bottom, left:right])
            if self._is_at_a_person(crop, left, top, people):
                continue
            found = self.detect(crop)
            if found is None or found.visibility[list(TORSO)].min() < _MIN_TORSO_VISIBILITY:
                continue
            mask = np.zeros(rgb.shape[:2], dtype=bool)
            mask[top:bottom, left:right] = found.mask > 127
            if all(_overlap_coefficient(mask, other) < _MAX_OVERLAP_BETWEEN_PEOPLE for other in people):
                people.append(mask)
        largest = max((mask.sum() for mask in people), default=0)
        return sum(bool(mask.sum() > _MIN_RELATIVE_AREA * largest) for mask in people)

    def _is_at_a_person(
        self, crop: UInt8[np.ndarray, "h w 3"], left: int, top: int, people: list[Bool[np.ndarray, "h2 w2"]]
    ) -> bool:
        """Return whether the first model finds nobody in a crop, or someone whose hips lie on a person of the list."""
        square = self._roi_graph.process(crop).square
        if square is None:
            return True
        height, width = crop.shape[:2]
        row = top + min(max(int(square.y_center * height), 0), height - 1)
        column = left + min(max(int(square.x_center * width), 0), width - 1)
        return any(bool(mask[row, column]) for mask in people)


def is_roi_too_small(estimate: _RoiEstimate) -> bool:
    """Return whether the ROI cuts the person: the mask touches its border, or the landmarks need a larger one."""
    return estimate.next_square.height > _MAX_ROI_GROWTH * estimate.square.height or touches_roi_border(
        estimate.mask > 0.5, estimate.square
    )


def touches_roi_border(person: Bool[np.ndarray, "h w"], square: Any) -> bool:
    """Return whether the person touches the border of a rotated square inside the image.

    square: centre, width and height relative to the image, rotation in radians (MediaPipe's NormalizedRect).
    """
    size = np.array(person.shape[::-1])
    border_offsets = (np.arange(_BORDER_SAMPLES_PER_SIDE) + 0.5) / _BORDER_SAMPLES_PER_SIDE - 0.5
    edge = np.full_like(border_offsets, border_offsets[-1])
    sides = [
        np.stack(side, axis=1)
        for side in ((border_offsets, edge), (border_offsets, -edge), (edge, border_offsets), (-edge, border_offsets))
    ]
    cosine, sine = np.cos(square.rotation), np.sin(square.rotation)
    rotated_px = (
        np.concatenate(sides) * (square.width, square.height) * size @ np.array([[cosine, sine], [-sine, cosine]])
    )
    pixel = np.floor(rotated_px + size * (square.x_center, square.y_center)).astype(int)
    column, row = pixel[((pixel >= 0) & (pixel < size)).all(axis=1)].T
    return bool(person[row, column].any())


def is_ankle_visible(
    landmarks_px: Float[np.ndarray, "n 33 2"], visibility: Float[np.ndarray, "n 33"], height_px: int
) -> Bool[np.ndarray, "n"]:
    """Return whether an ankle is inside the image and possibly visible.

    A person cut off at the thigh has ankles predicted below the image with a visibility near 0; a leg hidden behind the
    other one in a side view leaves the other ankle.
    """
    inside = landmarks_px[:, ANKLES, 1] < height_px
    return (inside & (visibility[:, ANKLES] > 0.1)).any(axis=1)


def _crops(height: int, width: int) -> Iterator[tuple[int, int, int, int]]:
    """Yield the whole image, then half-overlapping squares of 1.0 and 0.6 of the shorter side."""
    yield 0, 0, width, height
    for share in (1.0, 0.6):
        side = int(min(height, width) * share)
        if side == max(height, width):
            continue
        for top in _crop_offsets(height, side):
            for left in _crop_offsets(width, side):
                yield left, top, left + side, top + side


def _crop_offsets(length: int, side: int) -> list[int]:
    count = int(np.ceil((length - side) / (0.5 * side))) + 1
    return [int(start) for start in np.linspace(0, length - side, count)]


def _overlap_coefficient(first: Bool[np.ndarray, "h w"], second: Bool[np.ndarray, "h w"]) -> float:
    """Return the intersection area over the smaller area."""
    return float((first & second).sum() / max(1, min(first.sum(), second.sum())))


_quiet_lock = threading.Lock()
_saved_fds: list[int] = []
"""Standard error as it was, once for each thread that suppresses it now."""


@contextmanager
def suppress_stderr() -> Iterator[None]:
    """Suppress the messages of the C++ libraries, which write to the file descriptor itself.

    Threads may do so at the same time: the last one restores the descriptor.
    """
    os.environ.setdefault("GLOG_minloglevel", "2")
    os.environ.setdefault("TF_CPP_MIN_LOG_LEVEL", "2")
    with _quiet_lock:
        if not _saved_fds:
            sys.stderr.flush()
            saved_fd, devnull_fd = os.dup(2), os.open(os.devnull, os.O_WRONLY)
            os.dup2(devnull_fd, 2)
            os.close(devnull_fd)
        else:
            saved_fd = _saved_fds[-1]
        _saved_fds.append(saved_fd)
    try:
        yield
    finally:
        with _quiet_lock:
            _saved_fds.pop()
            if not _saved_fds:
                os.dup2(saved_fd, 2)
                os.close(saved_fd)
