"""The first pass over a recording: detect the person in the frames."""

from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass, replace
from functools import cached_property, partial
from itertools import islice
from typing import NamedTuple

import cv2
import numpy as np
from jaxtyping import Bool, Float, Int, UInt8

from pipeline.capture.face_detector import FaceDetector, undetected_face
from pipeline.capture.hand_detector import HandDetector, HandLandmarks, stack_hands, undetected_hands
from pipeline.capture.landmarks import N_LANDMARKS
from pipeline.capture.person_detector import PersonDetection, PersonDetector
from pipeline.capture.user_files import UserFiles
from pipeline.capture.video import Frame, FrameSource, downscale, read_frames
from pipeline.capture.worker_pool import WorkerPool
from pipeline.core.errors import UserError
from pipeline.core.progress import track

# Longer side of the images in which the person is detected: the model sees 256 cells on 1.25 times the person's height.
DETECTION_SIDE_PX = 640
# Successive frames in which the person is tracked; groups do not depend on the number of workers.
_FRAMES_PER_GROUP = 4
# Longer side of the grey thumbnails with which frames are compared.
THUMBNAIL_SIDE_PX = 320
# Minimum mask level of a pixel of the person in a thumbnail.
_MIN_PERSON_LEVEL = 100
# Minimum mask area relative to the median; smaller masks are specks.
_MIN_RELATIVE_AREA = 0.1


class _FrameDetection(NamedTuple):
    """Detections in one frame; `mask_png` is empty if masks are user-supplied."""

    gray: UInt8[np.ndarray, "h w"]
    person: Bool[np.ndarray, "h w"]
    landmarks: Float[np.ndarray, "33 6"] | None
    mask_png: bytes
    n_people: int
    hands: HandLandmarks = undetected_hands()
    face_px: Float[np.ndarray, "478 3"] = undetected_face()


@dataclass(frozen=True)
class Detections:
    """Detections in n frames, in order.

    found: the mask shows the person (without landmarks if masks are user-supplied).
    gray_thumbnails, person_masks: small images and binary masks.
    masks_png: soft masks of the detector, PNG-encoded to save memory, of at most `DETECTION_SIDE_PX`.
    landmarks, hands and faces_px as in `Capture`, nan where unknown. n_people: -1 where people were not counted.
    to_stabilised: homographies from the frames to the stabilised pictures that all other values are of
        (`pipeline.capture.camera_motion`); they act on pixels of the kept size, centres at +0.5. None: not stabilised.
    """

    frame_index: Int[np.ndarray, "n"]
    time_s: Float[np.ndarray, "n"]
    found: Bool[np.ndarray, "n"]
    n_people: Int[np.ndarray, "n"]
    gray_thumbnails: UInt8[np.ndarray, "n h w"]
    person_masks: Bool[np.ndarray, "n h w"]
    landmarks_px: Float[np.ndarray, "n 33 2"]
    landmarks_visibility: Float[np.ndarray, "n 33"]
    landmarks_world_m: Float[np.ndarray, "n 33 3"]
    hands: HandLandmarks
    faces_px: Float[np.ndarray, "n 478 3"]
    masks_png: tuple[bytes, ...]
    width: int
    height: int
    scale: float
    to_stabilised: Float[np.ndarray, "n 3 3"] | None = None

    def rows(self, kept: Bool[np.ndarray, "n"]) -> "Detections":
        """Return the detections in some of the frames."""
        arrays = {name: value[kept] for name, value in vars(self).items() if isinstance(value, np.ndarray)}
        positions = np.flatnonzero(kept).tolist()
        masks_png = tuple(self.masks_png[p] for p in positions)
        return replace(self, **arrays, hands=self.hands.rows(positions), masks_png=masks_png)


