"""Posing and rendering of the exported avatar."""

import numpy as np
import pytest
import torch

from pipeline.avatar.textured_avatar import TexturedAvatar
from pipeline.body.body import canonical_to_world
from tests.avatar.avatar_sample import sample_body, sample_motion
from tests.stages.report_run import CAMERA, make_avatar


@pytest.fixture(scope="module")
def avatar() -> TexturedAvatar:
    return make_avatar(sample_body())


def test_posing_is_linear_blend_skinning(avatar: TexturedAvatar):
    pose = canonical_to_world(sample_body(), sample_motion(np.array([0, 5])))[1]
    posed = avatar.pose_vertices(pose).numpy()
    for vertex in (0, 17, len(posed) - 1):
        point = np.append(avatar.vertices[vertex].numpy(), 1.0)
        moved = sum(
            weight * (pose[joint].numpy() @ point)[:3]
            for joint, weight in zip(
                avatar.joint_indices[vertex].tolist(), avatar.joint_weights[vertex].tolist(), strict=True
            )
        )
        assert posed[vertex] == pytest.approx(moved, abs=1e-5)


def test_a_render_is_premultiplied_and_has_the_texture_colours(avatar: TexturedAvatar):
    pose = canonical_to_world(sample_body(), sample_motion(np.array([0, 5])))[0]
    image = avatar.render(avatar.pose_vertices(pose), CAMERA, supersampling=2)
    assert image.shape == (CAMERA.height, CAMERA.width, 4)
    solid = image[..., 3] == 1.0
    assert solid.sum() > 200
    assert (image[..., :3] <= image[..., 3:] * 160 / 255 + 1e-4).all()  # the brightest texel is 160
    assert (image[solid][:, :3] >= 39 / 255).all()  # the darkest is 40


def test_turntable_views_share_their_height_and_are_cropped(avatar: TexturedAvatar):
    views = avatar.render_turntable(avatar.vertices, views=4, height_px=60, supersampling=2)
    assert [view.shape[0] for view in views] == [60] * 4
    for view in views:
        assert view[:, 0, 3].any()
        assert view[:, -1, 3].any()
    front, side = views[0].shape[1], views[1].shape[1]
    assert front / side == pytest.approx(0.4 / 0.3, rel=0.2)  # the sample is a box of 0.4 m x 0.3 m


def test_the_mesh_keeps_its_triangles(avatar: TexturedAvatar):
    mesh = avatar.mesh()
    assert mesh.is_watertight()
    assert torch.equal(torch.from_numpy(mesh.faces), avatar.faces)
