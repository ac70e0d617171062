"""Where the masks allow a person to be: the box of the field and the cells that training starts with."""

import numpy as np
import torch
from jaxtyping import Bool, Float, UInt8
from scipy.ndimage import binary_fill_holes
from scipy.spatial import cKDTree
from torch import Tensor

from pipeline.body.body import Body
from pipeline.field.occupancy import RESOLUTION, cell_centres
from pipeline.geometry.camera import Camera, project
from pipeline.geometry.skinning import linear_blend_skinning
from pipeline.geometry.surface import signed_distance_m

UNSEEN_PRIOR_FALLOFF_M = 0.08
"""Beyond this distance from the body nothing is expected unseen; at half of it, as likely as not."""
UNSEEN_PRIOR_FRAMES = 8.0
"""Frames that the expectation counts for where no frame shows a point."""
MAX_VERTEX_DISTANCE_M = 0.06
"""No point of a body's surface is farther from the nearest vertex."""
MASK_DISTANCE_QUANTILE = 0.99
"""Part of a mask's pixels that its clothes explain; the rest may be strands of hair or strokes of a poor mask."""
OFFSET_PER_MASK_DISTANCE = 2.0
"""Cloth stands farther off the body than off its outline: a leg before or behind the cloth hides the gap."""
MASK_STRIDE_PX = 4
MIN_RESULTANT_LENGTH = 0.75
"""Mean of unit directions, its length, from which on they come from one side: that of an arc of 145 degrees."""


def field_bounds_m(body: Body, clothing_offset_m: float) -> Float[np.ndarray, "2 3"]:
    """The body's canonical box, widened on all sides."""
    return np.stack([body.vertices.min(0) - clothing_offset_m, body.vertices.max(0) + clothing_offset_m]).astype(
        np.float32
    )


def estimate_clothing_offset_m(
    body: Body,
    canonical_to_world: Float[Tensor, "k j 4 4"],
    camera: Camera,
    masks: list[Bool[np.ndarray, "h w"]],
    min_offset_m: float,
    max_offset_m: float,
) -> float:
    """How far from the body clothes may stand, judged by how far the masks reach beyond it; m.

    The reach of a mask is the 99th percentile over its pixels of the distance to the body's nearest vertex in the
    image, at that vertex's depth. Twice the median over frames counts, so that some poor masks or poses do not; no
    more than `max_offset_m`, and never less than `min_offset_m`.
    """
    vertices, weights = torch.from_numpy(body.vertices), torch.from_numpy(body.skin_weights)
    mask_distances_m = []
    for pose, mask in zip(canonical_to_world, masks, strict=True):
        posed = linear_blend_skinning(vertices, weights, pose[None])[0]
        pixels, depth_m = (of.numpy() for of in project(posed, camera))
        in_front = depth_m > 0
        mask_px = MASK_STRIDE_PX * np.argwhere(mask[::MASK_STRIDE_PX, ::MASK_STRIDE_PX])[:, ::-1] + 0.5
        if len(mask_px) and in_front.any():
            distance_px, nearest = cKDTree(pixels[in_front]).query(mask_px)
            mask_distances_m.append(
                np.quantile(distance_px * depth_m[in_front][nearest] / camera.fx, MASK_DISTANCE_QUANTILE)
            )
    reach_m = float(np.median(mask_distances_m)) if mask_distances_m else 0.0
    return max(min_offset_m, min(max_offset_m, OFFSET_PER_MASK_DISTANCE * reach_m))


def cell_signed_distances_m(
    body: Body, bounds_m: Float[np.ndarray, "2 3"], reach_m: float
) -> Float[np.ndarray, "gx gy gz"]:
    """Signed distance of each cell's centre to the canonical body, negative inside; at most `reach_m`."""
    centres, threads = cell_centres(bounds_m), torch.get_num_threads()
    bound_m = reach_m + MAX_VERTEX_DISTANCE_M
    vertex_distance_m, _ = cKDTree(body.vertices).query(centres, distance_upper_bound=bound_m, workers=threads)
    # What lies deeper inside the body than that is enclosed by what does not.
    needs_query = binary_fill_holes(np.isfinite(vertex_distance_m).reshape(RESOLUTION, RESOLUTION, RESOLUTION))
    distance = np.full(needs_query.shape, reach_m, dtype=np.float32)
    distance[needs_query] = np.minimum(signed_distance_m(centres[needs_query.reshape(-1)], body.mesh()), reach_m)
    return distance


