"""Convert a motion of the avatar to a recording for BVH files."""

import numpy as np

from pipeline.avatar.rig import Rig
from pipeline.body.body import Motion
from pipeline.io.bvh import BvhMotion

CM_PER_M = 100.0


def motion_to_bvh(rig: Rig, motion: Motion, fps: float) -> BvhMotion:
    """Return the motion in centimetres, the unit of most BVH files, with the names and the rest pose of a rig.

    BVH has no axes of joints: those of the rest pose are those of the world, whatever the axes of the rig are.

    motion: with `fps` frames per second.
    """
    rest = rig.rest_matrices()
    to_rest = rig.bind_to_rest[:, :3, :3]
    world = rig.world_rotations(motion) @ to_rest.transpose(0, 2, 1)
    parents = rig.body.parents.astype(np.int64)
    local, offsets_m = world.copy(), rest[:, :3, 3].copy()
    local[:, 1:] = world[:, parents[1:]].transpose(0, 1, 3, 2) @ world[:, 1:]
    offsets_m[1:] -= rest[parents[1:], :3, 3]
    root_m = motion.root_translation_m.astype(np.float64)
    return BvhMotion(rig.joint_names, parents, CM_PER_M * offsets_m, local, CM_PER_M * root_m, fps)
