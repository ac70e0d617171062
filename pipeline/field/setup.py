"""Set up the training of a field from a fitted body, the camera and the training images."""

from collections.abc import Sequence
from dataclasses import dataclass

import cv2
import numpy as np
import torch
from jaxtyping import Bool, Float, UInt8
from torch import Tensor

from pipeline.body.body import Body, Motion, canonical_to_world
from pipeline.capture.frame_selection import evenly_spaced
from pipeline.core.device import CPU
from pipeline.field.baselines.positional_mlp import LAYER_COUNT, PositionalMlp
from pipeline.field.baselines.visual_hull import carve_visual_hull, dense_layout
from pipeline.field.baselines.voxel_attention import AttentionOccupancyGrid
from pipeline.field.config import FieldConfig
from pipeline.field.field import EMPTY_GRID_LAYOUT, RadianceField, hash_grid_layout
from pipeline.field.initial_occupancy import (
    cell_signed_distances_m,
    estimate_clothing_offset_m,
    field_bounds_m,
    initial_occupancy,
    observed_from_one_side,
    project_mask_fraction,
    skirt_reach_m,
)
from pipeline.field.occupancy import CellData, OccupancyGrid, cell_centres
from pipeline.field.pixel_sampler import build_pixel_pool
from pipeline.field.settings import FieldSettings
from pipeline.field.skin_grid import build_skin_grid, skin_margin_m
from pipeline.field.trainer import Trainer, TrainingScene
from pipeline.geometry.camera import Camera, transform_world_to_camera
from pipeline.kernels.inverse_skinning import SkinGrid

MASK_FRAMES = 32
"""Training frames whose masks determine the clothing offset and the initial occupancy."""

MaskedImage = tuple[UInt8[np.ndarray, "h w 3"], UInt8[np.ndarray, "h w"]]
"""RGB image and mask of a frame, both in 0..255."""


@dataclass(frozen=True)
class MaskedPoses:
    """Poses (k, j, 4, 4) of some frames, the camera, and a mask of each frame."""

    canonical_to_world: Float[Tensor, "k j 4 4"]
    camera: Camera
    masks: list[Bool[np.ndarray, "h w"]]


def median_root_depth_m(motion: Motion, camera: Camera) -> float:
    """Return the median depth of the root joint over all frames, m."""
    roots = transform_world_to_camera(torch.as_tensor(motion.root_translation_m), camera)
    return float(roots[:, 2].median())


def training_scale(body: Body, motion: Motion, camera: Camera, max_person_px: int) -> float:
    """Return the scale of the images, at most 1, at which the A-pose body is at most `max_person_px` tall."""
    person_px = body.height_m() * camera.fy / median_root_depth_m(motion, camera)
    return min(1.0, max_person_px / person_px)


def create_trainer(
    body: Body,
    motion: Motion,
    camera: Camera,
    masked_images: Sequence[MaskedImage],
    config: FieldConfig,
    device: torch.device = CPU,
) -> Trainer:
    """Derive bounds, hash grid levels and initial occupancy from the data, and create the trainer on `device`.

    masked_images: image and mask of each frame of `motion`, at the size of `camera`.
    """
    settings = config.settings
    rows = evenly_spaced(len(masked_images), MASK_FRAMES)
    masks = [masked_images[row][1] >= 128 for row in rows]
    posed_masks = MaskedPoses(canonical_to_world(body, motion.select(rows)), camera, masks)
    clothing_offset_m = find_clothing_offset_m(body, posed_masks, settings)
    bounds_m = field_bounds_m(body, clothing_offset_m)
    skin = build_skin_grid(body, skin_margin_m(body, bounds_m))
    pixel_m = median_root_depth_m(motion, camera) / camera.fy
    cells = initial_cells(
        body, skin, posed_masks, clothing_offset_m, pixel_m, min_mask_fraction=settings.initial_min_mask_fraction
    )
    occupancy = create_occupancy_grid(cells, clothing_offset_m, config, device)
    pool = build_pixel_pool(masked_images, settings.border_px, config.seed)
    scene = TrainingScene(body, motion, camera, pool, skin)
    field = initial_field(scene, masked_images, bounds_m, pixel_m, config).to(device)
    return Trainer(scene, field, occupancy, config)


