"""From a fitted body and the pictures to a field that is ready to learn."""

from collections.abc import Sequence

import cv2
import numpy as np
import torch
from jaxtyping import Float, UInt8

from pipeline.body.body import Body, Motion, canonical_to_world
from pipeline.core.device import CPU
from pipeline.field.config import FieldConfig
from pipeline.field.field import EMPTY_GRID_LAYOUT, RadianceField, hash_grid_layout
from pipeline.field.initial_occupancy import (
    cell_signed_distances_m,
    estimate_clothing_offset_m,
    field_bounds_m,
    initial_occupancy,
    observed_from_one_side,
    project_mask_fraction,
)
from pipeline.field.occupancy import OccupancyGrid, cell_centres
from pipeline.field.pixel_sampler import build_pixel_pool
from pipeline.field.positional_mlp import LAYER_COUNT, PositionalMlp
from pipeline.field.skin_grid import build_skin_grid, skin_margin_m
from pipeline.field.trainer import Trainer, TrainingScene
from pipeline.field.visual_hull import carve_visual_hull, dense_layout
from pipeline.geometry.camera import Camera, transform_world_to_camera

MASK_FRAMES = 32
"""Frames that are asked which cells their masks hold."""

MaskedImage = tuple[UInt8[np.ndarray, "h w 3"], UInt8[np.ndarray, "h w"]]


def median_root_depth_m(motion: Motion, camera: Camera) -> float:
    """Median depth of the body's root before the camera."""
    roots = transform_world_to_camera(torch.as_tensor(motion.root_translation_m), camera)
    return float(roots[:, 2].median())


def training_scale(body: Body, motion: Motion, camera: Camera, max_person_px: int) -> float:
    """Factor by which images shrink so that the standing person is at most `max_person_px` tall; at most 1."""
    person_px = body.height_m() * camera.fy / median_root_depth_m(motion, camera)
    return min(1.0, max_person_px / person_px)


def evenly_spaced(count: int, limit: int) -> np.ndarray:
    """At most `limit` of the positions 0..count-1, evenly spread."""
    return np.unique(np.linspace(0, count - 1, min(count, limit)).round().astype(np.int64))


def create_trainer(
    body: Body,
    motion: Motion,
    camera: Camera,
    masked_images: Sequence[MaskedImage],
    config: FieldConfig,
    device: torch.device = CPU,
) -> Trainer:
    """Choose box, grid levels and starting cells from the data, and set everything up; what learns lies on `device`.

    pictures: image and mask of each frame of `motion`, for `camera`.
    """
    rows = evenly_spaced(len(masked_images), MASK_FRAMES)
    poses, masks = canonical_to_world(body, motion.select(rows)), [masked_images[row][1] >= 128 for row in rows]
    clothing_offset_m = estimate_clothing_offset_m(
        body, poses, camera, masks, config.min_clothing_offset_m, config.max_clothing_offset_m
    )
    bounds_m = field_bounds_m(body, clothing_offset_m)
    skin = build_skin_grid(body, skin_margin_m(body, bounds_m))
    pixel_m = median_root_depth_m(motion, camera) / camera.fy
    distance_m = cell_signed_distances_m(body, bounds_m, clothing_offset_m)
    near = distance_m < clothing_offset_m
    frequency, one_sided = np.zeros(near.shape, dtype=np.float32), np.zeros(near.shape, dtype=bool)
    centres_m = cell_centres(bounds_m)[near.reshape(-1)]
    weights = skin.interpolate_weights(torch.from_numpy(centres_m))
    one_sided[near] = observed_from_one_side(body.joints_m, weights, poses, camera)
    cell_px = 0.5 * float((bounds_m[1] - bounds_m[0]).max()) / distance_m.shape[0] / pixel_m
    frequency[near] = project_mask_fraction(
        centres_m,
        distance_m[near],
        weights,
        poses,
        camera,
        [dilate(mask, cell_px) for mask in masks],
    )
    occupancy = OccupancyGrid(
        initial_occupancy(distance_m, frequency, clothing_offset_m, config.initial_min_mask_fraction),
        distance_m,
        frequency,
        one_sided,
        bounds_m,
        clothing_offset_m=clothing_offset_m,
        attention=config.occupancy == "attention",
        learning_rate=config.attention_learning_rate,
        decay=config.occupancy_decay,
        threshold=config.occupancy_threshold,
        seed=config.seed,
        device=device,
    )
    pool = build_pixel_pool(masked_images, config.border_px, config.seed)
    scene = TrainingScene(body, motion, camera, pool, skin)
    field = initial_field(scene, masked_images, bounds_m, pixel_m, config).to(device)
    return Trainer(scene, field, occupancy, config)


def initial_field(
    scene: TrainingScene,
    masked_images: Sequence[MaskedImage],
    bounds_m: Float[np.ndarray, "2 3"],
    pixel_m: float,
    config: FieldConfig,
) -> RadianceField:
    """The field as it is before training: thin fog, or a hull carved from the masks. pixel_m: what a pixel covers."""
    cell_m = pixel_m * config.finest_cell_px
    if config.network == "hull":
        poses = canonical_to_world(scene.body, scene.motion)
        layout = dense_layout(bounds_m, cell_m, config.log2_rows)
        return carve_visual_hull(
            scene.body, scene.skin, poses, scene.camera, masked_images, bounds_m, layout, config.hull_min_mask_fraction
        )
    # What Broyden's search finds, the warp grid and one Newton step find too, in a fraction of the time.
    render_method = "nearest" if config.inverse_skinning == "nearest" else "baked"
    if config.network == "frequency":
        trunk = PositionalMlp(LAYER_COUNT - 1, config.hidden_width, config.seed)
        return RadianceField(bounds_m, EMPTY_GRID_LAYOUT, config.hidden_width, config.seed, trunk, render_method)
    layout = hash_grid_layout(bounds_m, cell_m, config.levels, config.features, config.log2_rows)
    return RadianceField(bounds_m, layout, config.hidden_width, config.seed, None, render_method)


def dilate(mask: np.ndarray, radius_px: float) -> UInt8[np.ndarray, "h w"]:
    """The mask widened by a disc."""
    size = 2 * int(np.ceil(radius_px)) + 1
    return cv2.dilate(mask.astype(np.uint8), cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (size, size)))
