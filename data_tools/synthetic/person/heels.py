"""High heels: the feet of the body are turned toes down, and the toes stay level."""

from dataclasses import replace

import numpy as np
import torch
from jaxtyping import Float

from pipeline.body.body import Body
from pipeline.core.errors import UserError
from pipeline.geometry.rotation import axis_angle_to_matrix
from pipeline.geometry.skinning import linear_blend_skinning

MAX_HEEL_OF_SOLE = 0.8
"""Largest height of a heel over the length of the foot from the heel to the joint of the toes."""


def with_raised_heels(body: Body, heel_m: float) -> Body:
    """Return the body whose heels are this far above the floor; its lowest vertex stays at its height.

    Raises:
        UserError: the heels are too high for feet of this length.
    """
    transforms = np.tile(np.eye(4), (len(body.joint_names), 1, 1))
    for side in ("Left", "Right"):
        ankle, ball = (body.joint(f"{side}{name}") for name in ("Foot", "ToeBase"))
        heel_z = body.vertices[body.skin_weights[:, ankle] > 0.5, 2].min()
        sole_m = float(body.joints_m[ball, 2] - heel_z)
        if heel_m > MAX_HEEL_OF_SOLE * sole_m:
            raise UserError(
                f"--heel-m {heel_m:g} is too high for this foot; choose up to {MAX_HEEL_OF_SOLE * sole_m:.2f}"
            )
        angle = np.arcsin(heel_m / sole_m)
        transforms[ankle] = _about(body.joints_m[ankle], angle)
        transforms[ball] = transforms[ankle] @ _about(body.joints_m[ball], -angle)
    posed = linear_blend_skinning(
        torch.from_numpy(body.vertices), torch.from_numpy(body.skin_weights), torch.from_numpy(transforms).float()[None]
    )[0].numpy()
    moved = np.einsum("jab,jb->ja", transforms[:, :3, :3], body.joints_m) + transforms[:, :3, 3]
    raised = np.array([0.0, body.vertices[:, 1].min() - posed[:, 1].min(), 0.0])
    return replace(
        body,
        vertices=(posed + raised).astype(body.vertices.dtype),
        joints_m=(moved + raised).astype(body.joints_m.dtype),
    )


def _about(point_m: Float[np.ndarray, "3"], pitch_rad: float) -> Float[np.ndarray, "4 4"]:
    """Return a rotation about the axis to the left through a point; positive: what is ahead goes down."""
    transform = np.eye(4)
    transform[:3, :3] = axis_angle_to_matrix(torch.tensor([pitch_rad, 0.0, 0.0], dtype=torch.float64)).numpy()
    transform[:3, 3] = point_m - transform[:3, :3] @ point_m
    return transform
