"""Render a synthetic capture: a subject that moves in a room in front of a fixed camera, with its ground truth.

OUT/video/video.mp4            input of the pipeline
OUT/truth/...                  ground truth, never read by the pipeline: see `write_ground_truth`
"""

import json
from collections.abc import Iterator
from dataclasses import asdict, dataclass, replace
from functools import cached_property
from pathlib import Path

import numpy as np
import torch
from jaxtyping import Float, UInt8
from torch import Tensor

from data_tools.folder import atomic_folder
from data_tools.synthetic.rig.subject import Subject, save_subject
from data_tools.synthetic.scene.backdrop import Room, contact_shadow
from data_tools.synthetic.scene.ball import Ball
from data_tools.synthetic.scene.hand_held import hand_held_angles_rad, turn_picture
from data_tools.synthetic.scene.lens import distort_picture
from data_tools.synthetic.scene.movie import write_video
from data_tools.synthetic.scene.renderer import Light, pose_vertices, render_subject
from data_tools.synthetic.scene.walk_around import Surroundings, turned_light, walking_shift_m
from pipeline.body.body import Body, Motion, canonical_to_world
from pipeline.body.files import save_body, save_camera, save_motion
from pipeline.core.progress import track
from pipeline.geometry.alpha import unpremultiply_to_uint8
from pipeline.geometry.camera import Camera
from pipeline.io.image import to_uint8, write_gray, write_rgb, write_rgba

CAPTURE_VERSION = 4
"""Increased whenever equal options give other images or the format of `truth/` changes; the Makefile reads it."""

_FEET = ("LeftFoot", "LeftToeBase", "RightFoot", "RightToeBase")


@dataclass(frozen=True)
class SyntheticCapture:
    """Everything that determines the pixels of a capture.

    Attributes:
        ground_m: point on the floor where the person stands (world).
        samples: antialiasing samples per pixel and axis.
        hand_held_deg: by how much the camera turns while it films. The ground truth, masks included, is that of a
            camera that stands still, in the median orientation.
        surroundings: the room if the camera is carried around the person (`motion` has the shifts of its walk): `room`
            is then that of the first frame. None: the camera stays in its place.
        distortion: first radial coefficient of the lens (`distort_picture`). The ground truth, masks included, is that
            of a lens without distortion.
    """

    subject: Subject
    motion: Motion
    camera: Camera
    light: Light
    room: Room
    ground_m: Float[np.ndarray, "3"]
    fps: float
    samples: int
    ball: Ball | None = None
    hand_held_deg: float = 0.0
    surroundings: Surroundings | None = None
    distortion: float = 0.0

    @cached_property
    def canonical_to_world(self) -> Float[Tensor, "n j 4 4"]:
        """Skinning matrices of all frames."""
        return canonical_to_world(self.subject.body, self.motion)

    def turn_rad(self, frame_index: int) -> float:
        """Return the angle about the vertical by which the root joint has turned since the first frame."""
        first, now = (self.canonical_to_world[row, 0, [0, 2], 2].numpy() for row in (0, frame_index))
        return float(np.arctan2(*now) - np.arctan2(*first))

    def room_of_frame(self, frame_index: int) -> Room:
        """Return the empty room of a frame."""
        if self.surroundings is None:
            return self.room
        shift_m = walking_shift_m(self.motion.time_s[frame_index : frame_index + 1])[0]
        return self.surroundings.seen_by(self.camera, self.ground_m + shift_m, self.turn_rad(frame_index))

    def light_of_frame(self, frame_index: int) -> Light:
        """Return the light of a frame in the world of the camera."""
        return self.light if self.surroundings is None else turned_light(self.light, self.turn_rad(frame_index))

    def render_person(self, frame_index: int) -> Float[np.ndarray, "h w 4"]:
        """Render the person without the room: premultiplied sRGB and coverage, in [0, 1]."""
        vertices = pose_vertices(self.subject, self.canonical_to_world[frame_index])
        return render_subject(self.subject, vertices, self.camera, self.light_of_frame(frame_index), self.samples)

    def render_frame(self, frame_index: int) -> tuple[UInt8[np.ndarray, "h w 3"], UInt8[np.ndarray, "h w"]]:
        """Render the camera image and the coverage by the person, both in 0 to 255."""
        person = self.render_person(frame_index)
        room = self.room_of_frame(frame_index)
        background = room.image * contact_shadow(room, self._feet_m(frame_index))[:, :, None]
        image, coverage = person[:, :, :3] + (1.0 - person[:, :, 3:]) * background, person[:, :, 3]
        if self.ball:
            ball = self.ball.render_rgba(self.camera, frame_index / self.fps, self.light, self.samples)
            ball_transparency = 1.0 - ball[:, :, 3]
            image, coverage = ball[:, :, :3] + ball_transparency[:, :, None] * image, ball_transparency * coverage
        return to_uint8(image), to_uint8(coverage)

    def as_filmed(self, image: UInt8[np.ndarray, "h w *c"], frame_index: int) -> UInt8[np.ndarray, "h w *c"]:
        """Return an image or mask of a camera that stands still as lens and hand of the real one take it."""
        if self.hand_held_deg:
            image = turn_picture(image, self.camera.fx, self._camera_angles_rad[frame_index])
        return distort_picture(image, self.camera, self.distortion) if self.distortion else image

    @cached_property
    def _camera_angles_rad(self) -> Float[np.ndarray, "n 3"]:
        """Pitch, yaw and roll in all frames."""
        count = len(self.motion.frame_index)
        return hand_held_angles_rad(count, self.fps, float(np.radians(self.hand_held_deg)))

    def _feet_m(self, frame_index: int) -> Float[np.ndarray, "4 3"]:
        """Return the world positions of ankles and balls of the feet."""
        body = self.subject.body
        feet = [body.joint(name) for name in _FEET]
        transforms = self.canonical_to_world[frame_index, feet]
        joints = torch.from_numpy(body.joints_m[feet])
        return ((transforms[:, :3, :3] @ joints[:, :, None]).squeeze(-1) + transforms[:, :3, 3]).numpy()


