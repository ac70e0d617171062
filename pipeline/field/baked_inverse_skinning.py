"""Inverse skinning of the training frames, baked for the refined poses at a few steps of the training.

Between two bakes the poses move; a differentiable Newton step from the baked positions follows them (`PoseBatch`).
"""

import torch
from jaxtyping import Int
from torch import Tensor

from pipeline.body.body import Body
from pipeline.body.pose_correction import PoseCorrection
from pipeline.field.inverse_skinning import build_inverse_skinning
from pipeline.field.occupancy import BinaryOccupancy
from pipeline.field.pixel_sampler import posed_space_cameras
from pipeline.field.skin_grid import world_to_posed
from pipeline.field.volume_rendering import PoseBatch
from pipeline.geometry.camera import Camera
from pipeline.kernels.inverse_skinning import SkinGrid


class BakedInverseSkinning:
    """Inverse skinning of all training frames for the poses of the last bake.

    Attributes: `world_to_posed` (k, 4, 4) and `cameras`, the posed space of each frame and the camera in it; `inverse`;
    `skin`, the skin grid without the nodes far from occupied cells; `baked_rotation_rad`, `baked_shift_m`, the pose
    corrections at the last bake.
    """

    def __init__(self, body: Body, skin: SkinGrid, camera: Camera, poses: PoseCorrection, method: str) -> None:
        """skin: on the device of the training; the poses are on the CPU."""
        self.body, self.camera, self.poses, self.method = body, camera, poses, method
        self.full_skin = self.skin = skin
        self.baked_rotation_rad, self.baked_shift_m = torch.zeros(()), torch.zeros(())
        self.bake()

    @torch.no_grad()
    def bake(self) -> None:
        """Invert the skinning of all training frames in their present poses."""
        self.baked_rotation_rad = self.poses.rotation_rad.detach().clone()
        self.baked_shift_m = self.poses.shift_m.detach().clone()
        canonical_to_world = self.poses.canonical_to_world(torch.arange(len(self.poses.shift_m)))
        self.world_to_posed = world_to_posed(canonical_to_world)
        self.cameras = posed_space_cameras(self.camera, self.world_to_posed.numpy())
        canonical_to_posed = (self.world_to_posed[:, None] @ canonical_to_world).to(self.full_skin.weights.device)
        vars(self).pop("inverse", None)  # its memory is free before the next one is built
        self.inverse = build_inverse_skinning(self.method, self.body, self.full_skin, canonical_to_posed)

    @property
    def is_cropped(self) -> bool:
        """Whether `crop_skin_grid` was called."""
        return self.skin is not self.full_skin

    def crop_skin_grid(self, occupancy: BinaryOccupancy) -> None:
        """Keep only the skin grid nodes near occupied cells, about a third of them."""
        self.skin = self.full_skin.crop_to_occupied(occupancy.occupied, occupancy.bounds_m)

    def pose_batch(self, frames: Int[Tensor, "k"]) -> PoseBatch:
        """Return the present poses of some frames (on the CPU), differentiable in the corrections."""
        poses = self.poses.canonical_to_posed(frames, self.world_to_posed[frames])
        return PoseBatch(self.skin, frames.to(self.skin.weights.device), poses)
