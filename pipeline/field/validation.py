"""Frames that are kept back from the learning, and the scores of a field on them."""

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
"""Odd, so that the centre of a thinned picture's pixel is the centre of a pixel."""


@dataclass(frozen=True)
class Validator:
    """Pictures of some frames for one camera, and the poses that the body stage gave them."""

    motion: Motion
    camera: Camera
    ground_truth: Sequence[MaskedImage]

    @cached_property
    def targets(self) -> list[UInt8[np.ndarray, "h w 3"]]:
        """The pictures on white, as a render without error would be."""
        return [composite_on_white(*truth) for truth in self.ground_truth]

    def subsampled(self) -> "Validator":
        """Every fifth row and column of the pictures: an unbiased estimate of their errors at a 25th of the cost."""
        whole = (
            self.camera.width // SUBSAMPLING_STRIDE * SUBSAMPLING_STRIDE,
            self.camera.height // SUBSAMPLING_STRIDE * SUBSAMPLING_STRIDE,
        )
        camera = self.camera.cropped(0, 0, *whole).scaled(1 / SUBSAMPLING_STRIDE)
        kept = tuple(slice(SUBSAMPLING_STRIDE // 2, side, SUBSAMPLING_STRIDE) for side in reversed(whole))
        return Validator(self.motion, camera, [(image[kept], mask[kept]) for image, mask in self.ground_truth])

    def pose(self, trainer: Trainer, refined: bool) -> PoseWarps:
        """The frames' poses, at least one, ready to be rendered; `refined` ones come by interpolation in time from the
        learnt ones.
        """
        motion = trainer.poses.corrected(self.motion) if refined else self.motion
        scene = trainer.scene
        return build_pose_warps(trainer.field, scene.body, scene.skin, canonical_to_world(scene.body, motion))

    def render(self, trainer: Trainer, poses: PoseWarps) -> list[UInt8[np.ndarray, "h w 3"]]:
        """Pictures on white of all frames as the field is now, in the poses that `pose` gave."""
        field, grid = trainer.field, trainer.occupancy.grid()
        renders = [render_pose(field, grid, poses, row, self.camera) for row in range(len(self.ground_truth))]
        return [composite_premultiplied_on_white(render.numpy()) for render in renders]

    def score(self, renders: Sequence[UInt8[np.ndarray, "h w 3"]]) -> tuple[float, float]:
        """Mean decibels of whole images on white, and of body pixels alone; NaN where there is nothing to score."""
        body_masks = [foreground_mask(mask) for _, mask in self.ground_truth]
        return validation_psnr_db(renders, self.targets), validation_psnr_db(renders, self.targets, body_masks)

    def psnr_per_frame_db(self, renders: Sequence[UInt8[np.ndarray, "h w 3"]]) -> list[float]:
        """Decibels of each whole image on white."""
        return [psnr_db(*pair) for pair in zip(renders, self.targets, strict=True)]
