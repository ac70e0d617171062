"""The two walks through a recording: look for the person in every frame, then write the chosen frames with masks."""

from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from typing import NamedTuple

import cv2
import numpy as np
from jaxtyping import Bool, Float, Int, UInt8

from pipeline.capture.background_plate import Plate, find_plate
from pipeline.capture.capture import IMAGES_FOLDER, MASKS_FOLDER, image_path, mask_path
from pipeline.capture.hand_detector import HandDetector, Hands, no_hands, stack_hands
from pipeline.capture.matting import (
    beyond_doubt_outside,
    sharpen_mask,
    steady_mask,
    with_painted_backdrop,
    without_backdrop,
)
from pipeline.capture.person_detector import PersonDetector
from pipeline.capture.process_pool import Workers
from pipeline.capture.user_files import N_LANDMARKS, Supplied
from pipeline.capture.video import Frame, Source, read_frames
from pipeline.core.errors import UserError
from pipeline.core.progress import track
from pipeline.io.image import to_uint8, write_gray, write_rgb

# Longer side of the small grey pictures on which frames are compared.
_SMALL_SIDE_PX = 320
# Mask level of 255 from which a pixel counts as the person there.
_PERSON_LEVEL = 100
# A mask shows the person when it has this share of the usual area: specks of a supplied mask are nobody.
_LEAST_AREA = 0.1
# Most pictures that the empty scene is put together from; they are in memory at the same time.
_PLATE_PICTURES = 32


class _Look(NamedTuple):
    """What one frame shows; `mask_png` is empty where masks are supplied."""

    gray: UInt8[np.ndarray, "h w"]
    person: Bool[np.ndarray, "h w"]
    landmarks: Float[np.ndarray, "33 6"] | None
    mask_png: bytes
    n_people: int
    hands: Hands = no_hands()


@dataclass(frozen=True)
class Sightings:
    """All frames that were looked at, n of them, in order.

    found: the mask shows the person, who may have no landmarks when masks are supplied.
    grays, persons: small pictures and person masks; masks_png: the detector's soft masks, PNG-encoded to save memory.
    landmarks and hands as in `Capture`, nan where unknown. n_people: -1 where people were not counted.
    """

    frame_index: Int[np.ndarray, "n"]
    time_s: Float[np.ndarray, "n"]
    found: Bool[np.ndarray, "n"]
    n_people: Int[np.ndarray, "n"]
    grays: UInt8[np.ndarray, "n h w"]
    persons: Bool[np.ndarray, "n h w"]
    landmarks_px: Float[np.ndarray, "n 33 2"]
    landmarks_visibility: Float[np.ndarray, "n 33"]
    landmarks_world_m: Float[np.ndarray, "n 33 3"]
    hands: Hands
    masks_png: tuple[bytes, ...]
    width: int
    height: int
    scale: float


def look_at_all(
    source: Source, supplied: Supplied, looked_at: Sequence[int], n_counted: int, max_side_px: int, workers: Workers
) -> Sightings:
    """Find the person in the frames `looked_at`; in `n_counted` of them, evenly spread, count the people.

    Raises UserError when the recording yields no frame.
    """
    counted = {looked_at[int(k)] for k in np.linspace(0, len(looked_at) - 1, n_counted)} if looked_at else set()
    wanted = set(looked_at)
    needs_landmarks = supplied.landmarks is None or supplied.landmarks.landmarks_world_m is None
    seen: list[tuple[int, float]] = []
    shape: list[tuple[int, int, float]] = []

    def tasks() -> Iterator[tuple[object, ...]]:
        for frame in read_undistorted(source, supplied, wanted.__contains__, max_side_px):
            seen.append((frame.index, frame.time_s))
            shape.append((frame.rgb.shape[0], frame.rgb.shape[1], frame.scale))
            mask = supplied_mask(supplied, frame)
            yield frame.rgb, mask, needs_landmarks, frame.index in counted

    looks = list(track(workers.map(_look, tasks()), "looking for the person", total=len(looked_at)))
    if not looks:
        raise UserError(f"{source.path} has no frame that can be read; give another video")
    height, width, scale = shape[0]
    landmarks = _landmarks(looks, np.array([index for index, _ in seen]), supplied, scale)
    persons = np.stack([look.person for look in looks])
    return Sightings(
        frame_index=np.array([index for index, _ in seen], dtype=np.int32),
        time_s=np.array([time_s for _, time_s in seen]),
        found=_shows_person(persons),
        n_people=np.array([look.n_people for look in looks], dtype=np.int32),
        grays=np.stack([look.gray for look in looks]),
        persons=persons,
        landmarks_px=landmarks[..., :2],
        landmarks_visibility=np.nan_to_num(landmarks[..., 2]),
        landmarks_world_m=landmarks[..., 3:],
        hands=stack_hands([look.hands for look in looks]),
        masks_png=tuple(look.mask_png for look in looks),
        width=width,
        height=height,
        scale=scale,
    )


