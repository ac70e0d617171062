"""Validation frames, and the PSNR of a field on them."""

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from jaxtyping import UInt8

from pipeline.body.body import Motion, canonical_to_world
from pipeline.field.rendering import PoseWarps, build_pose_warps, render_pose
from pipeline.field.setup import MaskedImage
from pipeline.field.trainer import Trainer
from pipeline.geometry.camera import Camera
from pipeline.metrics.images import (
    composite_on_white,
    composite_premultiplied_on_white,
    foreground_mask,
    psnr_db,
    validation_psnr_db,
)

SUBSAMPLING_STRIDE = 5
"""Odd, so that the pixel centres of the subsampled image are pixel centres of the full one."""


@dataclass(frozen=True)
class Validator:
    """Images of validation frames, their camera, and their poses as fitted by the body stage."""

    motion: Motion
    camera: Camera
    ground_truth: Sequence[MaskedImage]

    @cached_property
    def targets(self) -> list[UInt8[np.ndarray, "h w 3"]]:
        """The images composited on white."""
        return [composite_on_white(*truth) for truth in self.ground_truth]

    def subsampled(self) -> "Validator":
        """Keep every fifth row and column of the images: an unbiased estimate of the error at 1/25 of the time."""
        cropped_px = (
            self.camera.width // SUBSAMPLING_STRIDE * SUBSAMPLING_STRIDE,
            self.camera.height // SUBSAMPLING_STRIDE * SUBSAMPLING_STRIDE,
        )
        camera = self.camera.cropped(0, 0, *cropped_px).scaled(1 / SUBSAMPLING_STRIDE)
        centres = tuple(slice(SUBSAMPLING_STRIDE // 2, side, SUBSAMPLING_STRIDE) for side in reversed(cropped_px))
        return Validator(self.motion, camera, [(image[centres], mask[centres]) for image, mask in self.ground_truth])

    def pose_warps(self, trainer: Trainer, refined: bool) -> PoseWarps:
        """Return the poses of the frames, ready to be rendered. There must be at least one frame.

        refined: add the pose corrections of the training frames, interpolated in time.
        """
        motion = trainer.poses.apply(self.motion) if refined else self.motion
        body, skin = trainer.scene.body, trainer.inverse_skinning.full_skin
        return build_pose_warps(trainer.field, body, skin, canonical_to_world(body, motion))

    def render(self, trainer: Trainer, poses: PoseWarps) -> list[UInt8[np.ndarray, "h w 3"]]:
        """Render all frames on white with the present field, in poses from `pose_warps`."""
        field, grid = trainer.field, trainer.occupancy.binary()
        renders = [render_pose(field, grid, poses, row, self.camera) for row in range(len(self.ground_truth))]
        return [composite_premultiplied_on_white(render.numpy()) for render in renders]

    def mean_psnr_db(self, renders: Sequence[UInt8[np.ndarray, "h w 3"]]) -> tuple[float, float]:
        """Return the mean PSNR (dB) of whole images on white and of body pixels; NaN without frames or body pixels."""
        body_masks = [foreground_mask(mask) for _, mask in self.ground_truth]
        return validation_psnr_db(renders, self.targets), validation_psnr_db(renders, self.targets, body_masks)

    def psnr_per_frame_db(self, renders: Sequence[UInt8[np.ndarray, "h w 3"]]) -> list[float]:
        """Return the PSNR (dB) of each whole image on white."""
        return [psnr_db(*pair) for pair in zip(renders, self.targets, strict=True)]
