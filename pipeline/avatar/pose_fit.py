"""Poses fitted to pictures through the finished avatar: what a score says once the pose is no longer in question.

The avatar stays as it is; a turn of every main joint and a shift of the root are moved by gradient descent through the
differentiable rasteriser until the textured mesh looks like the frame. Whoever scores a frame after this has fitted the
pose to the very pixels that are scored, and must say so.
"""

import math
from collections.abc import Sequence

import torch
from jaxtyping import Float, Int
from torch import Tensor

from pipeline.avatar.textured_avatar import TexturedAvatar
from pipeline.body.body import Body, Motion
from pipeline.body.pose_correction import PoseCorrection
from pipeline.core.progress import track
from pipeline.geometry.differentiable_raster import face_adjacency, render_shaded
from pipeline.geometry.texture_rendering import sample_texture
from pipeline.mesh.views import PosedView, view_losses

MAX_PERSON_PX = 320
"""Height of the person in the pictures that are fitted: poses need no finer ones, and time goes with the pixels."""

ROTATION_LEARNING_RATE_RAD, TRANSLATION_LEARNING_RATE_M = 0.008, 0.004
BACKGROUND = 0.5
PRIOR_WEIGHT = 0.02
"""Of the squared corrections: joints that the picture does not show stay where they were."""

MAX_TEXTURE_PX = 512
"""The map is reduced to this side, so that a texel is no smaller than a pixel and colours lead from afar."""


def fit_poses(avatar: TexturedAvatar, body: Body, motion: Motion, views: Sequence[PosedView], steps: int) -> Motion:
    """The motion with each frame's pose fitted to its view; frames do not influence each other.

    Args:
        motion: where the fit starts, in time order. views: a crop of each of its frames, see `crop_posed_view`; the
        poses in
            them are not read. steps: of Adam, its rate falling to zero as a cosine.
    """
    correction = PoseCorrection(body, motion)
    renderer = _AvatarRenderer(avatar)
    optimiser = torch.optim.Adam(
        [
            {"params": [correction.rotation_rad], "lr": ROTATION_LEARNING_RATE_RAD},
            {"params": [correction.shift_m], "lr": TRANSLATION_LEARNING_RATE_M},
        ],
        betas=(0.9, 0.99),
    )
    schedule = torch.optim.lr_scheduler.LambdaLR(optimiser, lambda step: 0.5 * (1.0 + math.cos(math.pi * step / steps)))
    for _ in track(range(steps), "fit of held-out poses"):
        optimiser.zero_grad()
        (PRIOR_WEIGHT * len(views) * correction.size()).backward()
        for row, view in enumerate(views):
            _image_loss(renderer, correction.canonical_to_world(torch.tensor([row]))[0], view).backward()
        optimiser.step()
        schedule.step()
    return correction.corrected(motion)


def _image_loss(
    renderer: "_AvatarRenderer", canonical_to_world: Float[Tensor, "j 4 4"], view: PosedView
) -> Float[Tensor, ""]:
    """Colour before grey, and silhouette."""
    colour_loss, silhouette_loss = view_losses(*renderer(canonical_to_world, view), view, torch.full((3,), BACKGROUND))
    return colour_loss + silhouette_loss


class _AvatarRenderer:
    """The avatar with its map reduced, ready to be rasterised: one vertex a corner of the atlas."""

    def __init__(self, avatar: TexturedAvatar) -> None:
        self._avatar = avatar
        self._vertex_of_uv: Int[Tensor, "t"] = torch.zeros(len(avatar.uv), dtype=torch.long)
        self._vertex_of_uv[avatar.faces_uv.long().reshape(-1)] = avatar.faces.long().reshape(-1)
        self._adjacency = face_adjacency(avatar.faces)
        pooling_factor = max(1, len(avatar.diffuse) // MAX_TEXTURE_PX)
        self._diffuse = torch.nn.functional.avg_pool2d(avatar.diffuse.permute(2, 0, 1), pooling_factor).permute(1, 2, 0)

    def __call__(
        self, canonical_to_world: Float[Tensor, "j 4 4"], view: PosedView
    ) -> tuple[Float[Tensor, "h w 3"], Float[Tensor, "h w"]]:
        """Premultiplied colours and alpha, differentiable in the pose."""
        corners = self._avatar.pose_vertices(canonical_to_world)[self._vertex_of_uv]
        avatar = self._avatar
        image, alpha, _ = render_shaded(
            corners,
            avatar.faces_uv,
            view.camera,
            avatar.uv,
            lambda uv: sample_texture(self._diffuse, uv),
            self._adjacency,
        )
        return image, alpha
