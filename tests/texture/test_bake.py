"""Closed loop: render a painted ball, bake its texture from the images, compare with the true texture."""

from typing import Any

import cv2
import numpy as np
import pytest
import torch

from pipeline.geometry.camera import pixel_footprint_m
from pipeline.texture import bake
from pipeline.texture.bake import bake_diffuse, mean_foreground_psnr_db, render_textured_view
from pipeline.texture.settings import TextureSettings
from pipeline.texture.views import (
    BakeView,
    align_to_render,
    pixel_confidence,
    vertex_view_cosine,
    weight_by_resolution,
)
from tests.texture.painted_ball import CAMERA, DISTANCE_M, SIZE_PX, PaintedBall

MAGENTA = np.array([1.0, 0.0, 1.0], dtype=np.float32)


@pytest.fixture(scope="module")
def ball() -> PaintedBall:
    return PaintedBall(16)


@pytest.fixture(scope="module")
def misaligned_ball() -> PaintedBall:
    """The images are shifted by a few pixels against the camera."""
    return PaintedBall(32, shift_px=2.0)


def baked_colours(ball: PaintedBall, rounds: int, **settings: float) -> tuple[np.ndarray, np.ndarray]:
    """Baked colour and confidence of every texel; inpainted with a colour that does not occur on the ball."""
    texture, confidence = bake_diffuse(ball.views, ball.surface, magenta, rounds, TextureSettings(**settings))
    return texture[ball.texels.rows, ball.texels.columns], confidence


def magenta(colour: np.ndarray, texel_confidence: np.ndarray) -> np.ndarray:
    return np.tile(MAGENTA, (len(colour), 1))


def test_observed_texels_recover_the_true_colour(ball: PaintedBall) -> None:
    colour, confidence = baked_colours(ball, rounds=3, max_flow_m=0.0)
    error = np.abs(colour - ball.truth)[confidence > 0.98]
    assert (confidence > 0.98).mean() > 0.4
    assert np.median(error) < 0.004  # the rounding error of the 8-bit images is 0.002
    assert np.quantile(error, 0.99) < 0.05


def test_rounds_remove_the_blur_of_the_pixel_footprint(ball: PaintedBall) -> None:
    colours = [baked_colours(ball, rounds=rounds, max_flow_m=0.0) for rounds in (0, 2)]
    before, after = (np.abs(colour - ball.truth)[confidence > 0.98].mean() for colour, confidence in colours)
    assert after < 0.25 * before


def test_neither_background_nor_occluder_bleeds_in(ball: PaintedBall) -> None:
    colour, confidence = baked_colours(ball, rounds=1)
    to_background = np.array([0.0, 1.0, 0.0]) - ball.truth  # pure green, far from every colour of the ball
    share = ((colour - ball.truth) * to_background).sum(axis=1) / (to_background**2).sum(axis=1)
    assert share.max() < 0.1
    knobs = ball.texels.interpolate(ball.mesh.faces, np.abs(ball.mesh.vertices[:, :1]))[:, 0] > 0.53
    assert np.abs(colour - ball.truth)[knobs & (confidence > 0.9)].mean() < 0.1


@pytest.mark.slow
def test_alignment_removes_the_blur_of_wrong_poses(misaligned_ball: PaintedBall) -> None:
    def contrast(rounds: int) -> float:
        colour, confidence = baked_colours(misaligned_ball, rounds)
        return float(np.std(colour[confidence > 0.98]) / np.std(misaligned_ball.truth[confidence > 0.98]))

    blurred, aligned = contrast(rounds=0), contrast(rounds=3)
    assert blurred < 0.985
    assert abs(aligned - 1.0) < 0.5 * abs(blurred - 1.0)


def test_unobserved_texels_keep_the_inpainted_colour() -> None:
    front = PaintedBall(0, angles=np.array([-0.2, 0.0, 0.2]))
    colour, confidence = baked_colours(front, rounds=1)
    hidden = confidence == 0
    assert 0.3 < hidden.mean() < 0.9
    np.testing.assert_allclose(colour[hidden], np.broadcast_to(MAGENTA, colour[hidden].shape), atol=1e-6)


def test_validation_psnr_is_higher_for_the_true_texture(ball: PaintedBall) -> None:
    grey = np.full((256, 256, 3), 0.5, dtype=np.float32)
    true = ball.texels.to_texture(ball.truth)
    true[~ball.texels.coverage_mask()] = 0.5
    assert mean_foreground_psnr_db(true, ball.views[:2], ball.surface) > 10 + mean_foreground_psnr_db(
        grey, ball.views[:2], ball.surface
    )
    assert np.isnan(mean_foreground_psnr_db(true, [], ball.surface))


def test_the_same_views_give_the_same_bytes(ball: PaintedBall) -> None:
    once, again = (bake_diffuse(ball.views[:5], ball.surface, magenta, 1, TextureSettings())[0] for _ in range(2))
    assert once.tobytes() == again.tobytes()