@dataclass(frozen=True)
class HeldOutTargets:
    """Views rendered into the ground truth for evaluation: novel cameras on the first pose, and novel poses."""

    cameras: tuple[Camera, ...]
    motion: Motion | None


def portrait_camera(
    size_px: int, height_m: float, distance_m: float, fill: float, pitch_deg: float = 0.0, roll_deg: float = 0.0
) -> tuple[Camera, np.ndarray]:
    """Return a camera, and the point on the ground where the person stands (world).

    A level camera is at the world origin. A pitched one is moved on a circle about the point at the middle of its
    image, so that the person stays in view.

    Args:
        size_px: side of the square image.
        height_m: of the person.
        distance_m: from camera to person.
        fill: fraction of the image height that the person covers, in (0, 1); approximate for a pitched camera.
        pitch_deg: angle of the optical axis above the horizon.
        roll_deg: angle of the camera about its optical axis, clockwise as seen from behind it.
    """
    focal_px = fill * size_px * distance_m / height_m
    camera = Camera(focal_px, focal_px, size_px / 2, size_px / 2, size_px, size_px)
    ground_m = np.array([0.0, -0.52 * height_m, -distance_m])
    if pitch_deg == roll_deg == 0.0:
        return camera, ground_m
    pitched = _orbit_world_to_camera(np.array([0.0, 0.0, -distance_m]), distance_m, 0.0, np.radians(-pitch_deg))
    cosine, sine = np.cos(np.radians(roll_deg)), np.sin(np.radians(roll_deg))
    rolled = np.eye(4)
    rolled[:2, :2] = [[cosine, sine], [-sine, cosine]]
    return replace(camera, world_to_camera=(rolled @ pitched).astype(np.float32)), ground_m


def distance_to_middle_m(camera: Camera, person_position_m: np.ndarray, height_m: float) -> float:
    """Return the distance from a camera to the middle of a body; see `novel_cameras`."""
    return float(np.linalg.norm(_middle_m(person_position_m, height_m) - camera.centre_m()))


def novel_cameras(
    camera: Camera, person_position_m: np.ndarray, height_m: float, count: int, distance_m: float
) -> tuple[Camera, ...]:
    """Return orbit cameras around the person at azimuths and elevations that the capture does not contain.

    Each camera looks at the middle of the body; +Y is up in the image.

    Args:
        person_position_m: point on the ground where the person stands in the rendered pose (world).
        distance_m: from each camera to the middle of the body.
    """
    middle = _middle_m(person_position_m, height_m)
    azimuths_rad = 2.0 * np.pi * (np.arange(count) + 0.37) / max(count, 1)
    elevations_rad = np.resize(np.radians([18.0, -6.0, 35.0, 8.0]), count)
    return tuple(
        replace(camera, world_to_camera=_orbit_world_to_camera(middle, distance_m, azimuth_rad, elevation_rad))
        for azimuth_rad, elevation_rad in zip(azimuths_rad, elevations_rad, strict=True)
    )