def write_frames(
    source: Source,
    supplied: Supplied,
    sightings: Sightings,
    positions: Sequence[int],
    out: Path,
    max_side_px: int,
    noise: float,
    workers: Workers,
) -> None:
    """Write the picture and the mask of the sightings at `positions` into `out`.

    A supplied mask is written as it is; the detector's is steadied with its neighbours in time and sharpened. Where the
    mask is soft the picture holds the person's colour alone.
    """
    plate = None if supplied.read_mask is not None else scene_without_person(source, supplied, sightings, max_side_px)
    for folder in (IMAGES_FOLDER, MASKS_FOLDER):
        (out / folder).mkdir(exist_ok=True)
    wanted = set(positions)
    needed = {int(sightings.frame_index[p]) for k in wanted for p in _neighbours(k, sightings)}
    frames = read_undistorted(source, supplied, needed.__contains__, max_side_px)

    def tasks() -> Iterator[tuple[object, ...]]:
        for position, near in _windows(frames, sightings, wanted):
            images = np.stack([frame.rgb for frame in near])
            centre = [frame.index for frame in near].index(int(sightings.frame_index[position]))
            if supplied.read_mask is not None:
                yield images[centre], supplied_mask(supplied, near[centre]), out, near[centre].index
            else:
                masks = [sightings.masks_png[p] for p in _neighbours(position, sightings)]
                yield images, masks, out, near[centre].index, centre, noise, plate

    function = _write_supplied if supplied.read_mask is not None else _write_sharpened
    for _ in track(workers.map(function, tasks()), "sharpening masks", total=len(wanted)):
        pass


def scene_without_person(source: Source, supplied: Supplied, sightings: Sightings, max_side_px: int) -> Plate:
    """The empty scene, from pictures that are spread evenly over the recording; masks must come from the detector."""
    found = np.flatnonzero(sightings.found)
    taken = found[np.unique(np.linspace(0, len(found) - 1, _PLATE_PICTURES).astype(int))]
    is_taken = set(sightings.frame_index[taken].tolist()).__contains__
    images = np.stack([frame.rgb for frame in read_undistorted(source, supplied, is_taken, max_side_px)])
    return find_plate(images, np.stack([~beyond_doubt_outside(_decoded(sightings.masks_png[p])) for p in taken]))


def read_undistorted(
    source: Source, supplied: Supplied, is_wanted: Callable[[int], bool], max_side_px: int
) -> Iterator[Frame]:
    """The recording's frames with the supplied camera's lens distortion taken out."""
    for frame in read_frames(source, is_wanted, max_side_px):
        if supplied.camera is None:
            yield frame
        else:
            yield Frame(frame.index, frame.time_s, supplied.camera.undistort(frame.rgb, frame.scale), frame.scale)


def supplied_mask(supplied: Supplied, frame: Frame) -> UInt8[np.ndarray, "h w"] | None:
    """The user's mask for a frame at the frame's size, lens distortion taken out; None when none was given."""
    if supplied.read_mask is None:
        return None
    mask = supplied.read_mask(frame.index)
    height, width = frame.rgb.shape[:2]
    if abs(mask.shape[0] / mask.shape[1] - height / width) > 0.01 * height / width:
        raise UserError(
            f"the mask of frame {frame.index} in {supplied.mask_source} is {mask.shape[1]}x{mask.shape[0]}, "
            f"the frame is {width}x{height}; give masks of the frames' shape"
        )
    mask = cv2.resize(mask, (width, height), interpolation=cv2.INTER_AREA)
    return mask if supplied.camera is None else supplied.camera.undistort(mask[..., None], frame.scale)[..., 0]


@cache
def _detector() -> PersonDetector:
    """One detector a process; loading it takes seconds."""
    return PersonDetector()


@cache
def _hand_detector() -> HandDetector:
    return HandDetector()