def project_mask_fraction(
    centres_m: Float[np.ndarray, "n 3"],
    distance_m: Float[np.ndarray, "n"],
    weights: Float[Tensor, "n j"],
    canonical_to_world: Float[Tensor, "k j 4 4"],
    camera: Camera,
    masks: list[UInt8[np.ndarray, "h w"]],
) -> Float[np.ndarray, "n"]:
    """Part of the frames in which each canonical point, carried by its skin weights, projects into the mask.

    Frames in which a point lies outside the image do not count. In their place stands, with the weight of a few
    frames, what one expects unseen: clothing near the body (at `distance_m` from it) and nothing farther off, so that
    feet which the image cuts off do not grow lumps.
    masks: one a frame, dilated by as much as a point stands for.
    """
    points = torch.from_numpy(centres_m)
    mask_sum, in_image_count = np.zeros(len(centres_m)), np.zeros(len(centres_m))
    for row, mask in enumerate(masks):
        posed = linear_blend_skinning(points, weights, canonical_to_world[row : row + 1])[0]
        pixels, depth_m = project(posed, camera)
        pixel_column, pixel_row = (pixels[:, axis].floor().long().numpy() for axis in range(2))
        inside = (
            (depth_m.numpy() > 0)
            & (pixel_column >= 0)
            & (pixel_row >= 0)
            & (pixel_column < mask.shape[1])
            & (pixel_row < mask.shape[0])
        )
        in_image_count += inside
        mask_sum[inside] += mask[pixel_row[inside], pixel_column[inside]] > 0
    prior = np.clip(1.0 - distance_m / UNSEEN_PRIOR_FALLOFF_M, 0.0, 1.0)
    prior_weight = UNSEEN_PRIOR_FRAMES * (1.0 - in_image_count / max(len(masks), 1))
    return ((mask_sum + prior_weight * prior) / np.maximum(in_image_count + prior_weight, 1e-6)).astype(np.float32)


def observed_from_one_side(
    joints_m: Float[np.ndarray, "j 3"],
    weights: Float[Tensor, "n j"],
    canonical_to_world: Float[Tensor, "k j 4 4"],
    camera: Camera,
) -> Bool[np.ndarray, "n"]:
    """Whether each point, carried by its skin weights, turns the same side to the camera in all frames.

    How far off the body something is then shows in no frame. Judged by the directions from the joints (canonical
    positions) to the camera, each in the joint's own space: on real and generated videos their mean had a length of 0.6
    at most in full turns, of 0.8 and more in films from the front.
    """
    canonical_m = torch.from_numpy(joints_m).to(canonical_to_world)
    rotation, translation_m = canonical_to_world[..., :3, :3], canonical_to_world[..., :3, 3]
    to_camera = (
        torch.from_numpy(camera.centre_m()).to(canonical_m)
        - (rotation @ canonical_m[:, :, None])[..., 0]
        - translation_m
    )
    in_joint = torch.nn.functional.normalize((rotation.transpose(-1, -2) @ to_camera[..., None])[..., 0], dim=-1)
    resultant_length = in_joint.mean(0).norm(dim=-1)
    return (weights @ resultant_length > MIN_RESULTANT_LENGTH).numpy()


def initial_occupancy(
    distance_m: Float[np.ndarray, "*grid"],
    mask_fraction: Float[np.ndarray, "*grid"],
    clothing_offset_m: float,
    initial_min_mask_fraction: float,
) -> Bool[np.ndarray, "*grid"]:
    """Cells within the clothing margin that enough masks hold, and all cells inside the body."""
    return (distance_m < 0) | ((distance_m < clothing_offset_m) & (mask_fraction >= initial_min_mask_fraction))
