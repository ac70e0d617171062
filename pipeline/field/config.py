"""Options of the field stage that users and product presets change."""

import difflib
from collections.abc import Mapping
from dataclasses import fields
from typing import Any

from pydantic import Field, field_validator

from pipeline.core.config import Config
from pipeline.core.device import DeviceChoice
from pipeline.field.settings import FieldSettings


class FieldConfig(Config):
    """Options of the training of the canonical radiance field.

    `settings` is not listed in configs/default.yaml: only smoke.yaml and the presets of published baselines set it.
    """

    seed: int = Field(0, ge=0, lt=1 << 63, description="seed of all random numbers")
    device: DeviceChoice = Field("auto", description="device of the training: auto uses a CUDA GPU if there is one")
    steps: int = Field(750, ge=0, le=200_000, description="training steps")
    rays_per_step: int = Field(4096, ge=64, le=1 << 18, description="rays per training step")
    max_frames: int = Field(
        120, ge=2, description="training frames used, evenly spaced over the recording; about 3 MB of memory each"
    )
    max_person_px: int = Field(
        640, ge=32, description="images are downscaled until the person is at most this tall, px"
    )
    log2_hashmap_size: int = Field(17, ge=8, le=24, description="log2 of the largest number of rows of a hash table")
    pose_refinement: bool = Field(True, description="refine the fitted poses during the training")
    validation_frames: int = Field(4, ge=0, description="validation frames rendered to measure the PSNR of the field")
    settings: FieldSettings = Field(
        FieldSettings(), description="constants of the method, see pipeline/field/settings.py"
    )

    @field_validator("settings", mode="before")
    @classmethod
    def _check_setting_names(cls, value: Any) -> Any:
        known = [setting.name for setting in fields(FieldSettings)]
        for name in value if isinstance(value, Mapping) else ():
            if name not in known:
                close = difflib.get_close_matches(str(name), known, n=1)
                hint = f"did you mean {close[0]}? " if close else ""
                raise ValueError(f"a mapping of known settings; {name} is not one ({hint}known: {', '.join(known)})")
        return value
