"""Face landmarks: MediaPipe's face mesh, 478 points with the irises.

Kartynnik et al., "Real-time facial surface geometry from monocular video on mobile GPUs", 2019; Grishchenko et al.,
"Attention mesh", 2020. The models are part of the package.
"""

import numpy as np
from jaxtyping import Float, UInt8

from pipeline.capture.person_detector import suppress_stderr

N_FACE_LANDMARKS = 478
MIN_CONFIDENCE = 0.3
"""Least score of the face; renders of small filmed faces are blurred and reach 0.4 to 0.9."""


class FaceDetector:
    """MediaPipe's face mesh with attention on the lips and eyes; about 20 ms per image on one core."""

    def __init__(self) -> None:
        with suppress_stderr():
            from mediapipe.python.solutions.face_mesh import FaceMesh  # here: takes seconds and writes to stderr

            self._model = FaceMesh(
                static_image_mode=True, refine_landmarks=True, min_detection_confidence=MIN_CONFIDENCE
            )

    def detect_face(self, rgb: UInt8[np.ndarray, "h w 3"]) -> Float[np.ndarray, "478 2"] | None:
        """Return the landmarks of the largest face (px, pixel centres at +0.5), or None without a face.

        rgb: a face of 100 pixels or more that looks within some 45 degrees of the camera.
        """
        with suppress_stderr():
            found = self._model.process(rgb).multi_face_landmarks
        if not found:
            return None
        size_px = np.array(rgb.shape[1::-1])
        return np.array([(point.x, point.y) for point in found[0].landmark]) * size_px
