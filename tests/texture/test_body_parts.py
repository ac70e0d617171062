"""Body parts by joint name, on the rig of the pipeline's body model."""

import numpy as np
import pytest

from pipeline.body.body import load_anny
from pipeline.texture.body_parts import BODY_PARTS, body_part_of_faces, body_part_of_joint


@pytest.mark.parametrize(
    ("joint", "part"),
    [
        ("Hips", "torso"),
        ("Spine2", "torso"),
        ("Head", "head"),
        ("LeftShoulder", "left arm"),
        ("RightForeArm", "right arm"),
        ("LeftHand", "left hand"),
        ("RightHandThumb3", "right hand"),
        ("LeftUpLeg", "left leg"),
        ("RightToeBase", "right leg"),
        ("Tail", "torso"),
    ],
)
def test_part_of_a_joint_name(joint: str, part: str) -> None:
    assert body_part_of_joint(joint) == part


def test_faces_of_each_part_are_at_its_place_on_the_body() -> None:
    anny = load_anny()
    body = anny.at_shape(anny.shape_defaults)
    indices = np.argsort(-body.skin_weights, axis=1)[:, :4]
    weights = np.take_along_axis(body.skin_weights, indices, axis=1)
    part = body_part_of_faces(body.faces, indices.astype(np.int32), weights, body.joint_names)
    centres = body.vertices[body.faces].mean(axis=1)
    assert set(np.unique(part)) == set(range(len(BODY_PARTS)))
    assert np.all(centres[part == BODY_PARTS.index("left hand"), 0] > 0.2)  # the left of the person is +X
    assert np.all(centres[part == BODY_PARTS.index("right leg"), 0] < 0.03)
    assert np.all(centres[part == BODY_PARTS.index("head"), 1] > 0.8 * body.height_m())
