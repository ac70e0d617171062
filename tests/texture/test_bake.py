"""The bake, in a closed loop: film a painted ball, bake, and find the paint again where it was seen."""

import cv2
import numpy as np
import pytest
import torch

from pipeline.geometry.camera import pixel_footprint_m
from pipeline.texture.bake import BakeConfig, bake_diffuse, mean_foreground_psnr_db, render_textured_view
from pipeline.texture.views import (
    BakeView,
    align_to_render,
    pixel_confidence,
    vertex_view_cosine,
    weight_by_resolution,
)
from tests.mesh.painted_ball import CAMERA, DISTANCE_M, PaintedBall

MAGENTA = np.array([1.0, 0.0, 1.0], dtype=np.float32)


@pytest.fixture(scope="module")
def ball() -> PaintedBall:
    return PaintedBall(16)


@pytest.fixture(scope="module")
def misaligned_ball() -> PaintedBall:
    """The pictures lie a few pixels beside where the camera says."""
    return PaintedBall(32, shift_px=2.0)


def baked_colours(ball: PaintedBall, **options: float) -> tuple[np.ndarray, np.ndarray]:
    """Baked colour of every texel and how well it was seen; filled with a colour that is nowhere on the ball."""
    texture, seen = bake_diffuse(ball.views, ball.surface, magenta, BakeConfig(**options))
    return texture[ball.texels.rows, ball.texels.columns], seen


def magenta(colour: np.ndarray, seen: np.ndarray) -> np.ndarray:
    return np.tile(MAGENTA, (len(colour), 1))


def test_the_paint_comes_back_where_it_was_seen(ball: PaintedBall) -> None:
    colour, seen = baked_colours(ball, rounds=3, max_flow_m=0.0)
    error = np.abs(colour - ball.truth)[seen > 0.98]
    assert (seen > 0.98).mean() > 0.4
    assert np.median(error) < 0.004  # half a step of the 8-bit pictures is 0.002
    assert np.quantile(error, 0.99) < 0.05


def test_rounds_undo_the_blur_of_pixels(ball: PaintedBall) -> None:
    colours = [baked_colours(ball, rounds=rounds, max_flow_m=0.0) for rounds in (0, 2)]
    before, after = (np.abs(colour - ball.truth)[seen > 0.98].mean() for colour, seen in colours)
    assert after < 0.25 * before


def test_no_backdrop_and_no_occluder_bleeds_in(ball: PaintedBall) -> None:
    colour, seen = baked_colours(ball, rounds=1)
    # the backdrop is pure green, which the paint never comes near
    assert np.all(colour[:, 1] - colour[:, 0] < 0.72)
    knobs = ball.texels.interpolate(ball.mesh.faces, np.abs(ball.mesh.vertices[:, :1]))[:, 0] > 0.53
    assert np.abs(colour - ball.truth)[knobs & (seen > 0.9)].mean() < 0.1


def test_alignment_sharpens_what_wrong_poses_blurred(misaligned_ball: PaintedBall) -> None:
    def contrast(**options: float) -> float:
        colour, seen = baked_colours(misaligned_ball, **options)
        return float(np.std(colour[seen > 0.98]) / np.std(misaligned_ball.truth[seen > 0.98]))

    blurred, aligned = contrast(rounds=0), contrast(rounds=3)
    assert blurred < 0.985
    assert abs(aligned - 1.0) < 0.5 * abs(blurred - 1.0)


def test_what_nobody_sees_keeps_the_fallback() -> None:
    front = PaintedBall(0, angles=np.array([-0.2, 0.0, 0.2]))
    colour, seen = baked_colours(front, rounds=1)
    hidden = seen == 0
    assert 0.3 < hidden.mean() < 0.9
    np.testing.assert_allclose(colour[hidden], np.broadcast_to(MAGENTA, colour[hidden].shape), atol=1e-6)


def test_validation_psnr_tells_the_true_texture_from_a_wrong_one(ball: PaintedBall) -> None:
    grey = np.full((256, 256, 3), 0.5, dtype=np.float32)
    true = ball.texels.to_texture(ball.truth)
    true[~ball.texels.coverage_mask()] = 0.5
    assert mean_foreground_psnr_db(true, ball.views[:2], ball.surface) > 10 + mean_foreground_psnr_db(
        grey, ball.views[:2], ball.surface
    )
    assert np.isnan(mean_foreground_psnr_db(true, [], ball.surface))


def test_the_same_views_give_the_same_bytes(ball: PaintedBall) -> None:
    once, again = (bake_diffuse(ball.views[:5], ball.surface, magenta, BakeConfig(rounds=1))[0] for _ in range(2))
    assert once.tobytes() == again.tobytes()


@pytest.mark.parametrize("shift_px", [(2.0, 0.0), (-1.0, 3.0)])
def test_align_moves_a_picture_onto_the_render(misaligned_ball: PaintedBall, shift_px: tuple[float, float]) -> None:
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
    left = np.abs(align_to_render(shifted, rendered, 2.0, 8.0)[0][inside] - target).mean()
    assert left < 0.25 * np.abs(image[inside] / 255.0 - target).mean()
    unmoved, same_mask = align_to_render(shifted, rendered, 2.0, 0.0)
    np.testing.assert_array_equal(unmoved, image.astype(np.float32) / 255.0)
    assert same_mask is mask


def test_trust_falls_to_zero_at_silhouettes_and_at_borders_in_depth() -> None:
    depth = np.full((40, 60), np.inf, dtype=np.float32)
    depth[5:35, 5:55] = 2.0
    depth[5:35, 30:55] = 1.5  # an arm before the body
    mask = np.where(np.isfinite(depth), 255, 0).astype(np.uint8)
    pixel_weights = pixel_confidence(mask, depth, edge_px=4.0)
    assert pixel_weights[20, 15] == pixel_weights[20, 45] == 1.0
    assert not pixel_weights[20, 28:32].any()
    assert not pixel_weights[:6].any()
    assert not pixel_confidence(np.full_like(mask, 200), depth, 4.0).any()  # soft everywhere: the person nowhere alone


def test_cosine_is_one_where_the_ball_faces_the_camera(ball: PaintedBall) -> None:
    view = ball.views[0]
    centre = view.vertices_world[:642].mean(dim=0)
    outward = torch.nn.functional.normalize(view.vertices_world[:642] - centre, dim=1)
    towards = torch.nn.functional.normalize(-view.vertices_world[:642], dim=1)
    view_cosine = vertex_view_cosine(view.vertices_world, ball.surface.faces, CAMERA)[:642]
    torch.testing.assert_close(view_cosine, (outward * towards).sum(dim=1), atol=0.02, rtol=0.0)


def test_near_frames_weigh_more(ball: PaintedBall) -> None:
    far = ball.views[0]
    near = BakeView(far.image, far.mask, far.camera, 0.5 * far.vertices_world, far.view_cosine)
    assert pixel_footprint_m(far.vertices_world, far.camera) == pytest.approx(DISTANCE_M / CAMERA.fx, rel=0.02)
    weights = [view.weight for view in weight_by_resolution([far, far, near])]
    assert weights == pytest.approx([1.0, 1.0, 4.0], rel=1e-4)
