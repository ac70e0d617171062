"""Face landmarks: MediaPipe's face mesh, 478 points with the irises.

Kartynnik et al., "Real-time facial surface geometry from monocular video on mobile GPUs", 2019; Grishchenko et al.,
"Attention mesh", 2020. The models are part of the package.
"""

from contextlib import nullcontext

import numpy as np
from jaxtyping import Float, UInt8

from pipeline.capture.hand_detector import image_scale_px_per_m
from pipeline.capture.person_detector import suppress_stderr

N_FACE_LANDMARKS = 478
MIN_CONFIDENCE = 0.3
"""Least score of the face; small filmed faces are blurred and reach 0.4 to 0.9."""

HALF_WINDOW_M = 0.22
"""Half the side of the window around the head in which a face is looked for."""
MIN_WINDOW_PX = 48
"""Smaller windows are skipped: a face is less than half as wide."""
_FACE_OF_POSE = slice(0, 11)
"""Nose, eyes, ears and mouth among the pose landmarks."""


class FaceDetector:
    """MediaPipe's face mesh with attention on the lips and eyes; about 20 ms per image on one core."""

    def __init__(self) -> None:
        with suppress_stderr():
            from mediapipe.python.solutions.face_mesh import FaceMesh  # here: takes seconds and writes to stderr

            self._model = FaceMesh(
                static_image_mode=True, refine_landmarks=True, min_detection_confidence=MIN_CONFIDENCE
            )
            # Its threads start asynchronously, and their messages would appear after this block.
            self._model.process(np.zeros((64, 64, 3), dtype=np.uint8))
        self._is_stderr_quiet = False

    def close(self) -> None:
        """Free the memory of the model; nothing can be detected afterwards."""
        self._model.close()

    def detect_face(self, rgb: UInt8[np.ndarray, "h w 3"]) -> Float[np.ndarray, "478 2"] | None:
        """Return the landmarks of the largest face (px, pixel centres at +0.5), or None without a face.

        rgb: a face of 100 pixels or more that looks within some 45 degrees of the camera.
        """
        landmarks_px = self._detect(rgb)
        return None if landmarks_px is None else landmarks_px[:, :2]

    def detect_face_of_person(
        self,
        rgb: UInt8[np.ndarray, "h w 3"],
        pose_px: Float[np.ndarray, "33 2"],
        pose_world_m: Float[np.ndarray, "33 3"],
    ) -> Float[np.ndarray, "478 3"]:
        """Return the face of the person with this pose: pixels, and depth away from the camera in pixels; nan without.

        The depth is relative to the face.
        """
        nowhere_px = undetected_face()
        half_px = HALF_WINDOW_M * float(image_scale_px_per_m(pose_px, pose_world_m))
        if not 2.0 * half_px >= MIN_WINDOW_PX:  # also without a pose, which is nan
            return nowhere_px
        side_px, middle_px = 2 * round(half_px), pose_px[_FACE_OF_POSE].mean(axis=0)
        low_px = np.floor(middle_px).astype(int) - side_px // 2
        window = _crop_with_border(rgb, low_px, side_px)
        landmarks_px = None if window is None else self._detect(window)
        return nowhere_px if landmarks_px is None else (landmarks_px + [*low_px, 0.0]).astype(np.float32)

    def _detect(self, rgb: UInt8[np.ndarray, "h w 3"]) -> Float[np.ndarray, "478 3"] | None:
        with nullcontext() if self._is_stderr_quiet else suppress_stderr():
            found = self._model.process(rgb).multi_face_landmarks
        if not found:
            return None
        self._is_stderr_quiet = True
        height_px, width_px = rgb.shape[:2]
        return np.array([(point.x, point.y, point.z) for point in found[0].landmark]) * [width_px, height_px, width_px]


def undetected_face(*images: int) -> Float[np.ndarray, "*n 478 3"]:
    """Return a result without faces for so many images (without arguments: for one image)."""
    return np.full((*images, N_FACE_LANDMARKS, 3), np.nan, dtype=np.float32)


def _crop_with_border(
    rgb: UInt8[np.ndarray, "h w 3"], low_px: np.ndarray, side_px: int
) -> UInt8[np.ndarray, "s s 3"] | None:
    """Return a square window, black outside of the image; None if it lies outside altogether."""
    size_px = np.array(rgb.shape[1::-1])
    first, last = np.maximum(low_px, 0), np.minimum(low_px + side_px, size_px)
    if (last <= first).any():
        return None
    window = np.zeros((side_px, side_px, 3), dtype=np.uint8)
    inside = tuple(slice(a, b) for a, b in zip((first - low_px)[::-1], (last - low_px)[::-1], strict=True))
    window[inside] = rgb[first[1] : last[1], first[0] : last[0]]
    return window
