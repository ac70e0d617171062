"""Bounds of the field and initially occupied cells, from the fitted body and the masks.

Letters: k frames, j joints, n points, g grid cells per axis.
"""

import numpy as np
import torch
from jaxtyping import Bool, Float, UInt8
from scipy.ndimage import binary_fill_holes
from scipy.spatial import cKDTree
from torch import Tensor

from pipeline.body.body import Body
from pipeline.field.occupancy import RESOLUTION, cell_centres
from pipeline.field.skin_grid import smooth_skin_weights
from pipeline.geometry.camera import Camera, project, project_to_pixels
from pipeline.geometry.skinning import linear_blend_skinning
from pipeline.geometry.surface import signed_distance_m

UNSEEN_PRIOR_FALLOFF_M = 0.08
"""Distance from the body, m, at which the prior occupancy of unseen points falls to 0; at half of it, it is 0.5."""
UNSEEN_PRIOR_FRAMES = 8.0
"""Weight of the prior, in frames, where no frame shows a point."""
MAX_VERTEX_DISTANCE_M = 0.06
"""Largest distance of a point of the body surface from the nearest vertex, m."""
MASK_DISTANCE_QUANTILE = 0.99
"""Quantile of the pixel distances of a mask; pixels above it may be strands of hair or errors of the mask."""
OFFSET_PER_MASK_DISTANCE = 2.0
"""Clothing offset relative to the distance from the outline, which a leg before or behind the cloth reduces."""
MASK_STRIDE_PX = 4
"""Every fourth row and column of a mask is used."""
SKIRT_SPACING_M = 0.03
"""Spacing of the points at which masks tell how far a skirt reaches."""
MIN_RESULTANT_LENGTH = 0.75
"""Length of the mean unit direction above which all directions come from one side: that of an arc of 145 degrees.

On real and generated videos it is at most 0.6 for full turns, and 0.8 or more for captures from the front.
"""


def field_bounds_m(body: Body, clothing_offset_m: float) -> Float[np.ndarray, "2 3"]:
    """Return the bounding box of the canonical body, (low, high), widened by the clothing offset on all sides."""
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
    """Estimate the largest distance of clothing from the body, m, from the masks.

    The distance of a mask is the 99th percentile over its pixels of the distance to the nearest projected vertex, in
    metres at the depth of that vertex; with a skirt or coat, over the pixels nearest to vertices in it. The result is
    twice the median over frames, clamped to [`min_offset_m`, `max_offset_m`]; `min_offset_m` wins if it is larger.
    """
    vertices, weights = torch.from_numpy(body.vertices), torch.from_numpy(body.skin_weights)
    counts = np.ones(len(body.vertices), dtype=bool) if body.hem_m is None else _is_in_skirt(body, body.hem_m)
    mask_distances_m = []
    for pose, mask in zip(canonical_to_world, masks, strict=True):
        posed = linear_blend_skinning(vertices, weights, pose[None])[0]
        pixels, depth_m = (tensor.numpy() for tensor in project(posed, camera))
        in_front = depth_m > 0
        mask_px = MASK_STRIDE_PX * np.argwhere(mask[::MASK_STRIDE_PX, ::MASK_STRIDE_PX])[:, ::-1] + 0.5
        if len(mask_px) and in_front.any():
            distance_px, nearest = cKDTree(pixels[in_front]).query(mask_px)
            distance_m = (distance_px * depth_m[in_front][nearest] / camera.fx)[counts[in_front][nearest]]
            if len(distance_m):
                mask_distances_m.append(np.quantile(distance_m, MASK_DISTANCE_QUANTILE))
    mask_distance_m = float(np.median(mask_distances_m)) if mask_distances_m else 0.0
    return max(min_offset_m, min(max_offset_m, OFFSET_PER_MASK_DISTANCE * mask_distance_m))


