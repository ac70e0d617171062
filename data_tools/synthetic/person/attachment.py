"""Model what stands off a person: long hair, a ponytail, an afro, a cap, a backpack.

Each is a volume that overlaps the person: the zero level of a signed distance, in axes through the middle of the skull
(x to the person's left, y up, z ahead), scaled with the head. It moves with the head above the mouth, and with the
chest below the shoulders.
"""

from collections.abc import Callable

import numpy as np
import xatlas
from jaxtyping import Float
from skimage.measure import marching_cubes

from data_tools.synthetic.person.anatomy import Anatomy
from data_tools.synthetic.person.noise import ValueNoise
from data_tools.synthetic.person.surface import WornSurface, neighbour_averaging_matrix, smooth_laplacian
from pipeline.body.body import Body

CELL_M = 0.009
ATLAS_HEIGHT_FRACTION = 0.25
"""Fraction of the texture height, at the top, that the attachment occupies."""

_ATLAS_MARGIN = 0.004
_SKULL_HEIGHT_M = 0.093
"""From the middle of the skull to the crown of the head for which the shapes below are given."""
_SMOOTHING_ITERATIONS = 2
_LOCKS_M, _LOCKS_PERIOD_M = 0.004, (0.018, 0.06, 0.018)
_HANGING_M = 0.02
"""From the back of head and trunk to the outer side of long hair."""

_Distance = Callable[[Float[np.ndarray, "n 3"]], Float[np.ndarray, "n"]]


def build_attachment(kind: str, body: Body, anatomy: Anatomy, noise: ValueNoise) -> WornSurface:
    """Put one of `ATTACHMENTS` on a clothed person in the A-pose."""
    middle_m = anatomy.skull_m().astype(np.float64)
    scale = (anatomy.crown_y_m - middle_m[1]) / _SKULL_HEIGHT_M
    distance, low, high = ATTACHMENTS[kind]((body.vertices - middle_m) / scale)
    axes = [np.arange(start, end, CELL_M) for start, end in zip(low, high, strict=True)]
    grid = np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1)
    values = distance(grid.reshape(-1, 3))
    if kind in HAIRSTYLES:
        values += _LOCKS_M * noise(grid.reshape(-1, 3).astype(np.float32), _LOCKS_PERIOD_M, order=3)
    vertices, faces, _, _ = marching_cubes(values.reshape(grid.shape[:3]), 0.0, spacing=(CELL_M,) * 3)
    mean = neighbour_averaging_matrix(faces, len(vertices))
    local = smooth_laplacian(vertices + low, mean, _SMOOTHING_ITERATIONS)
    vertices = (middle_m + scale * local).astype(np.float32)
    _, faces_uv, uv = xatlas.parametrize(vertices, faces.astype(np.uint32))
    uv = _ATLAS_MARGIN + (1.0 - 2.0 * _ATLAS_MARGIN) * uv
    uv[:, 1] = 1.0 - ATLAS_HEIGHT_FRACTION * (1.0 - uv[:, 1])
    weights = _skin_weights(vertices, body, anatomy)
    return WornSurface(vertices, faces.astype(np.int32), uv.astype(np.float32), faces_uv.astype(np.int32), weights)


def _skin_weights(vertices: Float[np.ndarray, "v 3"], body: Body, anatomy: Anatomy) -> Float[np.ndarray, "v j"]:
    """Return weights of the head above the mouth, and of the chest below the shoulders."""
    shoulder_y = anatomy.joints_m["LeftArm"][1]
    along = np.clip((vertices[:, 1] - shoulder_y) / (anatomy.mouth_m[1] - shoulder_y), 0.0, 1.0)
    head = along**2 * (3.0 - 2.0 * along)
    weights = np.zeros((len(vertices), len(body.joint_names)), dtype=np.float32)
    weights[:, body.joint("Head")], weights[:, body.joint("Spine2")] = head, 1.0 - head
    return weights


_Shape = tuple[_Distance, Float[np.ndarray, "3"], Float[np.ndarray, "3"]]


def _long_hair(person: Float[np.ndarray, "n 3"]) -> _Shape:
    """Hair that hangs straight from the back of the head to the shoulder blades, and a lock before either shoulder."""
    bottom, rows = -0.42, np.arange(-0.45, 0.1, 0.01)
    strip = person[np.abs(person[:, 0]) < 0.07]
    back = np.array([strip[np.abs(strip[:, 1] - row) < 0.01, 2].min() for row in rows])
    hanging = np.minimum.accumulate(back[::-1])[::-1] - _HANGING_M
    beside = person[np.abs(np.abs(person[:, 0]) - 0.1) < 0.03]
    heights = np.linspace(beside[beside[:, 1] < -0.15, 1].max() - 0.02, -0.36, 5)
    before = np.array([[0.1, y, beside[np.abs(beside[:, 1] - y) < 0.02, 2].max()] for y in heights])
    before[:, 2] = np.maximum.accumulate(before[:, 2])
    lock = np.concatenate([[[0.085, 0.0, 0.0], [0.09, -0.1, 0.02]], before])

    def distance(points: np.ndarray) -> np.ndarray:
        x, y, z = np.abs(points[:, 0]), points[:, 1], points[:, 2]
        outer = np.interp(y, rows, hanging)
        width = np.interp(y, (bottom, -0.25, -0.1, 0.03), (0.10, 0.13, 0.10, 0.06))
        curtain = np.stack([x - width, outer - z, z - outer - 0.06, bottom - y, y - 0.03]).max(axis=0)
        mirrored = np.stack([x, y, z], axis=1)
        return np.minimum(_without_face(points), np.minimum(curtain, _chain(mirrored, lock, 0.026)))

    return distance, np.array([-0.16, bottom - 0.03, -0.25]), np.array([0.16, 0.14, 0.25])


