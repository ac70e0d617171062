"""From a fitted body and the pictures to a field that is ready to learn."""

from collections.abc import Sequence

import cv2
import numpy as np
import torch
from jaxtyping import Float, UInt8

from pipeline.body.body import Body, Motion, canonical_to_world
from pipeline.core.device import CPU
from pipeline.field.config import FieldConfig
from pipeline.field.field import NO_GRID, Field, choose_layout
from pipeline.field.initial_occupancy import (
    cell_distances_m,
    clothing_margin_m,
    field_bounds_m,
    filmed_from_one_side,
    mask_frequency,
    starting_shell,
)
from pipeline.field.occupancy import OccupancyUpdate, cell_centres
from pipeline.field.pixel_sampler import build_pool
from pipeline.field.positional_mlp import LAYERS, FrequencyTrunk
from pipeline.field.skin_grid import build_skin_grid, skin_margin_m
from pipeline.field.trainer import Learning, Scene
from pipeline.field.visual_hull import carve, dense_layout
from pipeline.geometry.camera import Camera, world_to_camera_points

SUPPORT_FRAMES = 32
"""Frames that are asked which cells their masks hold."""

Picture = tuple[UInt8[np.ndarray, "h w 3"], UInt8[np.ndarray, "h w"]]


def body_depth_m(motion: Motion, camera: Camera) -> float:
    """Median depth of the body's root before the camera."""
    roots = world_to_camera_points(torch.as_tensor(motion.root_translation_m), camera)
    return float(roots[:, 2].median())


def training_scale(body: Body, motion: Motion, camera: Camera, max_person_px: int) -> float:
    """Factor by which images shrink so that the standing person is at most `max_person_px` tall; at most 1."""
    person_px = body.height_m() * camera.fy / body_depth_m(motion, camera)
    return min(1.0, max_person_px / person_px)


def spread(count: int, limit: int) -> np.ndarray:
    """At most `limit` of the positions 0..count-1, evenly spread."""
    return np.unique(np.linspace(0, count - 1, min(count, limit)).round().astype(np.int64))


def start_learning(
    body: Body,
    motion: Motion,
    camera: Camera,
    pictures: Sequence[Picture],
    config: FieldConfig,
    device: torch.device = CPU,
) -> Learning:
    """Choose box, grid levels and starting cells from the data, and set everything up; what learns lies on `device`.

    pictures: image and mask of each frame of `motion`, for `camera`.
    """
    rows = spread(len(pictures), SUPPORT_FRAMES)
    poses, masks = canonical_to_world(body, motion.select(rows)), [pictures[row][1] >= 128 for row in rows]
    margin_m = clothing_margin_m(body, poses, camera, masks, config.margin_m, config.widest_margin_m)
    bounds_m = field_bounds_m(body, margin_m)
    skin = build_skin_grid(body, skin_margin_m(body, bounds_m))
    pixel_m = body_depth_m(motion, camera) / camera.fy
    distance_m = cell_distances_m(body, bounds_m, margin_m)
    near = distance_m < margin_m
    frequency, one_sided = np.zeros(near.shape, dtype=np.float32), np.zeros(near.shape, dtype=bool)
    centres_m = cell_centres(bounds_m)[near.reshape(-1)]
    weights = skin.weights_at(torch.from_numpy(centres_m))
    one_sided[near] = filmed_from_one_side(body.joints_m, weights, poses, camera)
    cell_px = 0.5 * float((bounds_m[1] - bounds_m[0]).max()) / distance_m.shape[0] / pixel_m
    frequency[near] = mask_frequency(
        centres_m,
        distance_m[near],
        weights,
        poses,
        camera,
        [dilate(mask, cell_px) for mask in masks],
    )
    occupancy = OccupancyUpdate(
        starting_shell(distance_m, frequency, margin_m, config.mask_support),
        distance_m,
        frequency,
        one_sided,
        bounds_m,
        margin_m=margin_m,
        attention=config.occupancy == "attention",
        learning_rate=config.attention_rate,
        decay=config.occupancy_decay,
        threshold=config.occupancy_threshold,
        seed=config.seed,
        device=device,
    )
    pool = build_pool(pictures, config.border_px, config.seed)
    scene = Scene(body, motion, camera, pool, skin)
    field = first_field(scene, pictures, bounds_m, pixel_m, config).to(device)
    return Learning(scene, field, occupancy, config)


def first_field(
    scene: Scene,
    pictures: Sequence[Picture],
    bounds_m: Float[np.ndarray, "2 3"],
    pixel_m: float,
    config: FieldConfig,
) -> Field:
    """The field as it is before training: thin fog, or a hull carved from the masks. pixel_m: what a pixel covers."""
    cell_m = pixel_m * config.finest_cell_px
    if config.network == "hull":
        poses = canonical_to_world(scene.body, scene.motion)
        layout = dense_layout(bounds_m, cell_m, config.log2_rows)
        return carve(scene.body, scene.skin, poses, scene.camera, pictures, bounds_m, layout, config.hull_votes)
    # What Broyden's search finds, the warp grid and one Newton step find too, in a fraction of the time.
    shown_by = "nearest" if config.inverse_skinning == "nearest" else "baked"
    if config.network == "frequency":
        trunk = FrequencyTrunk(LAYERS - 1, config.hidden_width, config.seed)
        return Field(bounds_m, NO_GRID, config.hidden_width, config.seed, trunk, shown_by)
    layout = choose_layout(bounds_m, cell_m, config.levels, config.features, config.log2_rows)
    return Field(bounds_m, layout, config.hidden_width, config.seed, None, shown_by)


def dilate(mask: np.ndarray, radius_px: float) -> UInt8[np.ndarray, "h w"]:
    """The mask widened by a disc."""
    size = 2 * int(np.ceil(radius_px)) + 1
    return cv2.dilate(mask.astype(np.uint8), cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (size, size)))
