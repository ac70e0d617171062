"""Compute rotations between directions."""

import torch
from jaxtyping import Float
from torch import Tensor

from pipeline.geometry.rotation import axis_angle_to_matrix


def shortest_arc(start: Float[Tensor, "*n 3"], end: Float[Tensor, "*n 3"]) -> Float[Tensor, "*n 3 3"]:
    """Return the smallest rotation from one direction (any length > 0) to another.

    The rotation axis of opposite directions is an arbitrary perpendicular axis.
    """
    start, end = torch.nn.functional.normalize(start, dim=-1), torch.nn.functional.normalize(end, dim=-1)
    cross = torch.linalg.cross(start, end)
    sine, cosine = cross.norm(dim=-1, keepdim=True), (start * end).sum(-1, keepdim=True)
    fallback_axis = torch.linalg.cross(start, torch.eye(3, dtype=start.dtype)[start.abs().argmin(-1)])
    axis = torch.nn.functional.normalize(torch.where(sine > 1e-7, cross, fallback_axis), dim=-1)
    return axis_angle_to_matrix(axis * torch.atan2(sine, cosine))
