"""Settings of the radiance field that have no option of their own.

`FieldConfig` (`pipeline.field.config`) holds the options that users and product presets change. The values here are
constants of the method. From Python, `dataclasses.replace(FieldSettings(), huber_delta=0.05)` changes one. In YAML the
section `field.settings` changes them; the presets of published baselines (`data_tools/baselines`) use it.

Figures are means over validation frames (whole image / body pixels, PSNR in dB), from docs/decisions/field.md.
"""

from dataclasses import dataclass
from typing import Annotated, Literal

from pydantic import ConfigDict, Field, NonNegativeFloat, NonNegativeInt, PositiveFloat, PositiveInt

Fraction = Annotated[float, Field(ge=0, le=1)]
PositiveFraction = Annotated[float, Field(gt=0, le=1)]
DecayFactor = Annotated[float, Field(gt=0, lt=1)]
ClothingOffset = Annotated[float, Field(ge=0, le=0.6)]


@dataclass(frozen=True)
class FieldSettings:
    """Constants of network, sampling, occupancy grid, losses and optimiser.

    Raises:
        ValueError: two settings contradict each other; the message names both.
    """

    __pydantic_config__ = ConfigDict(extra="forbid", allow_inf_nan=False)

    network: Literal["hashgrid", "positional_mlp", "visual_hull"] = "hashgrid"
    """Representation of the field: multiresolution hash grid with one hidden layer (Instant-NGP), positional encoding
    with eight layers (NeRF), or a dense grid carved from the masks, without training."""
    inverse_skinning: Literal["baked", "broyden", "nearest"] = "baked"
    """Map from posed to canonical space: warp grids with one Newton step, Broyden's method for each sample
    (InstantAvatar), or the skinning of the nearest vertex (Anim-NeRF). Points found within 1 mm at bends of 0.12 rad:
    baked 0.996, Broyden 0.985."""
    levels: int = 5
    """Levels of the hash grid, 1 to 16. Six levels down to 1 px: 29.73 / 23.42 dB; five down to 2 px: 29.81 / 23.34 in
    half of the time."""
    features_per_level: Literal[1, 2, 4, 8] = 4
    """Features of a hash table row."""
    finest_cell_px: PositiveFloat = 2.0
    """Edge of the finest grid cell, in pixels at the depth of the body."""
    hidden_width: PositiveInt = 32
    """Units of the hidden layer(s)."""
    hull_min_mask_fraction: PositiveFraction = 0.9
    """Fraction of the frames whose mask must contain a point of the visual hull."""

    min_clothing_offset_m: ClothingOffset = 0.10
    """Smallest distance from the body surface within which clothing and hair are represented, m."""
    max_clothing_offset_m: ClothingOffset = 0.5
    """Largest such distance, used where masks extend far beyond the body, m. 0 keeps `min_clothing_offset_m`. A wide
    skirt: 21.05 / 13.78 dB with 0.1 m, 26.19 / 20.43 with the distance from the masks."""
    step_fraction: PositiveFraction = 0.01
    """Distance between samples of a ray, as a fraction of the body height."""

    frames_per_step: PositiveInt = 16
    """Training frames whose pixels a step samples."""
    pixel_jitter: bool = False
    """Rays through a random point of their pixel instead of its centre. Centres: +0.15 +- 0.07 dB (four captures)."""
    border_sampling_ratio: Fraction = 0.25
    """Fraction of the rays that pass near the mask border."""
    outside_sampling_ratio: Fraction = 0.1
    """Fraction of the rays outside the mask."""
    error_sampling_ratio: Fraction = 0.6
    """Fraction of the rays on the body that are drawn in proportion to the recent colour error: +0.18 / +0.25 dB."""
    outlier_threshold: PositiveFloat = 6.0
    """Colour error, as a multiple of the frame's median, above which a pixel shows a foreign object; its weight falls
    with the fourth power of the error. A ball before the person: 27.79 -> 32.91 dB."""
    border_px: PositiveInt = 4
    """Half width of the mask border, px."""

    occupancy: Literal["plain", "attention"] = "plain"
    """Update of the occupancy grid: moving maximum of the opacity (Instant-NGP), or voxel attention (IHM), whose
    weights multiply the density. Attention less plain: -0.13 +- 0.04 dB, haze -16 %, time +14 %."""
    occupancy_update_interval: PositiveInt = 8
    """Steps between updates of the occupancy grid."""
    occupancy_warmup_steps: NonNegativeInt = 64
    """First step after which a cell may become empty."""
    occupancy_threshold: Fraction = 0.03
    """Mean opacity of a ray step above which a cell is occupied. 0.01 leaves haze beside the person: SSIM 0.9682;
    0.03: 0.9691."""
    occupancy_decay: DecayFactor = 0.95
    """Factor of the moving average of the opacity at each update."""
    attention_learning_rate: PositiveFloat = 2e-2
    """Learning rate of the voxel attention network, at the start: that of the field's network."""
    initial_min_mask_fraction: Fraction = 0.6
    """Fraction of the frames whose mask must contain a cell outside the body for it to be occupied initially."""

    table_learning_rate: PositiveFloat = 1e-1
    """Learning rate of the hash table."""
    network_learning_rate: PositiveFloat = 2e-2
    """Learning rate of the network."""
    final_learning_rate_ratio: PositiveFraction = 0.05
    """Learning rates at the end, relative to those at the start."""
    huber_delta: PositiveFloat = 0.1
    """Error at which the Huber losses turn from quadratic to linear. 0.3: SSIM 0.9674, 0.1: 0.9699, 0.05: 0.9710, which
    costs 0.1 to 0.5 dB."""
    alpha_weight: NonNegativeFloat = 0.3
    """Weight of the alpha loss."""
    hard_surface_weight: NonNegativeFloat = 0.02
    """Weight of the hard-surface loss."""
    empty_density_weight: NonNegativeFloat = 0.05
    """Weight of the density loss at points that should be empty."""
    empty_points: NonNegativeInt = 2048
    """Points per step in the bounding box; those in empty cells enter the density loss."""
    unobserved_points: NonNegativeInt = 512
    """Points per step in unobserved cells, which enter the density loss. Captures from the front: 24.18 -> 25.49 dB."""

    pose_start_fraction: Fraction = 0.1
    """Fraction of the steps after which poses are refined."""
    pose_learning_rate: PositiveFloat = 2e-3
    """Learning rate of the joint rotations, rad; translations take a third of it, m. 0.001: 32.56 dB, 0.002: 32.72."""
    pose_correlation_time_s: NonNegativeFloat = 0.25
    """Time over which gradients of the poses are averaged, s; 0: each frame has its own. Real turn, with 16 instead of
    8 frames a step: 31.96 -> 32.56 dB."""
    pose_smoothness_weight: NonNegativeFloat = 0.02
    """Weight of the squared change of pose corrections between frames."""
    pose_l2_weight: NonNegativeFloat = 0.002
    """Weight of the squared pose corrections."""

    def __post_init__(self) -> None:
        if self.border_sampling_ratio + self.outside_sampling_ratio > 1:
            raise ValueError("border_sampling_ratio + outside_sampling_ratio must not exceed 1")
        if 0 < self.max_clothing_offset_m < self.min_clothing_offset_m:
            raise ValueError("max_clothing_offset_m must be 0 or at least min_clothing_offset_m")
        if not 1 <= self.levels <= 16:
            raise ValueError("levels must be from 1 to 16")
