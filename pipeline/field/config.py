"""Options of stage one, with the meaning and unit of each."""

from typing import Literal

from pydantic import Field as Option
from pydantic import model_validator

from pipeline.core.config import Config
from pipeline.core.device import DeviceChoice


class FieldConfig(Config):
    """What steers the learning of the canonical field."""

    seed: int = Option(0, ge=0, description="seed of all random draws")
    device: DeviceChoice = Option(
        "auto", description="where the field learns: auto takes a CUDA graphics card where there is one"
    )
    steps: int = Option(750, ge=0, le=200_000, description="training steps")
    rays: int = Option(4096, ge=64, le=1 << 18, description="rays a step")
    frames_per_step: int = Option(8, ge=1, le=64, description="frames that a step's rays come from")
    max_frames: int = Option(120, ge=2, description="training frames kept, evenly spread; each holds about 3 MB")
    max_person_px: int = Option(
        640, ge=32, description="images are scaled down until the person is at most this tall, px"
    )

    network: Literal["hashgrid", "frequency", "hull"] = Option(
        "hashgrid", description="hash grid and one layer; sines and eight layers; or a dense grid carved from the masks"
    )
    inverse_skinning: Literal["baked", "broyden", "nearest"] = Option(
        "baked", description="from posed to canonical: warp grids, a search for every sample, or the nearest vertex"
    )
    levels: int = Option(5, ge=1, le=16, description="levels of the hash grid")
    features: Literal[1, 2, 4, 8] = Option(4, description="features a level")
    log2_rows: int = Option(17, ge=8, le=24, description="log2 of the most rows a level may have")
    finest_cell_px: float = Option(2.0, gt=0, description="finest cell of the grid, in pixels at the body's depth")
    hidden_width: int = Option(32, ge=8, le=512, description="width of the hidden layer")

    hull_min_mask_fraction: float = Option(
        0.9, gt=0, le=1, description="part of the frames whose mask must hold a point of a hull"
    )

    min_clothing_offset_m: float = Option(
        0.10, gt=0, le=0.6, description="how far clothing and hair may stand off the fitted body at least, m"
    )
    max_clothing_offset_m: float = Option(
        0.5, ge=0, le=0.6, description="the same at most, where the masks reach far beyond the body, m; 0: never wider"
    )
    step_fraction: float = Option(0.01, gt=0, le=0.1, description="ray step, as a part of the body's height")
    pixel_jitter: bool = Option(False, description="rays start anywhere in their pixel instead of its centre")
    border_sampling_ratio: float = Option(0.25, ge=0, le=1, description="part of the rays along the mask's border")
    outside_sampling_ratio: float = Option(0.1, ge=0, le=1, description="part of the rays outside the mask")
    error_sampling_ratio: float = Option(
        0.6, ge=0, le=1, description="of the rays on the body, the part that is drawn where colours erred most of late"
    )
    outlier_threshold: float = Option(
        6.0,
        gt=0,
        description="colour error, in medians of its frame's, from which on a pixel is no longer taken for the person; "
        "its weight falls with the fourth power of the error",
    )
    border_px: int = Option(4, ge=1, description="half width of the border, px")

    occupancy: Literal["attention", "plain"] = Option(
        "plain", description="how the occupancy grid is updated: by voxel attention (IHM) or by the mean opacity alone"
    )
    occupancy_update_interval: int = Option(8, ge=1, description="steps between updates of the occupancy grid")
    occupancy_warmup_steps: int = Option(64, ge=0, description="step of the first update that may empty a cell")
    occupancy_threshold: float = Option(
        0.03, ge=0, le=1, description="mean opacity of a step above which a cell is occupied"
    )
    occupancy_decay: float = Option(
        0.95, gt=0, lt=1, description="moving average of the occupancy, part kept an update"
    )
    attention_learning_rate: float = Option(3e-3, gt=0, description="learning rate of the voxel attention")
    initial_min_mask_fraction: float = Option(
        0.6, ge=0, le=1, description="part of the frames whose mask must hold a cell, at the start"
    )

    table_learning_rate: float = Option(1e-1, gt=0, description="learning rate of the hash table")
    network_learning_rate: float = Option(2e-2, gt=0, description="learning rate of the network")
    final_learning_rate_ratio: float = Option(
        0.05, gt=0, le=1, description="learning rates at the end, as a part of those at the start"
    )
    huber_delta: float = Option(0.1, gt=0, description="colour error where the Huber loss turns from square to linear")
    alpha_weight: float = Option(0.3, ge=0, description="weight of the alpha loss")
    hard_surface_weight: float = Option(0.02, ge=0, description="weight of the hard-surface loss")
    empty_density_weight: float = Option(0.05, ge=0, description="weight of the density loss in empty cells")
    empty_points: int = Option(2048, ge=0, description="points a step at which emptiness is asked for")
    unobserved_points: int = Option(
        512,
        ge=0,
        description="points a step at which emptiness is asked for off the body, where no light comes or only one side "
        "is ever filmed",
    )

    pose_refinement: bool = Option(True, description="learn small corrections of the poses")
    pose_start_fraction: float = Option(0.1, ge=0, le=1, description="part of the steps after which poses are refined")
    pose_learning_rate: float = Option(
        1e-3, gt=0, description="learning rate of the poses, rad (shifts: a third of it, m)"
    )
    pose_smoothness_weight: float = Option(
        0.02, ge=0, description="weight of the change of corrections from frame to frame"
    )
    pose_l2_weight: float = Option(0.002, ge=0, description="weight of the size of corrections")
    validation_frames: int = Option(4, ge=0, description="validation frames that are rendered to judge the result")
    early_stop: bool = Option(
        True, description="end before all steps are made, once validation frames gain no more than noise"
    )

    @model_validator(mode="after")
    def _check_sampling_ratios(self) -> "FieldConfig":
        if self.border_sampling_ratio + self.outside_sampling_ratio > 1:
            raise ValueError("share_border and share_outside are together at most 1")
        return self
