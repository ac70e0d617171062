"""Fit poses to images through the textured avatar, to separate pose errors from errors of the avatar.

The avatar is fixed. Rotations of the main joints and the place of the root are aligned to the colours and the outline
of each frame alone (`pipeline.mesh.pose_alignment`). A score after this fit uses poses fitted to the scored pixels;
reports must state this.
"""

from collections.abc import Sequence

import torch
from jaxtyping import Float, Int
from torch import Tensor

from pipeline.avatar.textured_avatar import TexturedAvatar
from pipeline.body.body import Body, Motion
from pipeline.body.pose_correction import PoseCorrection
from pipeline.geometry.colour import linear_to_srgb, srgb_to_linear
from pipeline.geometry.differentiable_raster import face_adjacency
from pipeline.geometry.skinning import dense_weights
from pipeline.geometry.texture_rendering import sample_texture
from pipeline.mesh.correction_prior import independent_prior
from pipeline.mesh.pose_alignment import AlignedSurface, align_motion
from pipeline.mesh.skin_transfer import SkinnedTopology
from pipeline.mesh.views import PosedView

ITERATIONS = 4
"""Gauss-Newton steps at each size of the images."""
PRIOR_WIDTH = 3.0
"""Deviations of the prior, as a multiple of those in training frames: joints that no pixel shows keep their pose."""
MAX_TEXTURE_PX = 512
"""Side to which the diffuse map is downsampled, as coarse as the images."""


def fit_poses(avatar: TexturedAvatar, body: Body, motion: Motion, views: Sequence[PosedView]) -> Motion:
    """Return the motion with the pose of each frame fitted to its view; frames are independent.

    Args:
        avatar: is not changed.
        body: joint hierarchy of the motion.
        motion: initial poses, in order of time.
        views: a crop of each frame of `motion`, see `crop_posed_view`; their poses are not read.
    """
    prior = independent_prior(len(views), PoseCorrection(body, motion).size, PRIOR_WIDTH)
    return align_motion(_surface(avatar, len(body.joint_names)), body, motion, views, prior, ITERATIONS)


def _surface(avatar: TexturedAvatar, joint_count: int) -> AlignedSurface:
    """Return the avatar with vertices duplicated along UV seams, so that texture coordinates are attributes."""
    vertex_of_uv: Int[Tensor, "t"] = torch.zeros(len(avatar.uv), dtype=torch.long)
    vertex_of_uv[avatar.faces_uv.long().reshape(-1)] = avatar.faces.long().reshape(-1)
    uv_of_vertex = torch.zeros(len(avatar.vertices), dtype=torch.long)
    uv_of_vertex[vertex_of_uv] = torch.arange(len(vertex_of_uv))
    weights = dense_weights(avatar.joint_indices, avatar.joint_weights, joint_count)[vertex_of_uv]
    pooling_factor = max(1, len(avatar.diffuse) // MAX_TEXTURE_PX)
    diffuse = torch.nn.functional.avg_pool2d(avatar.diffuse.permute(2, 0, 1), pooling_factor).permute(1, 2, 0)

    def attributes(posed: Float[Tensor, "t 3"]) -> Float[Tensor, "t c"]:
        irradiance = avatar.irradiance(posed[uv_of_vertex])
        return avatar.uv if irradiance is None else torch.cat([avatar.uv, irradiance[vertex_of_uv]], dim=1)

    def shade(values: Float[Tensor, "n c"]) -> Float[Tensor, "n 3"]:
        albedo = sample_texture(diffuse, values[:, :2])
        if values.shape[1] == 2:
            return albedo
        return linear_to_srgb(srgb_to_linear(albedo) * values[:, 2:]).clamp(0.0, 1.0)

    skin = SkinnedTopology(avatar.faces_uv.to(torch.int32), face_adjacency(avatar.faces), weights)
    return AlignedSurface(avatar.vertices[vertex_of_uv], skin, attributes, shade)