def _ponytail(person: Float[np.ndarray, "n 3"]) -> _Shape:
    """A tail that is tied at the back of the head and hangs to the shoulder blades."""
    tail = np.array([[0.0, 0.03, -0.1], [0.0, 0.04, -0.15], [0.0, -0.04, -0.18], [0.0, -0.16, -0.17], [0, -0.3, -0.16]])
    behind = person[np.abs(person[:, 0]) < 0.05]
    back = np.array([behind[np.abs(behind[:, 1] - y) < 0.03, 2].min() for y in tail[2:, 1]])
    tail[2:, 2] = np.minimum(tail[2:, 2], back - 0.02)
    return (lambda points: _chain(points, tail, 0.028)), np.array([-0.06, -0.36, -0.3]), np.array([0.06, 0.1, -0.04])


def _afro(person: Float[np.ndarray, "n 3"]) -> _Shape:
    """A ball of hair that leaves the face free."""

    def distance(points: np.ndarray) -> np.ndarray:
        ball = np.linalg.norm(points - [0.0, 0.03, -0.02], axis=1) - 0.165
        face = np.stack([np.abs(points[:, 0]) - 0.075, 0.0 - points[:, 2], points[:, 1] - 0.05]).max(axis=0)
        below = -0.08 - points[:, 1]
        return np.maximum(np.maximum(ball, -face), below)

    return distance, np.array([-0.2, -0.14, -0.22]), np.array([0.2, 0.24, 0.2])


def _cap(person: Float[np.ndarray, "n 3"]) -> _Shape:
    """A cap with a brim over the eyes."""

    def distance(points: np.ndarray) -> np.ndarray:
        x, y, z = points.T
        crown = np.maximum(_ellipsoid(points, (0.0, 0.03, 0.01), (0.105, 0.1, 0.132)), 0.035 - y)
        height = 0.045 - 0.12 * (z - 0.1) - 2.0 * x**2
        outline = np.hypot(x / 0.08, (z - 0.09) / 0.13) - 1.0
        brim = np.stack([np.abs(y - height) - 0.006, 0.08 * outline, 0.03 - z]).max(axis=0)
        return np.minimum(crown, brim)

    return distance, np.array([-0.13, -0.02, -0.15]), np.array([0.13, 0.16, 0.25])


def _backpack(person: Float[np.ndarray, "n 3"]) -> _Shape:
    """A bag on the back, from the shoulders to the waist."""
    trunk = person[(np.abs(person[:, 0]) < 0.12) & (person[:, 1] < -0.2)]
    strip = trunk[np.abs(trunk[:, 1] + 0.4) < 0.15]
    back = strip[:, 2].min()
    middle, half = np.array([0.0, -0.43, back - 0.05]), np.array([0.12, 0.17, 0.06])

    def distance(points: np.ndarray) -> np.ndarray:
        beyond = np.abs(points - middle) - half
        return np.linalg.norm(np.maximum(beyond, 0.0), axis=1) + np.minimum(beyond.max(axis=1), 0.0) - 0.03

    low, high = middle - half - 0.06, middle + half + 0.06
    return distance, low, high


ATTACHMENTS: dict[str, Callable[[Float[np.ndarray, "n 3"]], _Shape]] = {
    "long-hair": _long_hair,
    "ponytail": _ponytail,
    "afro": _afro,
    "cap": _cap,
    "backpack": _backpack,
}
"""Signed distance, lower and upper corner of each kind, given the points of the person."""

HAIRSTYLES = ("long-hair", "ponytail", "afro")


def _without_face(points: Float[np.ndarray, "n 3"]) -> Float[np.ndarray, "n"]:
    """Return the distance to hair around the skull that leaves the face free."""
    hair = _ellipsoid(points, (0.0, -0.015, -0.005), (0.105, 0.13, 0.125))
    face = np.maximum(0.045 - points[:, 2], points[:, 1] - 0.055)
    return np.maximum(hair, -face)


def _ellipsoid(
    points: Float[np.ndarray, "n 3"], middle: tuple[float, float, float], radii: tuple[float, float, float]
) -> Float[np.ndarray, "n"]:
    """Return an approximate distance to an ellipsoid, exact where it is zero."""
    return (np.linalg.norm((points - np.array(middle)) / np.array(radii), axis=1) - 1.0) * min(radii)


def _chain(
    points: Float[np.ndarray, "n 3"], corners: Float[np.ndarray, "k 3"], radius: float
) -> Float[np.ndarray, "n"]:
    """Return the distance to a tube around a polyline."""
    nearest = np.full(len(points), np.inf)
    for start, end in zip(corners[:-1], corners[1:], strict=True):
        axis = end - start
        along = np.clip(((points - start) * axis).sum(axis=1) / (axis @ axis), 0.0, 1.0)
        nearest = np.minimum(nearest, np.linalg.norm(points - start - along[:, None] * axis, axis=1))
    return nearest - radius
