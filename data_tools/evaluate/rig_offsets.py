"""Constant rotations between the joints of two rigs, measured on the frames that show both in the same pose.

Two rigs place hips, shoulders and ankles differently, so limbs with equal directions do not give equal surfaces: a rig
with its hip joints 5 cm farther apart stands with its ankles 5 cm farther apart. Over the frames of a video both rigs
show the same person. The mean rotation between their joints there is what a pose has to be corrected by.
"""

import numpy as np
import roma
import torch
from jaxtyping import Float
from torch import Tensor

from pipeline.body.body import Body, Motion, canonical_to_world
from pipeline.geometry.camera import Camera
from pipeline.geometry.skinning import local_quaternions


def joint_rotations_in_camera(body: Body, motion: Motion, camera: Camera) -> Float[Tensor, "n j 3 3"]:
    """Return the rotation from the rest pose to each pose, in camera axes; float64."""
    world_to_camera = torch.as_tensor(np.asarray(camera.world_to_camera), dtype=torch.float64)[:3, :3]
    return world_to_camera @ canonical_to_world(body, motion)[..., :3, :3].double()


def mean_rotation_offsets(
    rotations: Float[Tensor, "n j 3 3"], reference: Float[Tensor, "n j 3 3"]
) -> Float[Tensor, "j 3 3"]:
    """Return the rotation O of each joint for which reference · O is nearest to the rotations, in least squares."""
    return roma.special_procrustes((reference.transpose(-1, -2) @ rotations).mean(0))


def rotate_joints(body: Body, motion: Motion, offsets: Float[Tensor, "j 3 3"]) -> Motion:
    """Return the motion with world rotations R · O instead of R; the root joint stays where it is."""
    rotations = canonical_to_world(body, motion)[..., :3, :3].double() @ offsets
    return motion.with_pose(local_quaternions(rotations.numpy(), body.parents), motion.root_translation_m)