def find_clothing_offset_m(body: Body, posed_masks: MaskedPoses, settings: FieldSettings) -> float:
    """Return the largest distance of clothing from the body, m, within the range of the settings."""
    of_masks = posed_masks.canonical_to_world, posed_masks.camera, posed_masks.masks
    largest_m = settings.max_clothing_offset_m
    reach_m = skirt_reach_m(body, *of_masks, largest_m, settings.initial_min_mask_fraction)
    if reach_m is None:
        return estimate_clothing_offset_m(body, *of_masks, settings.min_clothing_offset_m, largest_m)
    return max(settings.min_clothing_offset_m, reach_m)


def initial_cells(
    body: Body,
    skin: SkinGrid,
    posed_masks: MaskedPoses,
    clothing_offset_m: float,
    pixel_m: float,
    min_mask_fraction: float,
) -> CellData:
    """Compute the properties of all occupancy cells from the body and the masks.

    pixel_m: footprint of a pixel at the depth of the body, m. min_mask_fraction: see `initial_occupancy`.
    """
    bounds_m = field_bounds_m(body, clothing_offset_m)
    distance_m = cell_signed_distances_m(body, bounds_m, clothing_offset_m)
    near = distance_m < clothing_offset_m
    mask_fraction, one_sided = np.zeros(near.shape, dtype=np.float32), np.zeros(near.shape, dtype=bool)
    centres_m = cell_centres(bounds_m)[near.reshape(-1)]
    weights = skin.interpolate_weights(torch.from_numpy(centres_m))
    poses, camera = posed_masks.canonical_to_world, posed_masks.camera
    one_sided[near] = observed_from_one_side(body.joints_m, weights, poses, camera)
    cell_radius_px = 0.5 * float((bounds_m[1] - bounds_m[0]).max()) / distance_m.shape[0] / pixel_m
    dilated = [dilate(mask, cell_radius_px) for mask in posed_masks.masks]
    mask_fraction[near] = project_mask_fraction(centres_m, distance_m[near], weights, poses, camera, dilated)
    occupied = initial_occupancy(distance_m, mask_fraction, clothing_offset_m, min_mask_fraction)
    return CellData(occupied, distance_m, mask_fraction, one_sided, bounds_m)


def create_occupancy_grid(
    cells: CellData, clothing_offset_m: float, config: FieldConfig, device: torch.device
) -> OccupancyGrid:
    """Create the occupancy grid with the update rule of the settings."""
    settings = config.settings
    if settings.occupancy == "plain":
        return OccupancyGrid(cells, settings.occupancy_decay, settings.occupancy_threshold, device)
    return AttentionOccupancyGrid(
        cells,
        settings.occupancy_decay,
        settings.occupancy_threshold,
        clothing_offset_m,
        config.seed,
        device,
    )


def initial_field(
    scene: TrainingScene,
    masked_images: Sequence[MaskedImage],
    bounds_m: Float[np.ndarray, "2 3"],
    pixel_m: float,
    config: FieldConfig,
) -> RadianceField:
    """Create the field before training: uniform low density, or a visual hull.

    pixel_m: footprint of a pixel at the depth of the body, m.
    """
    settings = config.settings
    cell_m = pixel_m * settings.finest_cell_px
    if settings.network == "visual_hull":
        poses = canonical_to_world(scene.body, scene.motion)
        layout = dense_layout(bounds_m, cell_m, config.log2_hashmap_size)
        fraction = settings.hull_min_mask_fraction
        return carve_visual_hull(scene.body, scene.skin, poses, scene.camera, masked_images, bounds_m, layout, fraction)
    # For renders, warp grids with a Newton step replace Broyden's method: same points in a fraction of the time.
    render_method = "nearest" if settings.inverse_skinning == "nearest" else "baked"
    if settings.network == "positional_mlp":
        trunk = PositionalMlp(LAYER_COUNT - 1, settings.hidden_width, config.seed)
        return RadianceField(bounds_m, EMPTY_GRID_LAYOUT, settings.hidden_width, config.seed, trunk, render_method)
    layout = hash_grid_layout(bounds_m, cell_m, settings.levels, settings.features_per_level, config.log2_hashmap_size)
    return RadianceField(bounds_m, layout, settings.hidden_width, config.seed, None, render_method)


def dilate(mask: np.ndarray, radius_px: float) -> UInt8[np.ndarray, "h w"]:
    """Dilate a mask by a disc of `radius_px`, rounded up."""
    size = 2 * int(np.ceil(radius_px)) + 1
    return cv2.dilate(mask.astype(np.uint8), cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (size, size)))
