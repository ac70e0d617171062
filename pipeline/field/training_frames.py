"""Which training frames the field needs: as many as there are distinct poses; a pose seen twice teaches little."""

import numpy as np
import torch
from jaxtyping import Float, Int

from pipeline.body.body import Body, Motion, canonical_to_world
from pipeline.field.setup import evenly_spaced
from pipeline.geometry.skinning import linear_blend_skinning

MEASURED_VERTICES = 500
"""Vertices of the body whose positions tell how far two poses are apart."""
MIN_TRAINING_FRAMES = 24
"""Frames that are used, where there are so many, however little the person moves; errors of single frames average."""


def pose_distances_m(body: Body, motion: Motion) -> Float[np.ndarray, "n n"]:
    """Return how far the surface lies apart in each pair of frames, with the root joint in one place.

    Root mean square over vertices, m. A turn counts, because it shows another side to the camera; a step aside does
    not.
    """
    vertices = evenly_spaced(len(body.vertices), MEASURED_VERTICES)
    poses = canonical_to_world(body, motion.with_pose(motion.rotations_wxyz, np.zeros_like(motion.root_translation_m)))
    rest_m, weights = torch.as_tensor(body.vertices[vertices]), torch.as_tensor(body.skin_weights[vertices])
    posed_m = linear_blend_skinning(rest_m, weights, poses).flatten(1)
    return torch.cdist(posed_m, posed_m, compute_mode="donot_use_mm_for_euclid_dist").numpy() / np.sqrt(len(vertices))


def count_distinct_poses(distance_m: Float[np.ndarray, "n n"], spacing_m: float) -> int:
    """Return how many frames are taken if, in their order, each farther than `spacing_m` from all taken ones is."""
    taken = [0]
    for frame in range(1, len(distance_m)):
        if distance_m[frame, taken].min() > spacing_m:
            taken.append(frame)
    return len(taken)


def choose_training_frames(body: Body, motion: Motion, max_frames: int, pose_spacing_m: float) -> Int[np.ndarray, "k"]:
    """Return the rows of `motion` to train on, evenly spaced: as many as there are distinct poses, at least
    `MIN_TRAINING_FRAMES` and at most `max_frames`.

    pose_spacing_m: distance from which on poses are distinct, see `pose_distances_m`; 0 takes all frames.
    """
    count = len(motion.frame_index)
    if pose_spacing_m > 0:
        distinct = count_distinct_poses(pose_distances_m(body, motion), pose_spacing_m)
        max_frames = min(max_frames, max(distinct, MIN_TRAINING_FRAMES))
    return evenly_spaced(count, max_frames)
