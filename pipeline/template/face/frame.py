"""The frame of a face, and the outline inside which the avatar takes the template's mesh."""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float

from pipeline.template.face.landmarks import FACE_LANDMARKS

_HALF_WIDTH, _TAPER, _HALF_HEIGHT, _CENTRE_Y = 0.65, 0.28, 0.62, -0.40
"""Outline of the patch: from the brows to below the lower lip, 1.3 times as wide as the outer corners of the eyes at
their height, and narrower by the taper times the distance below them: a jaw may be narrow."""

_EXPONENT = 4.0
"""Of the superellipse |x|^p + |y|^p = 1: rounder than a box, wider at the corners of the eyes than an ellipse."""

_BACK = -0.65
"""Surface behind this plane is not of the face: the outline's prism leaves the head at its back."""


@dataclass(frozen=True)
class FaceFrame:
    """Axes of a face: x to the person's left along the eyes, y up, z forward; origin between the eyes.

    Attributes:
        origin_m: canonical frame.
        axes: rows are x, y and z.
        size_m: distance of the outer corners of the eyes, the unit of the frame.
    """

    origin_m: Float[np.ndarray, "3"]
    axes: Float[np.ndarray, "3 3"]
    size_m: float

    def to_face(self, points_m: Float[np.ndarray, "n 3"]) -> Float[np.ndarray, "n 3"]:
        """Return points in the frame of the face, in units of `size_m`."""
        return (points_m - self.origin_m) @ self.axes.T / self.size_m

    def to_canonical_m(self, points: Float[np.ndarray, "n 3"]) -> Float[np.ndarray, "n 3"]:
        """Return the inverse of `to_face`."""
        return self.size_m * points @ self.axes + self.origin_m

    def level(self, points_m: Float[np.ndarray, "n 3"]) -> Float[np.ndarray, "n"]:
        """Return a function that is negative inside the outline of the patch and 0 on it."""
        x, y, z = self.to_face(points_m).T
        half_width = np.maximum(_HALF_WIDTH + _TAPER * np.minimum(y, 0.0), 0.2)
        across, up = np.abs(x) / half_width, np.abs(y - _CENTRE_Y) / _HALF_HEIGHT
        level = (across**_EXPONENT + up**_EXPONENT) ** (1.0 / _EXPONENT) - 1.0
        return np.where(z > _BACK, level, np.maximum(level, 1.0))

    def angle_rad(self, points_m: Float[np.ndarray, "n 3"]) -> Float[np.ndarray, "n"]:
        """Return the angle around the centre of the outline, counter-clockwise seen from in front."""
        x, y, _ = self.to_face(points_m).T
        return np.arctan2(y - _CENTRE_Y, x)


def face_frame(template_m: Float[np.ndarray, "v 3"]) -> FaceFrame:
    """Return the frame of the face of a template in any shape."""
    points = {name: template_m[vertex].astype(np.float64) for name, (_, vertex) in FACE_LANDMARKS.items()}
    eyes = 0.5 * (points["eye_outer_left"] + points["eye_outer_right"])
    mouth = 0.5 * (points["mouth_corner_left"] + points["mouth_corner_right"])
    across = points["eye_outer_left"] - points["eye_outer_right"]
    size_m = float(np.linalg.norm(across))
    x = across / size_m
    y = (eyes - mouth) - ((eyes - mouth) @ x) * x
    y /= np.linalg.norm(y)
    return FaceFrame(eyes, np.stack([x, y, np.cross(x, y)]), size_m)