def skirt_reach_m(
    body: Body,
    canonical_to_world: Float[Tensor, "k j 4 4"],
    camera: Camera,
    masks: list[Bool[np.ndarray, "h w"]],
    max_reach_m: float,
    min_mask_fraction: float,
) -> float | None:
    """Return the distance from the body, m, of the farthest point of a skirt or coat that enough masks contain.

    In front of the gap between the legs cloth is farther from them than any outline shows. None without a hem, and if
    frames show the legs in the skirt from one side only: masks then contain points at any depth.

    max_reach_m: of the points that are tried. min_mask_fraction: as in `initial_occupancy`.
    """
    if body.hem_m is None:
        return None
    of_body = torch.from_numpy(body.skin_weights[_is_in_skirt(body, body.hem_m)])
    if observed_from_one_side(body.joints_m, of_body, canonical_to_world, camera).any():
        return None
    low_m, high_m = body.vertices.min(0) - max_reach_m, body.vertices.max(0) + max_reach_m
    low_m[1], high_m[1] = body.hem_m, body.height_on_legs_m(0.0)
    axes_m = [np.arange(low, high, SKIRT_SPACING_M) for low, high in zip(low_m, high_m, strict=True)]
    points_m = np.stack(np.meshgrid(*axes_m, indexing="ij"), axis=-1).reshape(-1, 3).astype(np.float32)
    distance_m, _ = cKDTree(body.vertices).query(points_m, distance_upper_bound=max_reach_m)
    points_m, distance_m = points_m[np.isfinite(distance_m)], distance_m[np.isfinite(distance_m)]
    weights = torch.from_numpy(smooth_skin_weights(points_m, body))
    of_masks = [mask.astype(np.uint8) for mask in masks]
    fraction = project_mask_fraction(points_m, distance_m, weights, canonical_to_world, camera, of_masks)
    return float(distance_m[fraction >= min_mask_fraction].max(initial=0.0))


def _is_in_skirt(body: Body, hem_m: float) -> Bool[np.ndarray, "v"]:
    """Return the vertices from the hem up to the hip joints."""
    return (body.vertices[:, 1] > hem_m) & (body.vertices[:, 1] < body.height_on_legs_m(0.0))


def cell_signed_distances_m(
    body: Body, bounds_m: Float[np.ndarray, "2 3"], max_distance_m: float
) -> Float[np.ndarray, "gx gy gz"]:
    """Return the signed distance (m) of each cell centre to the canonical body, negative inside; at most
    `max_distance_m`.
    """
    centres, threads = cell_centres(bounds_m), torch.get_num_threads()
    bound_m = max_distance_m + MAX_VERTEX_DISTANCE_M
    vertex_distance_m, _ = cKDTree(body.vertices).query(centres, distance_upper_bound=bound_m, workers=threads)
    # Cells deeper inside the body than the bound are enclosed by cells within it.
    needs_query = binary_fill_holes(np.isfinite(vertex_distance_m).reshape(RESOLUTION, RESOLUTION, RESOLUTION))
    distance = np.full(needs_query.shape, max_distance_m, dtype=np.float32)
    distance[needs_query] = np.minimum(signed_distance_m(centres[needs_query.reshape(-1)], body.mesh()), max_distance_m)
    return distance


def project_mask_fraction(
    centres_m: Float[np.ndarray, "n 3"],
    distance_m: Float[np.ndarray, "n"],
    weights: Float[Tensor, "n j"],
    canonical_to_world: Float[Tensor, "k j 4 4"],
    camera: Camera,
    masks: list[UInt8[np.ndarray, "h w"]],
) -> Float[np.ndarray, "n"]:
    """Return the fraction of the frames in which each canonical point, posed by its skin weights, is in the mask.

    Frames in which a point is outside the image do not count. A prior with the weight of a few frames replaces them: 1
    at the body surface and 0 farther away (`distance_m`), so that feet outside the image do not get spurious density.

    masks: one per frame, non-zero on the person, dilated by the radius that a point represents.
    """
    points = torch.from_numpy(centres_m)
    mask_sum, in_image_count = np.zeros(len(centres_m)), np.zeros(len(centres_m))
    for row, mask in enumerate(masks):
        posed = linear_blend_skinning(points, weights, canonical_to_world[row : row + 1])[0]
        pixel_row, pixel_column, inside = project_to_pixels(posed, camera)
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
    """Return for each point, posed by its skin weights, whether the camera sees it from one side in all frames.

    No frame then shows its distance from the body. The criterion is the length of the mean direction from a joint to
    the camera over all frames, in the frame of the joint, blended by the skin weights (`MIN_RESULTANT_LENGTH`).

    joints_m: canonical joint positions.
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
    """Return the cells inside the body, and those within the clothing offset that enough masks contain."""
    return (distance_m < 0) | ((distance_m < clothing_offset_m) & (mask_fraction >= initial_min_mask_fraction))
