"""Frames that are kept back from the learning, and the scores of a field on them."""

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from jaxtyping import UInt8

from pipeline.body.body import Motion, canonical_to_world
from pipeline.field.rendering import Poses, render_pose, undo_poses
from pipeline.field.setup import Picture
from pipeline.field.trainer import Learning
from pipeline.geometry.camera import Camera
from pipeline.metrics.images import body_pixels, on_white, premultiplied_on_white, psnr_db

THINNING = 5
"""Odd, so that the centre of a thinned picture's pixel is the centre of a pixel."""


@dataclass(frozen=True)
class Judge:
    """Pictures of some frames for one camera, and the poses that the body stage gave them."""

    motion: Motion
    camera: Camera
    truths: Sequence[Picture]

    @cached_property
    def targets(self) -> list[UInt8[np.ndarray, "h w 3"]]:
        """The pictures on white, as a render without error would be."""
        return [on_white(*truth) for truth in self.truths]

    def thinned(self) -> "Judge":
        """Every fifth row and column of the pictures: an unbiased estimate of their errors at a 25th of the cost."""
        whole = self.camera.width // THINNING * THINNING, self.camera.height // THINNING * THINNING
        camera = self.camera.cropped(0, 0, *whole).scaled(1 / THINNING)
        kept = tuple(slice(THINNING // 2, side, THINNING) for side in reversed(whole))
        return Judge(self.motion, camera, [(image[kept], mask[kept]) for image, mask in self.truths])

    def pose(self, learning: Learning, refined: bool) -> Poses:
        """The frames' poses, at least one, ready to be rendered; `refined` ones come by interpolation in time from the
        learnt ones.
        """
        motion = learning.poses.corrected(self.motion) if refined else self.motion
        scene = learning.scene
        return undo_poses(learning.field, scene.body, scene.skin, canonical_to_world(scene.body, motion))

    def render(self, learning: Learning, poses: Poses) -> list[UInt8[np.ndarray, "h w 3"]]:
        """Pictures on white of all frames as the field is now, in the poses that `pose` gave."""
        field, grid = learning.field, learning.occupancy.grid()
        renders = [render_pose(field, grid, poses, row, self.camera) for row in range(len(self.truths))]
        return [premultiplied_on_white(render.numpy()) for render in renders]

    def score(self, renders: Sequence[UInt8[np.ndarray, "h w 3"]]) -> tuple[float, float]:
        """Mean decibels of whole images on white, and of body pixels alone; NaN where there is nothing to score."""
        bodies = [body_pixels(mask) for _, mask in self.truths]
        looks = zip(renders, self.targets, bodies, strict=True)
        body = [psnr_db(render, target, where) for render, target, where in looks if where.any()]
        return _mean(self.frame_scores(renders)), _mean(body)

    def frame_scores(self, renders: Sequence[UInt8[np.ndarray, "h w 3"]]) -> list[float]:
        """Decibels of each whole image on white."""
        return [psnr_db(*pair) for pair in zip(renders, self.targets, strict=True)]


def _mean(values: list[float]) -> float:
    return float(np.mean(values)) if values else float("nan")
