"""Landmarks of the face on a person: a face detector on renders of the textured head, checked against the frames.

Each landmark of the detector that the video shows reliably corresponds to one vertex of the template. The landmarks
were found by the same detector on renders of ten generated people, whose surface is the template's, in the five views
below: median distance of the vertex 1 to 3 mm. A bias of the detector is the same on both sides and cancels.
"""

import math
from dataclasses import dataclass
from pathlib import Path
from typing import Protocol

import numpy as np
import torch
from jaxtyping import Float, Int, UInt8

from pipeline.body.body import Body
from pipeline.core.atomic import atomic_path
from pipeline.geometry.atlas import Atlas
from pipeline.geometry.camera import Camera, project
from pipeline.geometry.mesh import Mesh
from pipeline.geometry.similarity import fit_similarity
from pipeline.io.npz import load_npz, save_npz
from pipeline.kernels.raster import rasterize
from pipeline.kernels.texture_sampling import supersample_texture

FACE_LANDMARKS = {
    "eye_outer_left": (263, 6787),
    "eye_outer_right": (33, 20),
    "eye_inner_left": (362, 11455),
    "eye_inner_right": (133, 66),
    "eye_upper_left": (386, 11434),
    "eye_upper_right": (159, 2),
    "eye_lower_left": (374, 7745),
    "eye_lower_right": (145, 1069),
    "mouth_corner_left": (291, 11910),
    "mouth_corner_right": (61, 5323),
    "upper_lip_left": (269, 11924),
    "upper_lip_right": (39, 5338),
    "lower_lip_left": (405, 7223),
    "lower_lip_right": (181, 484),
    "lip_top": (0, 455),
    "lip_bottom": (17, 496),
    "lip_line": (13, 468),
    "nose_tip": (4, 294),
    "nose_base": (2, 316),
    "nose_bridge": (168, 136),
}
"""Landmark of the detector (MediaPipe's number) and vertex of the template."""
LANDMARK_NUMBERS, LANDMARK_VERTICES = (np.array(column) for column in zip(*FACE_LANDMARKS.values(), strict=True))

VIEWS_RAD = ((0.0, 0.0), (0.25, 0.0), (-0.25, 0.0), (0.0, 0.15), (0.0, -0.15))
"""Azimuth and elevation of the cameras."""

VIEW_PX = 512
HALF_VIEW_M = 0.15
CAMERA_DISTANCE_M = 3.0
MAX_RESIDUAL_M = 0.008
"""A face whose landmarks differ more (root mean square) from those of the template after a similarity transform is
not used. Ten generated people: 2 to 3 mm."""
MAX_SCALE, MAX_ROTATION_RAD, MAX_SHIFT_M = 1.3, math.radians(20.0), 0.04
"""Largest factor of size either way, rotation and shift of the similarity transform: a larger one is another face, or a
pattern that looks like one. Ten people: 0.93 to 1.08, 5 degrees, 19 mm."""
MAX_DISAGREEMENT_M = 0.004
"""Landmarks of the renders are used while they are (median) this close to those of the frames. The former are the more
accurate: renders are large and alike for everyone. Six people without glasses: 1.9 to 2.9 mm; with dark ones 6.3 mm."""


class Detector(Protocol):
    """`pipeline.capture.face_detector.FaceDetector`, or a stand-in for it."""

    def detect_face(self, rgb: UInt8[np.ndarray, "h w 3"]) -> Float[np.ndarray, "478 2"] | None:
        """Return the landmarks of a face in pixels, or None."""
        ...

    def close(self) -> None:
        """Free the memory of the detector."""
        ...


@dataclass(frozen=True)
class FaceLandmarks:
    """Where some vertices of the template are on the surface of a person.

    Attributes:
        vertices: of the template.
        positions_m: on the surface, canonical frame.
        residual_m: root mean square distance to the template's landmarks after a similarity transform.
    """

    vertices: Int[np.ndarray, "l"]
    positions_m: Float[np.ndarray, "l 3"]
    residual_m: float


def save_landmarks(path: Path, landmarks: FaceLandmarks | None) -> None:
    """Write the landmarks as a checkpoint; without arrays where there are none."""
    with atomic_path(path) as temporary_path:
        save_npz(temporary_path, {} if landmarks is None else vars(landmarks))


def load_landmarks(path: Path) -> FaceLandmarks | None:
    """Read what `save_landmarks` wrote.

    Raises:
        UserError: the file is damaged.
    """
    arrays = load_npz(path)
    if not arrays:
        return None
    return FaceLandmarks(arrays["vertices"], arrays["positions_m"], float(arrays["residual_m"]))