def _middle_m(person_position_m: np.ndarray, height_m: float) -> np.ndarray:
    """Return the middle of a body that stands at a point on the ground."""
    return person_position_m + [0.0, 0.5 * height_m, 0.0]


def _orbit_world_to_camera(
    middle_m: np.ndarray, distance_m: float, azimuth_rad: float, elevation_rad: float
) -> Float[np.ndarray, "4 4"]:
    """Return world_to_camera of an orbit camera; azimuth 0 is on +Z, elevation is above the horizon."""
    backward = np.array(
        [
            np.sin(azimuth_rad) * np.cos(elevation_rad),
            np.sin(elevation_rad),
            np.cos(azimuth_rad) * np.cos(elevation_rad),
        ]
    )
    right = np.array([np.cos(azimuth_rad), 0.0, -np.sin(azimuth_rad)])
    world_to_camera = np.eye(4)
    world_to_camera[:3, :3] = np.stack([right, -np.cross(backward, right), -backward])
    world_to_camera[:3, 3] = -world_to_camera[:3, :3] @ (middle_m + distance_m * backward)
    return world_to_camera.astype(np.float32)


def write_capture(
    out: Path, capture: SyntheticCapture, bare: Body | None, heldout: HeldOutTargets, settings: dict[str, object]
) -> None:
    """Render the capture into the new folder `out`, atomically. UserError if `out` exists."""
    with atomic_folder(out) as part:
        for folder in ("video", "truth/masks"):
            (part / folder).mkdir(parents=True)
        write_video(part / "video" / "video.mp4", _frames(capture, part / "truth" / "masks"), capture.fps)
        write_ground_truth(part / "truth", capture, bare, settings)
        write_heldout(part / "truth", capture, heldout)


def _frames(capture: SyntheticCapture, masks: Path) -> Iterator[UInt8[np.ndarray, "h w 3"]]:
    """Yield the images in order and write the mask of each."""
    for frame_index in track(range(len(capture.motion.frame_index)), "rendering"):
        image, coverage = capture.render_frame(frame_index)
        write_gray(masks / f"{frame_index:06d}.png", coverage)
        yield capture.as_filmed(image, frame_index)


def write_ground_truth(truth: Path, capture: SyntheticCapture, bare: Body | None, settings: dict[str, object]) -> None:
    """Write everything that determines the pixels; `masks/` is already written.

    `clothed.npz` (Body: canonical clothed surface and skeleton), `uv.npz`, `texture.png`, `labels.npz` (garment or body
    part of each face, if known), `bare.npz` (Body without clothes, if known), `motion.npz`, `camera.npz`, `room.png`,
    `capture_settings.json`.
    """
    save_subject(truth, capture.subject)
    if bare is not None:
        save_body(truth / "bare.npz", bare)
    save_motion(truth / "motion.npz", capture.motion)
    save_camera(truth / "camera.npz", capture.camera)
    write_rgb(truth / "room.png", to_uint8(capture.room.image))
    metadata = {
        "version": CAPTURE_VERSION,
        "fps": capture.fps,
        "samples": capture.samples,
        "ground_m": [float(value) for value in capture.ground_m],
        "light": asdict(capture.light),
        "ball": capture.ball is not None,
        "hand_held_deg": capture.hand_held_deg,
        "distortion": capture.distortion,
    }
    (truth / "capture_settings.json").write_text(json.dumps({**settings, **metadata}, indent=2, sort_keys=True) + "\n")


def write_heldout(truth: Path, capture: SyntheticCapture, heldout: HeldOutTargets) -> None:
    """Write `novel_views/` (the first pose) and `novel_poses/` (the capture's camera) as RGBA, straight alpha."""
    subject = capture.subject
    vertices = pose_vertices(subject, capture.canonical_to_world[0])
    for index, camera in enumerate(heldout.cameras):
        (truth / "novel_views").mkdir(exist_ok=True)
        save_camera(truth / "novel_views" / f"{index:06d}.npz", camera)
        person = render_subject(subject, vertices, camera, capture.light, capture.samples)
        write_rgba(truth / "novel_views" / f"{index:06d}.png", unpremultiply_to_uint8(person))
    if heldout.motion is None:
        return
    (truth / "novel_poses").mkdir()
    save_motion(truth / "novel_poses" / "motion.npz", heldout.motion)
    for index, transforms in enumerate(canonical_to_world(subject.body, heldout.motion)):
        vertices = pose_vertices(subject, transforms)
        person = render_subject(subject, vertices, capture.camera, capture.light, capture.samples)
        write_rgba(truth / "novel_poses" / f"{index:06d}.png", unpremultiply_to_uint8(person))