@pytest.mark.parametrize("shift_px", [(2.0, 0.0), (-1.0, 3.0)])
def test_align_warps_an_image_onto_the_render(misaligned_ball: PaintedBall, shift_px: tuple[float, float]) -> None:
    texture = misaligned_ball.texels.to_texture(misaligned_ball.truth)
    view = misaligned_ball.views[0]
    rendered = render_textured_view(texture, view, misaligned_ball.surface)
    rows, columns = np.mgrid[: view.mask.shape[0], : view.mask.shape[1]].astype(np.float32)
    sample_positions_px = (columns - np.float32(shift_px[0]), rows - np.float32(shift_px[1]))
    straight = np.clip(255.0 * rendered[..., :3] / np.maximum(rendered[..., 3:], 1e-3), 0, 255).astype(np.uint8)
    image = cv2.remap(straight, *sample_positions_px, cv2.INTER_LINEAR)
    mask = cv2.remap((255 * rendered[..., 3]).astype(np.uint8), *sample_positions_px, cv2.INTER_LINEAR)
    shifted = BakeView(image, mask, view.camera, view.vertices_world, view.view_cosine)
    inside = cv2.erode((rendered[..., 3] > 0.99).astype(np.uint8), np.ones((9, 9))) > 0
    target = straight[inside] / 255.0
    remaining = np.abs(align_to_render(shifted, rendered, 2.0, 8.0)[0][inside] - target).mean()
    assert remaining < 0.25 * np.abs(image[inside] / 255.0 - target).mean()
    unmoved, same_mask = align_to_render(shifted, rendered, 2.0, 0.0)
    np.testing.assert_array_equal(unmoved, image.astype(np.float32) / 255.0)
    assert same_mask is mask


def test_opencv_has_one_thread_while_views_are_aligned_and_its_own_number_afterwards(
    ball: PaintedBall, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The result of the optical flow depends on the number of threads, which all workers share."""
    found = []

    def align(*arguments: Any) -> tuple[np.ndarray, np.ndarray]:
        found.append(cv2.getNumThreads())
        return align_to_render(*arguments)

    monkeypatch.setattr(bake, "align_to_render", align)
    texture, threads = np.full((SIZE_PX, SIZE_PX, 3), 0.5, np.float32), cv2.getNumThreads()
    cv2.setNumThreads(3)
    try:
        bake.average_residuals(texture, ball.views, ball.surface, TextureSettings())
        assert (set(found), cv2.getNumThreads()) == ({1}, 3)
    finally:
        cv2.setNumThreads(threads)


def test_pixel_confidence_is_zero_at_silhouettes_and_depth_discontinuities() -> None:
    depth = np.full((40, 60), np.inf, dtype=np.float32)
    depth[5:35, 5:55] = 2.0
    depth[5:35, 30:55] = 1.5  # an arm in front of the body
    mask = np.where(np.isfinite(depth), 255, 0).astype(np.uint8)
    pixel_weights = pixel_confidence(mask, depth, falloff_px=4.0)
    assert pixel_weights[20, 15] == pixel_weights[20, 45] == 1.0
    assert not pixel_weights[20, 28:32].any()
    assert not pixel_weights[:6].any()
    assert not pixel_confidence(np.full_like(mask, 200), depth, 4.0).any()  # no pixel shows the person only


def test_view_cosine_is_that_of_a_sphere(ball: PaintedBall) -> None:
    view = ball.views[0]
    centre = view.vertices_world[:642].mean(dim=0)
    outward = torch.nn.functional.normalize(view.vertices_world[:642] - centre, dim=1)
    towards = torch.nn.functional.normalize(-view.vertices_world[:642], dim=1)
    view_cosine = vertex_view_cosine(view.vertices_world, ball.surface.faces, CAMERA)[:642]
    torch.testing.assert_close(view_cosine, (outward * towards).sum(dim=1), atol=0.02, rtol=0.0)


def test_weight_is_proportional_to_pixels_per_area(ball: PaintedBall) -> None:
    far = ball.views[0]
    near = BakeView(far.image, far.mask, far.camera, 0.5 * far.vertices_world, far.view_cosine)
    assert pixel_footprint_m(far.vertices_world, far.camera) == pytest.approx(DISTANCE_M / CAMERA.fx, rel=0.02)
    weights = [view.weight for view in weight_by_resolution([far, far, near])]
    assert weights == pytest.approx([1.0, 1.0, 4.0], rel=1e-4)


@pytest.mark.parametrize(
    ("name", "value"),
    [("cosine_power", -1.0), ("max_flow_m", -0.01), ("padding_px", 0)],
)
def test_settings_out_of_range_are_refused(name: str, value: float) -> None:
    with pytest.raises(ValueError, match=f"{name} = {value}"):
        TextureSettings(**{name: value})