def rendered_landmarks_m(
    body: Body, mesh: Mesh, atlas: Atlas, diffuse: Float[np.ndarray, "s s 3"], detector: Detector
) -> Float[np.ndarray, "l 3"] | None:
    """Return where `FACE_LANDMARKS` are on the avatar's surface (m), or None where the detector finds no face.

    Args:
        body: of the template, in the A-pose; tells where the head is.
        mesh, atlas, diffuse: the textured avatar in the A-pose.
        detector: finds the landmarks in a picture.
    """
    found = []
    for azimuth_rad, elevation_rad in VIEWS_RAD:
        camera = head_camera(body, azimuth_rad, elevation_rad)
        picture, surface_m = _render(mesh, atlas, diffuse, camera)
        landmarks_px = detector.detect_face(picture)
        if landmarks_px is not None:
            column, row = np.clip(landmarks_px[LANDMARK_NUMBERS].astype(int), 0, VIEW_PX - 1).T
            found.append(surface_m[row, column])
    if len(found) < len(VIEWS_RAD) // 2 + 1:
        return None
    positions_m = np.nanmedian(np.array(found), axis=0)
    return positions_m if np.isfinite(positions_m).all() else None


def choose_landmarks(
    body: Body, rendered_m: Float[np.ndarray, "l 3"] | None, filmed_m: Float[np.ndarray, "l 3"] | None
) -> FaceLandmarks | None:
    """Return the landmarks found on renders, or those of the frames if only they are plausible or the two disagree."""
    rendered, filmed = (
        None if positions_m is None else if_plausible(body, positions_m) for positions_m in (rendered_m, filmed_m)
    )
    if rendered is None or filmed is None:
        return rendered or filmed
    distance_m = np.linalg.norm(rendered.positions_m - filmed.positions_m, axis=1)
    return rendered if np.median(distance_m) <= MAX_DISAGREEMENT_M else filmed


def if_plausible(body: Body, positions_m: Float[np.ndarray, "l 3"]) -> FaceLandmarks | None:
    """Return the landmarks, or None where no small similarity transform brings those of the body near them."""
    of_body_m = body.vertices[LANDMARK_VERTICES]
    transform = fit_similarity(of_body_m, positions_m)
    moved_m = transform(of_body_m)
    residual_m = float(np.sqrt(np.mean(np.sum((moved_m - positions_m) ** 2, axis=1))))
    rotation_rad = math.acos(float(np.clip(0.5 * (np.trace(transform.rotation) - 1.0), -1.0, 1.0)))
    is_small = (
        1.0 / MAX_SCALE < transform.scale < MAX_SCALE
        and rotation_rad < MAX_ROTATION_RAD
        and np.linalg.norm(moved_m.mean(axis=0) - of_body_m.mean(axis=0)) < MAX_SHIFT_M
    )
    is_plausible = is_small and residual_m <= MAX_RESIDUAL_M
    return FaceLandmarks(LANDMARK_VERTICES, positions_m, residual_m) if is_plausible else None


def head_camera(body: Body, azimuth_rad: float, elevation_rad: float) -> Camera:
    """Return a camera that looks at the centre of the head from in front; azimuth towards the person's left."""
    head = body.vertices[body.skin_weights[:, body.joint("Head")] > 0.5]
    centre_m = np.array([head[:, 0].mean(), 0.5 * (head[:, 1].min() + head[:, 1].max()), head[:, 2].mean()])
    flat = math.cos(elevation_rad)
    backward = np.array(
        [math.sin(azimuth_rad) * flat, math.sin(elevation_rad), math.cos(azimuth_rad) * flat]
    )  # from the head to the camera
    right = np.array([math.cos(azimuth_rad), 0.0, -math.sin(azimuth_rad)])
    world_to_camera = np.eye(4, dtype=np.float32)
    world_to_camera[:3, :3] = np.stack([right, np.cross(-backward, right), -backward])
    world_to_camera[:3, 3] = -world_to_camera[:3, :3] @ (centre_m + CAMERA_DISTANCE_M * backward)
    focal_px = 0.5 * VIEW_PX * CAMERA_DISTANCE_M / HALF_VIEW_M
    return Camera(focal_px, focal_px, VIEW_PX / 2, VIEW_PX / 2, VIEW_PX, VIEW_PX, world_to_camera)


def _render(
    mesh: Mesh, atlas: Atlas, diffuse: Float[np.ndarray, "s s 3"], camera: Camera
) -> tuple[UInt8[np.ndarray, "h w 3"], Float[np.ndarray, "h w 3"]]:
    """Return a picture on white, and the surface point (m) of each pixel, nan on the background."""
    vertices, faces = torch.from_numpy(mesh.vertices).float(), torch.from_numpy(mesh.faces)
    face_id, barycentric, _ = rasterize(*project(vertices, camera), faces, camera.height, camera.width)
    faces_uv, uv = torch.from_numpy(atlas.faces_uv), torch.from_numpy(atlas.uv)
    image = supersample_texture(face_id, barycentric, faces_uv, uv, torch.from_numpy(diffuse), 1).numpy()
    picture = np.clip(255.0 * (image[..., :3] + 1.0 - image[..., 3:]), 0.0, 255.0).astype(np.uint8)
    surface_m = np.full((*picture.shape[:2], 3), np.nan)
    seen = face_id.numpy() >= 0
    corners = mesh.vertices[mesh.faces[face_id.numpy()[seen]]]
    surface_m[seen] = np.einsum("nk,nkc->nc", barycentric.numpy()[seen], corners)
    return picture, surface_m
