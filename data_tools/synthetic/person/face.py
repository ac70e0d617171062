"""Procedural colours of skin, brows, lips and eyes of the built-in person.

Points are canonical positions in metres; colours are sRGB in [0, 1].
"""

import numpy as np
from jaxtyping import Float

from data_tools.synthetic.person.anatomy import Anatomy
from data_tools.synthetic.person.noise import ValueNoise
from data_tools.synthetic.person.outfit import Outfit

IRIS_RADIUS_M = 0.0062
PUPIL_RADIUS_M = 0.0025


def paint_skin(
    points_m: Float[np.ndarray, "n 3"], anatomy: Anatomy, outfit: Outfit, noise: ValueNoise
) -> Float[np.ndarray, "n 3"]:
    """Colour skin with mottling, redder cheeks, nose and ears, brows, lashes and lips."""
    mottle = noise.fractal(points_m, 0.05) * 0.035 + noise(points_m, 0.004) * 0.02
    colours = np.asarray(outfit.skin, dtype=np.float32) * (1.0 + mottle[:, None])
    mouth, eyes = anatomy.mouth_m, anatomy.eyes_m
    nose = np.array([mouth[0], 0.55 * mouth[1] + 0.45 * eyes[:, 1].mean(), mouth[2] + 0.01])
    cheeks = np.stack([0.5 * (eye + mouth) + [np.sign(eye[0] - mouth[0]) * 0.022, 0.0, -0.01] for eye in eyes])
    for centres, radius_m in ((nose[None], 0.016), (cheeks, 0.026), (anatomy.ears_m, 0.03)):
        for centre in centres:
            _blend_into(colours, np.array([0.78, 0.42, 0.38]), 0.28 * _gaussian_spot(points_m, centre, radius_m))
    _blend_into(colours, _scale_colour(outfit.skin, 0.74), 0.5 * _eye_sockets(points_m, anatomy))
    _blend_into(colours, _lip_colour(outfit), _lips(points_m, anatomy))
    _blend_into(colours, np.asarray(outfit.hair) * 0.9, 0.9 * _brows(points_m, anatomy))
    _blend_into(colours, np.array([0.10, 0.07, 0.06]), _lashes(points_m, anatomy))
    return colours


def paint_eyes(points_m: Float[np.ndarray, "n 3"], anatomy: Anatomy, outfit: Outfit) -> Float[np.ndarray, "n 3"]:
    """Colour sclera, iris with a dark rim, and pupil by the distance from the gaze axis (+Z)."""
    colours = np.full((len(points_m), 3), 0.90, dtype=np.float32) * np.array([1.0, 0.98, 0.96], dtype=np.float32)
    from_axis = np.min([np.hypot(*(points_m - eye)[:, :2].T) for eye in anatomy.eyes_m], axis=0)
    faces_front = points_m[:, 2] > anatomy.eyes_m[:, 2].mean()
    _blend_into(
        colours, _scale_colour(outfit.iris, 0.45), (faces_front & (from_axis < IRIS_RADIUS_M)).astype(np.float32)
    )
    _blend_into(colours, np.asarray(outfit.iris), (faces_front & (from_axis < 0.84 * IRIS_RADIUS_M)).astype(np.float32))
    _blend_into(colours, np.full(3, 0.03), (faces_front & (from_axis < PUPIL_RADIUS_M)).astype(np.float32))
    return colours


def _blend_into(colours: Float[np.ndarray, "n 3"], ink: np.ndarray, amount: Float[np.ndarray, "n"]) -> None:
    """Blend `ink` into `colours` in place; amount in [0, 1]."""
    colours += amount[:, None].astype(np.float32) * (ink.astype(np.float32) - colours)


def _scale_colour(colour: tuple[float, float, float], factor: float) -> np.ndarray:
    return np.asarray(colour) * factor


def _lip_colour(outfit: Outfit) -> np.ndarray:
    return np.asarray(outfit.skin) * np.array([0.84, 0.66, 0.66])


def _gaussian_spot(points: np.ndarray, centre: np.ndarray, radius_m: float) -> Float[np.ndarray, "n"]:
    """Return an unnormalised Gaussian, 1 at its centre."""
    return np.exp(-((points - centre) ** 2).sum(axis=1) / radius_m**2)


def _linear_step(value: np.ndarray, width: float) -> Float[np.ndarray, "n"]:
    """Return a linear ramp from 0 at -width to 1 at +width."""
    return np.clip(0.5 + 0.5 * value / width, 0.0, 1.0)


def _eye_coordinates(points: np.ndarray, anatomy: Anatomy) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return lateral and vertical offsets (m) from the nearer eye, and whether the point is in front of it."""
    is_left = points[:, 0] > anatomy.eyes_m[:, 0].mean()
    eye = np.where(is_left[:, None], anatomy.eyes_m[0], anatomy.eyes_m[1])
    outwards = (points[:, 0] - eye[:, 0]) * np.where(is_left, 1.0, -1.0)
    return outwards, points[:, 1] - eye[:, 1], points[:, 2] > eye[:, 2] - 0.012


def _brows(points: np.ndarray, anatomy: Anatomy) -> Float[np.ndarray, "n"]:
    """Return the coverage of the brows: an arch over each eye that tapers outwards."""
    outwards, up, in_front = _eye_coordinates(points, anatomy)
    arch = 0.0225 - 5.0 * (outwards - 0.006) ** 2
    half_width = 0.0040 * np.clip((outwards + 0.020) / 0.012, 0, 1) * np.clip((0.032 - outwards) / 0.024, 0, 1)
    inside = np.minimum(half_width - np.abs(up - arch), np.minimum(outwards + 0.017, 0.027 - outwards))
    return _linear_step(inside, 0.0012) * in_front


def _lashes(points: np.ndarray, anatomy: Anatomy) -> Float[np.ndarray, "n"]:
    """Return the coverage of the lashes, where the lids touch the eyeball."""
    outwards, up, in_front = _eye_coordinates(points, anatomy)
    depth = np.min([np.linalg.norm(points - eye, axis=1) for eye in anatomy.eyes_m], axis=0)
    near_ball = _linear_step(anatomy.eye_radius_m + 0.0016 - depth, 0.0007)
    return near_ball * in_front * np.where(up > 0, 0.85, 0.35)


def _eye_sockets(points: np.ndarray, anatomy: Anatomy) -> Float[np.ndarray, "n"]:
    return np.sum([_gaussian_spot(points, eye, anatomy.eye_radius_m + 0.006) for eye in anatomy.eyes_m], axis=0)


def _lips(points: np.ndarray, anatomy: Anatomy) -> Float[np.ndarray, "n"]:
    """Return the coverage of the lips around the mouth."""
    across, up = (points - anatomy.mouth_m)[:, 0], (points - anatomy.mouth_m)[:, 1]
    ellipse_profile = np.sqrt(np.clip(1.0 - (across / 0.0255) ** 2, 0.0, 1.0))
    inside = np.where(up > 0, 0.0085, 0.0105) * ellipse_profile - np.abs(up)
    return _linear_step(inside, 0.0015) * (ellipse_profile > 0) * (points[:, 2] > anatomy.mouth_m[2] - 0.03)