def _look(
    rgb: UInt8[np.ndarray, "h w 3"], mask: UInt8[np.ndarray, "h w"] | None, needs_landmarks: bool, is_counted: bool
) -> _Look:
    """Runs in a worker: find the person in one frame."""
    detection = _detector().detect(rgb) if needs_landmarks or mask is None else None
    n_people = _detector().count_people(rgb) if is_counted and mask is None else -1
    factor = min(1.0, _SMALL_SIDE_PX / max(rgb.shape[:2]))
    size = (max(1, round(rgb.shape[1] * factor)), max(1, round(rgb.shape[0] * factor)))
    gray = cv2.resize(cv2.cvtColor(rgb, cv2.COLOR_RGB2GRAY), size, interpolation=cv2.INTER_AREA)
    landmarks, mask_png, hands = None, b"", no_hands()
    if detection is not None:
        landmarks = np.concatenate(
            [detection.landmarks_px, detection.visibility[:, None], detection.landmarks_world_m], axis=1
        )
    if detection is not None and needs_landmarks:
        hands = _hand_detector().look(rgb, detection.landmarks_px, detection.visibility, detection.landmarks_world_m)
    if mask is None and detection is not None:
        mask = detection.mask
        mask_png = cv2.imencode(".png", mask, (cv2.IMWRITE_PNG_COMPRESSION, 1))[1].tobytes()
    if mask is None:
        return _Look(gray, np.zeros(gray.shape, dtype=bool), None, b"", n_people)
    person = cv2.resize(mask, size, interpolation=cv2.INTER_AREA) > _PERSON_LEVEL
    return _Look(gray, person, landmarks, mask_png, n_people, hands)


def _landmarks(
    looks: Sequence[_Look], frame_index: Int[np.ndarray, "n"], supplied: Supplied, scale: float
) -> Float[np.ndarray, "n 33 6"]:
    """Pixel position, visibility and world position of all landmarks, as supplied or else detected; nan: unknown."""
    missing = np.full((N_LANDMARKS, 6), np.nan, dtype=np.float32)
    landmarks = np.stack([missing if look.landmarks is None else look.landmarks for look in looks])
    given = supplied.landmarks
    if given is None:
        return landmarks
    points_px = given.landmarks_px[frame_index]
    if supplied.camera is not None:
        points_px = supplied.camera.undistort_points(points_px)
    landmarks[..., :2], landmarks[..., 2] = points_px * scale, given.visibility[frame_index]
    if given.landmarks_world_m is not None:
        landmarks[..., 3:] = given.landmarks_world_m[frame_index]
    return landmarks


def _shows_person(persons: Bool[np.ndarray, "n h w"]) -> Bool[np.ndarray, "n"]:
    """Whose mask has more than specks, beside the median area of those that have anything."""
    area_px = persons.sum(axis=(1, 2))
    usual_px = np.median(area_px[area_px > 0]) if area_px.any() else 0.0
    return (area_px > 0) & (area_px >= _LEAST_AREA * usual_px)


def _neighbours(position: int, sightings: Sightings) -> list[int]:
    """The position and those beside it, where a person was found."""
    beside = range(max(0, position - 1), min(len(sightings.found), position + 2))
    return [p for p in beside if p == position or sightings.found[p]]


def _windows(frames: Iterable[Frame], sightings: Sightings, wanted: set[int]) -> Iterator[tuple[int, list[Frame]]]:
    """For each wanted position, in order: its frame and those of its neighbours, as soon as they have been read."""
    held: dict[int, Frame] = {}
    waiting = sorted(wanted)
    for frame in frames:
        held[frame.index] = frame
        while waiting:
            near = [int(sightings.frame_index[p]) for p in _neighbours(waiting[0], sightings)]
            if frame.index < near[-1]:
                break
            yield waiting.pop(0), [held[index] for index in near]
            held = {index: kept for index, kept in held.items() if index >= near[0]}


def _write_supplied(
    rgb: UInt8[np.ndarray, "h w 3"], mask: UInt8[np.ndarray, "h w"], out: Path, frame_index: int
) -> None:
    write_rgb(image_path(out, frame_index), without_backdrop(rgb, mask))
    write_gray(mask_path(out, frame_index), mask)


def _write_sharpened(
    images: UInt8[np.ndarray, "t h w 3"],
    masks_png: Sequence[bytes],
    out: Path,
    frame_index: int,
    centre: int,
    noise: float,
    plate: Plate,
) -> None:
    """Runs in a worker: the finished mask of one frame."""
    masks = np.stack([_decoded(data) for data in masks_png])
    mask = with_painted_backdrop(images[centre], steady_mask(images, masks, centre, noise))
    alpha = sharpen_mask(images[centre], mask, plate)
    _write_supplied(images[centre], to_uint8(alpha), out, frame_index)


def _decoded(mask_png: bytes) -> UInt8[np.ndarray, "h w"]:
    return cv2.imdecode(np.frombuffer(mask_png, np.uint8), cv2.IMREAD_GRAYSCALE)
