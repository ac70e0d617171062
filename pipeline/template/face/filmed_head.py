"""The fitted body with its face where the frames show it.

The shape of a head has few parameters, so that eyes, nose and mouth of the fitted body are 1 to 2 cm beside the
filmed ones. Where it gives a surface the details of a face, they would be beside the colours.
"""

from dataclasses import replace

import numpy as np
from jaxtyping import Float

from pipeline.body.body import Body
from pipeline.mesh.face import head_vertices, smooth_step
from pipeline.template.face.filmed_landmarks import FilmedFaces
from pipeline.template.face.landmarks import LANDMARK_VERTICES, if_plausible
from pipeline.template.regions import is_template_body

ROBUST_SCALE_M, ROBUST_STEPS = 0.004, 10
"""Residual at which a landmark has half its weight, that of the detector in small faces; steps of reweighting."""
SCALE_PRIOR = 0.15
"""Weight of no change of size and proportions, against one landmark's: a shift is better known than they are."""
INNER_RADIUS, OUTER_RADIUS = 1.6, 3.2
"""In root mean square distances of the landmarks from their centre: within the first all moves, beyond the second
nothing does. Chin and brows are at 1.6, ears at 2.5."""
FRONT_SHARE = 0.6
"""Share of the front half of the head over which the motion grows from none."""


def move_face_to_frames(body: Body, faces: FilmedFaces) -> Body:
    """Return the body with its face shifted and scaled, seen from in front, onto the filmed landmarks.

    The depth stays: frames tell it less well than the body. The body is returned as it is where too few frames show the
    face, where what they show is no plausible face, and for a body of a model file, which has other vertices.

    body: the fitted body in the A-pose.
    """
    points_m = faces.triangulate(body) if is_template_body(body) else None
    if points_m is None or if_plausible(body, points_m) is None:
        return body
    rest_m = body.vertices[LANDMARK_VERTICES, :2].astype(np.float64)
    centre_m = rest_m.mean(axis=0)
    size_m = float(np.sqrt(np.mean(np.sum((rest_m - centre_m) ** 2, axis=1))))
    basis = _affine_basis((rest_m - centre_m) / size_m)
    motion_m = _fit_robustly(basis, points_m[:, :2] - rest_m)
    vertices = body.vertices.astype(np.float64)
    relative = (vertices[:, :2] - centre_m) / size_m
    radius = np.linalg.norm(relative, axis=1)
    head = vertices[head_vertices(body), 2]
    middle_m = 0.5 * (head.min() + head.max())
    share = (1.0 - smooth_step((radius - INNER_RADIUS) / (OUTER_RADIUS - INNER_RADIUS))) * smooth_step(
        (vertices[:, 2] - middle_m) / (FRONT_SHARE * (head.max() - middle_m))
    )
    vertices[:, :2] += share[:, None] * (_affine_basis(relative) @ motion_m)
    return replace(body, vertices=vertices.astype(np.float32))


def _affine_basis(relative: Float[np.ndarray, "n 2"]) -> Float[np.ndarray, "n 3"]:
    return np.column_stack([np.ones(len(relative)), relative])


def _fit_robustly(basis: Float[np.ndarray, "l 3"], shift_m: Float[np.ndarray, "l 2"]) -> Float[np.ndarray, "3 2"]:
    """Return the coefficients whose product with the basis is the shift of most landmarks (Cauchy weights)."""
    weight, prior = np.ones(len(basis)), np.diag([0.0, 1.0, 1.0]) * SCALE_PRIOR * len(basis)
    for _ in range(ROBUST_STEPS):
        weighted = weight[:, None] * basis
        motion_m = np.linalg.solve(weighted.T @ basis + prior, weighted.T @ shift_m)
        weight = 1.0 / (1.0 + np.sum((shift_m - basis @ motion_m) ** 2, axis=1) / ROBUST_SCALE_M**2)
    return np.asarray(motion_m)
