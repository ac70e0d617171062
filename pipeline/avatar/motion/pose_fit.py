"""Fit poses to images through the textured avatar, to separate pose errors from errors of the avatar.

The avatar is fixed. A rotation of every main joint and a translation of the root are optimised with Adam through the
differentiable rasteriser, so that the rendered mesh matches the frame. A score after this fit uses poses fitted to the
scored pixels; reports must state this.
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
from pipeline.geometry.colour import linear_to_srgb, srgb_to_linear
from pipeline.geometry.differentiable_raster import face_adjacency, render_shaded
from pipeline.geometry.texture_rendering import sample_texture
from pipeline.mesh.views import PosedView, view_losses

MAX_PERSON_PX = 320
"""Largest height of the person in the fitted images, px: higher resolution costs time and does not improve poses."""

ROTATION_LEARNING_RATE_RAD, TRANSLATION_LEARNING_RATE_M = 0.008, 0.004
BACKGROUND = 0.5
PRIOR_WEIGHT = 0.02
"""Weight of the squared corrections: joints that the image does not constrain keep their pose."""

MAX_TEXTURE_PX = 512
"""Side to which the diffuse map is downsampled: smooth gradients over larger displacements."""


def fit_poses(avatar: TexturedAvatar, body: Body, motion: Motion, views: Sequence[PosedView], steps: int) -> Motion:
    """Return the motion with the pose of each frame fitted to its view; frames are independent.

    Args:
        avatar: is not changed.
        body: joint hierarchy of the motion.
        motion: initial poses, in order of time.
        views: a crop of each frame of `motion`, see `crop_posed_view`; their poses are not read.
        steps: of Adam; the learning rate falls to zero along a cosine.
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
        (PRIOR_WEIGHT * len(views) * correction.mean_square_correction()).backward()
        for row, view in enumerate(views):
            _image_loss(renderer, correction.canonical_to_world(torch.tensor([row]))[0], view).backward()
        optimiser.step()
        schedule.step()
    return correction.apply(motion)


def _image_loss(
    renderer: "_AvatarRenderer", canonical_to_world: Float[Tensor, "j 4 4"], view: PosedView
) -> Float[Tensor, ""]:
    """Return the colour loss on a grey background plus the silhouette loss."""
    colour_loss, silhouette_loss = view_losses(*renderer(canonical_to_world, view), view, torch.full((3,), BACKGROUND))
    return colour_loss + silhouette_loss


class _AvatarRenderer:
    """Renders the avatar with a downsampled map; vertices are duplicated along UV seams."""

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
        """Return premultiplied colours and alpha, differentiable in the pose; the light moves with the surface."""
        avatar, vertices = self._avatar, self._avatar.pose_vertices(canonical_to_world)
        irradiance = avatar.irradiance(vertices.detach())
        corners = [avatar.uv] if irradiance is None else [avatar.uv, irradiance[self._vertex_of_uv]]

        def shade(attributes: Float[Tensor, "n c"]) -> Float[Tensor, "n 3"]:
            albedo = sample_texture(self._diffuse, attributes[:, :2])
            if irradiance is None:
                return albedo
            return linear_to_srgb(srgb_to_linear(albedo) * attributes[:, 2:]).clamp(0.0, 1.0)

        image, alpha, _ = render_shaded(
            vertices[self._vertex_of_uv],
            avatar.faces_uv,
            view.camera,
            torch.cat(corners, dim=1),
            shade,
            self._adjacency,
        )
        return image, alpha
