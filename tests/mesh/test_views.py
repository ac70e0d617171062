"""Views of a known mesh: crops and their cameras, renders of the true mesh, and where the image error is."""

import math
from collections.abc import Callable
from functools import partial

import numpy as np
import pytest
import torch

from pipeline.body.body import Body
from pipeline.geometry.camera import Camera, pixel_footprint_m
from pipeline.geometry.mesh import Mesh
from pipeline.mesh.skin_transfer import transfer_skin
from pipeline.mesh.views import (
    COLOUR_LOSS_SCALE,
    HUBER_DELTA,
    accumulate_face_errors,
    composite_target,
    crop_posed_view,
    mesh_psnr_db,
    render_posed_view,
    sampled_losses,
    silhouette_iou,
)
from tests.mesh.egg import CAMERA, DISTANCE_M, PATTERN, Pattern, Views


def test_renders_of_the_true_mesh_match_its_views(egg: Mesh, egg_body: Body, egg_views: Views) -> None:
    skin = transfer_skin(egg, egg_body)
    assert mesh_psnr_db(egg, skin, egg_views[1], PATTERN) > 45  # the error of rounding to 8 bits
    assert silhouette_iou(egg, skin, egg_views[1]) > 0.98
    assert math.isnan(silhouette_iou(egg, skin, []))
    assert accumulate_face_errors(egg, skin, egg_views[0], PATTERN).max() < 0.5


def test_face_errors_are_large_where_the_mesh_is_wrong(egg: Mesh, egg_body: Body, egg_views: Views) -> None:
    top = egg.vertices[:, 1] > 0.2
    deformed = Mesh(np.where(top[:, None], egg.vertices * np.float32(1.15), egg.vertices), egg.faces)
    errors = accumulate_face_errors(deformed, transfer_skin(deformed, egg_body), egg_views[0], PATTERN)
    on_top = top[egg.faces].all(axis=1)
    assert errors[on_top].mean() > 5 * errors[~on_top].mean()


def test_a_crop_contains_the_person_and_its_camera_has_the_same_rays() -> None:
    image = np.random.default_rng(0).random((100, 80, 3)).astype(np.float32)
    mask = np.zeros((100, 80), dtype=np.float32)
    mask[20:80, 30:50] = 1.0
    camera = Camera(120.0, 121.0, 40.0, 50.0, 80, 100)
    view = crop_posed_view(image, mask, camera, torch.eye(4)[None], max_person_px=30)
    assert view.mask.shape == (view.camera.height, view.camera.width)
    assert 30 <= view.camera.height <= 45
    assert int((view.mask > 127).any(dim=1).sum()) == pytest.approx(30, abs=1)
    # The ray through the upper edge of the mask has the same direction in both cameras.
    rows = np.flatnonzero((view.mask.numpy() > 127).any(axis=1))
    assert (rows[0] - view.camera.cy) / view.camera.fy == pytest.approx((20 - 50) / 121.0, abs=0.6 / view.camera.fy)
    whole = crop_posed_view(image, np.zeros_like(mask), camera, torch.eye(4)[None], max_person_px=500)
    assert (whole.camera.height, whole.camera.width) == (100, 80)
    np.testing.assert_allclose(composite_target(view, torch.ones(3))[0][0, 0].numpy(), 1.0)


def test_a_view_at_half_the_size_shows_the_same_pixels_in_the_mean(egg_views: Views) -> None:
    view = egg_views[0][0]
    half = view.scaled(0.5)
    assert half.mask.shape == (half.camera.height, half.camera.width)
    assert half.mask.shape == tuple(side // 2 for side in view.mask.shape)
    wide = [composite_target(each, torch.zeros(3))[0].numpy() for each in (view, half)]
    blocks = wide[0].reshape(half.camera.height, 2, half.camera.width, 2, 3).mean(axis=(1, 3))
    np.testing.assert_allclose(wide[1], blocks, atol=2.0 / 255.0)
    # The ray through a pixel of the small picture is that through the middle of the four.
    assert (10.5 - half.camera.cx) / half.camera.fx == pytest.approx((21.0 - view.camera.cx) / view.camera.fx)


@pytest.mark.parametrize("stride", [1, 2, 3, 5])
def test_losses_of_all_lattices_add_up_to_those_of_the_whole_view(
    egg: Mesh, egg_body: Body, egg_views: Views, stride: int
) -> None:
    skin, view, background = transfer_skin(egg, egg_body), egg_views[0][0], torch.tensor([0.2, 0.7, 0.4])
    shader = Pattern(0.3)
    shifted_m = torch.from_numpy(egg.vertices + np.float32([0.013, -0.007, 0.004]))

    def gradients(losses: Callable[[torch.Tensor], tuple[torch.Tensor, torch.Tensor]]) -> list[torch.Tensor]:
        vertices = shifted_m.clone().requires_grad_()
        colour_loss, silhouette_loss = losses(vertices)
        of_colour = torch.autograd.grad(colour_loss, [vertices, shader.contrast], retain_graph=True)
        return [*of_colour, *torch.autograd.grad(silhouette_loss, [vertices])]

    def whole(vertices: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
        image, alpha, _ = render_posed_view(vertices, skin, view, shader)
        target, mask = composite_target(view, background)
        composited = image + (1.0 - alpha[..., None]) * background
        colour_loss = COLOUR_LOSS_SCALE * torch.nn.functional.huber_loss(composited, target, delta=HUBER_DELTA)
        return colour_loss, (alpha - mask).abs().mean()

    parts = [
        gradients(partial(sampled_losses, skin=skin, view=view, shader=shader, background=background, lattice=lattice))
        for lattice in ((stride, phase) for phase in range(stride))
    ]
    for expected, *found in zip(gradients(whole), *parts, strict=True):
        assert expected.abs().max() > 0.0
        torch.testing.assert_close(sum(found) / stride, expected, rtol=1e-3, atol=1e-6)


def test_pixel_footprint_is_depth_over_focal_length(egg: Mesh, egg_body: Body, egg_views: Views) -> None:
    view = egg_views[0][0]
    posed = view.pose_vertices(torch.from_numpy(egg_body.vertices), torch.from_numpy(egg_body.skin_weights))
    assert pixel_footprint_m(posed, view.camera) == pytest.approx(DISTANCE_M / CAMERA.fx, rel=0.05)
