"""Body parts by joint name, on the rig that the pipeline uses."""

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
def test_joint_names(joint: str, part: str) -> None:
    assert body_part_of_joint(joint) == part


def test_faces_of_the_body_lie_where_their_part_is() -> None:
    anny = load_anny()
    body = anny.body(anny.shape_defaults)
    indices = np.argsort(-body.skin_weights, axis=1)[:, :4]
    weights = np.take_along_axis(body.skin_weights, indices, axis=1)
    part = body_part_of_faces(body.faces, indices.astype(np.int32), weights, body.joint_names)
    centres = body.vertices[body.faces].mean(axis=1)
    assert set(np.unique(part)) == set(range(len(BODY_PARTS)))
    assert np.all(centres[part == BODY_PARTS.index("left hand"), 0] > 0.2)  # the person's left lies along +X
    assert np.all(centres[part == BODY_PARTS.index("right leg"), 0] < 0.03)
    assert np.all(centres[part == BODY_PARTS.index("head"), 1] > 0.8 * body.height_m())