def detect_in_frames(
    source: FrameSource,
    user_files: UserFiles,
    frame_indices: Sequence[int],
    n_people_count_frames: int,
    max_side_px: int,
    workers: WorkerPool,
) -> Detections:
    """Detect the person in the frames `frame_indices`, and count people in `n_people_count_frames` of them.

    Raises:
        UserError: the recording yields no frame.
    """
    people_count_indices = (
        {frame_indices[int(k)] for k in np.linspace(0, len(frame_indices) - 1, n_people_count_frames)}
        if frame_indices
        else set()
    )
    wanted = set(frame_indices)
    needs_landmarks = user_files.landmarks is None or user_files.landmarks.landmarks_world_m is None
    seen: list[tuple[int, float]] = []
    shape: list[tuple[int, int, float]] = []

    def tasks() -> Iterator[_FrameTask]:
        for frame in read_undistorted_frames(source, user_files, wanted.__contains__, max_side_px):
            seen.append((frame.index, frame.time_s))
            shape.append((frame.rgb.shape[0], frame.rgb.shape[1], frame.scale))
            mask = read_user_mask(user_files, frame)
            yield _FrameTask(frame.rgb, mask, needs_landmarks, frame.index in people_count_indices)

    detectors = [_Detectors() for _ in range(workers.count)]  # each worker takes one and puts it back
    groups = workers.map(partial(_detect_in_frames, detectors), _grouped(tasks()))
    frame_detections = list(
        track((found for group in groups for found in group), "detecting the person", total=len(frame_indices))
    )
    for one in detectors:
        one.close()
    if not frame_detections:
        raise UserError(f"{source.path} has no readable frame; use another video")
    height, width, scale = shape[0]
    landmarks = _landmarks(frame_detections, np.array([index for index, _ in seen]), user_files, scale)
    person_masks = np.stack([detection.person for detection in frame_detections])
    return Detections(
        frame_index=np.array([index for index, _ in seen], dtype=np.int32),
        time_s=np.array([time_s for _, time_s in seen]),
        found=_is_person_visible(person_masks),
        n_people=np.array([detection.n_people for detection in frame_detections], dtype=np.int32),
        gray_thumbnails=np.stack([detection.gray for detection in frame_detections]),
        person_masks=person_masks,
        landmarks_px=landmarks[..., :2],
        landmarks_visibility=np.where(np.isfinite(landmarks[..., :2]).all(-1), landmarks[..., 2], np.nan),
        landmarks_world_m=landmarks[..., 3:],
        hands=stack_hands([detection.hands for detection in frame_detections]),
        faces_px=np.stack([detection.face_px for detection in frame_detections]),
        masks_png=tuple(detection.mask_png for detection in frame_detections),
        width=width,
        height=height,
        scale=scale,
    )


def read_undistorted_frames(
    source: FrameSource, user_files: UserFiles, is_wanted: Callable[[int], bool], max_side_px: int
) -> Iterator[Frame]:
    """Yield the frames of the recording without the lens distortion of the user-supplied camera."""
    for frame in read_frames(source, is_wanted, max_side_px):
        if user_files.camera is None:
            yield frame
        else:
            yield Frame(frame.index, frame.time_s, user_files.camera.undistort(frame.rgb, frame.scale), frame.scale)


def read_user_mask(user_files: UserFiles, frame: Frame) -> UInt8[np.ndarray, "h w"] | None:
    """Return the user-supplied mask of a frame at the frame's size, undistorted; None if there are none.

    Raises:
        UserError: the mask has another aspect ratio than the frame.
    """
    if user_files.read_mask is None:
        return None
    mask = user_files.read_mask(frame.index)
    height, width = frame.rgb.shape[:2]
    if abs(mask.shape[0] / mask.shape[1] - height / width) > 0.01 * height / width:
        raise UserError(
            f"the mask of frame {frame.index} in {user_files.mask_source} is {mask.shape[1]}x{mask.shape[0]}, "
            f"the frame is {width}x{height}; supply masks with the aspect ratio of the frames"
        )
    mask = cv2.resize(mask, (width, height), interpolation=cv2.INTER_AREA)
    return mask if user_files.camera is None else user_files.camera.undistort(mask[..., None], frame.scale)[..., 0]


def encode_mask(mask: UInt8[np.ndarray, "h w"]) -> bytes:
    """Return a mask as an entry of `Detections.masks_png`."""
    return cv2.imencode(".png", mask, (cv2.IMWRITE_PNG_COMPRESSION, 1))[1].tobytes()


def decode_mask(mask_png: bytes) -> UInt8[np.ndarray, "h w"]:
    """Return the mask of an entry of `Detections.masks_png` that is not empty."""
    return cv2.imdecode(np.frombuffer(mask_png, np.uint8), cv2.IMREAD_GRAYSCALE)


class _Detectors:
    """Detectors for one thread at a time, each loaded when it is first used; that of the person takes a second."""

    @cached_property
    def person(self) -> PersonDetector:
        return PersonDetector()

    @cached_property
    def hand(self) -> HandDetector:
        return HandDetector()

    @cached_property
    def face(self) -> FaceDetector:
        return FaceDetector()

    def close(self) -> None:
        """Free the memory of the loaded detectors, which cannot be used any more."""
        for detector in vars(self).values():
            detector.close()


class _FrameTask(NamedTuple):
    """A frame in which the person is detected; `mask`: user-supplied."""

    rgb: UInt8[np.ndarray, "h w 3"]
    mask: UInt8[np.ndarray, "h w"] | None
    needs_landmarks: bool
    needs_people_count: bool


