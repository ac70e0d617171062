"""Long hair: surface that stands off the neck and hangs behind or beside it, in the colour of the back of the head."""

import cv2
import numpy as np
from jaxtyping import Float

from pipeline.body.body import Body
from pipeline.geometry.mesh import Mesh
from pipeline.mesh.face import smooth_step
from pipeline.mesh.files import MeshArtifact
from pipeline.template.chains import (
    Chain,
    LoosePart,
    between_angles,
    chain_weights,
    joint_count,
    smooth,
    weight_of,
)
from pipeline.template.sections import SLICE_M, cut_at_height

MIN_HAIR_M = 0.15
"""Least length of hair below the base of the skull."""

HAIR_OFFSET_M, MIN_HAIR_VERTICES = 0.04, 12
"""Least distance of hair from the back of the neck, and vertices that a strand of it has."""

MAX_HAIR_COLOUR = 25.0
"""Greatest difference (CIELAB) of hair that hangs from the back of the head: a hood or a collar has another colour."""

_HAIR_SECTORS_DEG = (-60.0, 0.0, 60.0)
"""Directions around the neck of the strands, from behind towards the person's left."""


def find_hair(body: Body, skinned: MeshArtifact, looseness: Float[np.ndarray, "v"]) -> LoosePart | None:
    """Return the hair that hangs below the base of the skull behind or beside the neck."""
    mesh, vertices = skinned.mesh, skinned.mesh.vertices.astype(np.float64)
    neck_m, skull_m = (body.joints_m[body.joint(name)].astype(np.float64) for name in ("Neck", "Head"))
    if _offset_behind_m(mesh, body, neck_m, skull_m) < HAIR_OFFSET_M:
        return None
    lab = cv2.cvtColor(skinned.vertex_colours[None].astype(np.float32), cv2.COLOR_RGB2LAB)[0].astype(np.float64)
    on_head = weight_of(skinned, body, ("Head",)) > 0.9
    behind = on_head & (vertices[:, 1] > skull_m[1] + 0.06) & (vertices[:, 2] < skull_m[2])
    if not behind.any():
        return None
    is_hair_colour = np.linalg.norm(lab - np.median(lab[behind], axis=0), axis=1) < MAX_HAIR_COLOUR
    near = weight_of(skinned, body, ("Head", "Neck", "Spine2", "Spine1", "LeftShoulder", "RightShoulder")) > 0.5
    hangs = near & (looseness > 0.3) & (vertices[:, 1] < skull_m[1]) & is_hair_colour & (vertices[:, 2] < neck_m[2])
    away_rad = np.arctan2(vertices[:, 0] - neck_m[0], neck_m[2] - vertices[:, 2])
    chains, kept_rad, lows_m = [], [], []
    for sector_rad in np.deg2rad(_HAIR_SECTORS_DEG):
        rows = hangs & (np.abs(away_rad - sector_rad) < np.deg2rad(30.0))
        if np.count_nonzero(rows) < MIN_HAIR_VERTICES:
            continue
        low_m = float(np.quantile(vertices[rows, 1], 0.03))
        if skull_m[1] - low_m < MIN_HAIR_M:
            continue
        chains.append(Chain("Head", _strand(vertices[rows], float(skull_m[1]), low_m)))
        kept_rad.append(float(sector_rad))
        lows_m.append(low_m)
    if not chains:
        return None
    joints = max(len(chain.joints_m) for chain in chains)
    chains = [Chain(chain.parent, _resampled(chain.joints_m, joints)) for chain in chains]
    along = (skull_m[1] - vertices[:, 1]) / (skull_m[1] - min(lows_m))
    amount = looseness * smooth_step(along, 0.0, 0.3) * (near & is_hair_colour & (vertices[:, 2] < neck_m[2]))
    of_chain = between_angles(away_rad, np.array(kept_rad))
    return LoosePart("hair", tuple(chains), chain_weights(smooth(amount, mesh), of_chain, along, joints - 1))


def _offset_behind_m(mesh: Mesh, body: Body, neck_m: Float[np.ndarray, "3"], skull_m: Float[np.ndarray, "3"]) -> float:
    """Return how far the surface lies behind the body's neck: the median over its height."""
    middle_x, offsets = float(neck_m[0]), []
    for height_m in np.arange(neck_m[1], skull_m[1], SLICE_M):
        back_m, body_m = (
            cut_at_height(surface, float(height_m)).depth_range_m(middle_x)[0]
            for surface in (mesh, Mesh(body.vertices, body.faces))
        )
        offsets.append(body_m - back_m)
    return float(np.nanmedian(offsets)) if np.isfinite(offsets).any() else 0.0


def _strand(points_m: Float[np.ndarray, "p 3"], top_m: float, low_m: float) -> Float[np.ndarray, "n 3"]:
    """Return joints down the middle of a strand."""
    heights_m = np.linspace(top_m, low_m, joint_count(top_m - low_m))
    near = np.exp(-0.5 * ((points_m[:, 1] - heights_m[:, None]) / (0.3 * (top_m - low_m) / len(heights_m))) ** 2)
    middle_m = (near / np.maximum(near.sum(axis=1, keepdims=True), 1e-12)) @ points_m
    middle_m[:, 1] = heights_m
    return middle_m


def _resampled(joints_m: Float[np.ndarray, "n 3"], count: int) -> Float[np.ndarray, "m 3"]:
    """Return as many points on a chain, evenly spaced over its joints."""
    at = np.linspace(0.0, len(joints_m) - 1.0, count)
    return np.stack([np.interp(at, np.arange(len(joints_m)), column) for column in joints_m.T], axis=1)