def _grouped(tasks: Iterable[_FrameTask]) -> Iterator[tuple[_FrameTask, ...]]:
    """Yield successive tasks in groups."""
    waiting = iter(tasks)
    while group := tuple(islice(waiting, _FRAMES_PER_GROUP)):
        yield group


def _detect_in_frames(unused: list[_Detectors], *tasks: _FrameTask) -> list[_FrameDetection]:
    """Detect the person in successive frames, tracked from the first of them (runs in a worker thread)."""
    detectors = unused.pop()
    try:
        return _detect_successively(detectors, tasks)
    finally:
        unused.append(detectors)


def _detect_successively(detectors: _Detectors, tasks: Sequence[_FrameTask]) -> list[_FrameDetection]:
    reduced = [downscale(task.rgb, DETECTION_SIDE_PX) for task in tasks]
    detections: list[PersonDetection | None] = [None] * len(tasks)
    used = [k for k, task in enumerate(tasks) if task.needs_landmarks or task.mask is None]
    if used:
        for k, found in zip(used, detectors.person.track([reduced[k][0] for k in used]), strict=True):
            if found is not None:
                detections[k] = replace(found, landmarks_px=found.landmarks_px / np.float32(reduced[k][1]))
    return [
        _complete_detection(detectors, task, small, detection)
        for task, (small, _), detection in zip(tasks, reduced, detections, strict=True)
    ]


def _complete_detection(
    detectors: _Detectors,
    task: _FrameTask,
    small: UInt8[np.ndarray, "h2 w2 3"],
    detection: PersonDetection | None,
) -> _FrameDetection:
    """Add hands, face and small pictures to the detection in one frame; people are counted in the reduced image."""
    rgb, mask, needs_landmarks, needs_people_count = task
    n_people = detectors.person.count_people(small) if needs_people_count and mask is None else -1
    factor = min(1.0, THUMBNAIL_SIDE_PX / max(rgb.shape[:2]))
    size = (max(1, round(rgb.shape[1] * factor)), max(1, round(rgb.shape[0] * factor)))
    gray = cv2.resize(cv2.cvtColor(rgb, cv2.COLOR_RGB2GRAY), size, interpolation=cv2.INTER_AREA)
    landmarks, mask_png, hands, face_px = None, b"", undetected_hands(), undetected_face()
    if detection is not None:
        landmarks = np.concatenate(
            [detection.landmarks_px, detection.visibility[:, None], detection.landmarks_world_m], axis=1
        )
    if detection is not None and needs_landmarks:
        hands = detectors.hand.detect_hands(
            rgb, detection.landmarks_px, detection.visibility, detection.landmarks_world_m
        )
        face_px = detectors.face.detect_face_of_person(rgb, detection.landmarks_px, detection.landmarks_world_m)
    if mask is None and detection is not None:
        mask = detection.mask
        mask_png = encode_mask(mask)
    if mask is None:
        return _FrameDetection(gray, np.zeros(gray.shape, dtype=bool), None, b"", n_people)
    person = cv2.resize(mask, size, interpolation=cv2.INTER_AREA) > _MIN_PERSON_LEVEL
    return _FrameDetection(gray, person, landmarks, mask_png, n_people, hands, face_px)


def _landmarks(
    frame_detections: Sequence[_FrameDetection], frame_index: Int[np.ndarray, "n"], user_files: UserFiles, scale: float
) -> Float[np.ndarray, "n 33 6"]:
    """Return pixel position, visibility and world position of all landmarks (user-supplied or detected); else nan."""
    missing = np.full((N_LANDMARKS, 6), np.nan, dtype=np.float32)
    landmarks = np.stack(
        [missing if detection.landmarks is None else detection.landmarks for detection in frame_detections]
    )
    user_landmarks = user_files.landmarks
    if user_landmarks is None:
        return landmarks
    points_px = user_landmarks.landmarks_px[frame_index]
    if user_files.camera is not None:
        points_px = user_files.camera.undistort_points(points_px)
    landmarks[..., :2], landmarks[..., 2] = points_px * scale, user_landmarks.visibility[frame_index]
    if user_landmarks.landmarks_world_m is not None:
        landmarks[..., 3:] = user_landmarks.landmarks_world_m[frame_index]
    return landmarks


def _is_person_visible(person_masks: Bool[np.ndarray, "n h w"]) -> Bool[np.ndarray, "n"]:
    """Return which masks are larger than specks, relative to the median area of the masks that are not empty."""
    area_px = person_masks.sum(axis=(1, 2))
    median_area_px = np.median(area_px[area_px > 0]) if area_px.any() else 0.0
    return (area_px > 0) & (area_px >= _MIN_RELATIVE_AREA * median_area_px)
