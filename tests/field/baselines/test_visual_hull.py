import numpy as np
import pytest
import torch

from pipeline.body.body import canonical_to_world
from pipeline.field.baselines.visual_hull import (
    SURFACE_DENSITY_PER_M,
    carve_visual_hull,
    dense_grid_field,
    dense_layout,
    node_positions_m,
)
from pipeline.field.field import INITIAL_DENSITY_PER_M
from pipeline.field.initial_occupancy import field_bounds_m
from pipeline.field.occupancy import BinaryOccupancy
from pipeline.field.rendering import render_field
from pipeline.field.skin_grid import build_skin_grid
from tests.field.scene import painted_scene, psnr_on_white_db

BOUNDS = np.array([[-0.5, 0.0, -0.25], [0.5, 2.0, 0.25]], dtype=np.float32)
MARGIN_M = 0.05


@pytest.fixture(scope="module")
def scene():
    return painted_scene(12, 160, bend_rad=0.05)


@pytest.fixture(scope="module")
def skin(scene):
    return build_skin_grid(scene.body, MARGIN_M)


@pytest.fixture(scope="module")
def hull(scene, skin):
    bounds_m = field_bounds_m(scene.body, MARGIN_M)
    rows = np.array([row for row in range(12) if row != 5])
    return carve_visual_hull(
        scene.body,
        skin,
        canonical_to_world(scene.body, scene.motion.select(rows)),
        scene.camera,
        [(scene.images[row], scene.masks[row]) for row in rows],
        bounds_m,
        dense_layout(bounds_m, 0.016, 21),
        0.9,
    )


def test_layout_is_dense_and_as_fine_as_requested_or_possible():
    assert dense_layout(BOUNDS, 0.05, 20).cells_per_axis == ((20, 40, 10),)
    layout = dense_layout(BOUNDS, 0.001, 12)
    assert layout.level_params[0, 5] == 1
    assert 0.8 * 4096 < layout.rows <= 4096


def test_the_field_interpolates_the_node_values():
    layout = dense_layout(BOUNDS, 0.1, 20)
    nodes = torch.from_numpy(node_positions_m(BOUNDS, layout))
    # Linear in space, so that trilinear interpolation is exact everywhere.
    raw = torch.stack([nodes[:, 0], nodes[:, 1] - 1, -4 * nodes[:, 2], 2 * nodes[:, 1] + nodes[:, 0] - 2], dim=1)
    field = dense_grid_field(BOUNDS, layout, raw).requires_grad_(False)
    points = torch.rand(200, 3, generator=torch.Generator().manual_seed(0)) * torch.tensor([1.0, 2.0, 0.5])
    x, y, z = (points + torch.from_numpy(BOUNDS[0])).unbind(1)
    colour, density = field(torch.stack([x, y, z], dim=1))
    torch.testing.assert_close(colour, torch.sigmoid(torch.stack([x, y - 1, -4 * z], dim=1)), atol=1e-5, rtol=0)
    torch.testing.assert_close(density, INITIAL_DENSITY_PER_M * torch.exp(2 * y + x - 2), atol=0, rtol=1e-4)


def test_body_is_solid_and_air_is_empty(scene, hull):
    mesh = scene.body.mesh()
    trunk = (np.abs(mesh.vertices[:, 0]) < 0.15) & (mesh.vertices[:, 1] > 0.9) & (mesh.vertices[:, 1] < 1.3)
    surface, normals = mesh.vertices[trunk], mesh.vertex_normals()[trunk]
    inside = hull.density(torch.from_numpy(surface - 0.03 * normals).float())
    assert float((inside > SURFACE_DENSITY_PER_M).float().mean()) > 0.97
    beside = torch.tensor([[0.0, 0.3, 0.0], [0.4, 1.6, 0.0], [-0.4, 1.6, 0.0]])
    assert float(hull.density(beside).max()) < 1.0


def test_renders_a_frame_that_was_not_used(scene, skin, hull):
    """Full turn: concavities remain under the arms only; colours are means over the frames that face them."""
    occupancy = BinaryOccupancy(torch.ones(64, 64, 64, dtype=torch.uint8), hull.bounds_m)
    pose = canonical_to_world(scene.body, scene.motion.select(np.array([5])))[0]
    shown = render_field(hull, occupancy, scene.body, pose, scene.camera, skin)
    mask = torch.from_numpy(scene.masks[5]) / 255
    covered, true = shown[..., 3] > 0.5, mask > 0.5
    assert float((covered & true).sum() / (covered | true).sum()) > 0.9
    assert psnr_on_white_db(shown, scene.images[5], scene.masks[5]) > 22


def test_front_and_back_keep_their_colours(scene, skin):
    """A red frame from the front and a blue frame from the back: each side has its own colour."""
    rows = np.array([0, 6])
    paints = (np.array([255, 0, 0], np.uint8), np.array([0, 0, 255], np.uint8))
    masked_images = [
        (np.zeros_like(scene.images[0]) + paint, scene.masks[row]) for row, paint in zip(rows, paints, strict=True)
    ]
    bounds_m = field_bounds_m(scene.body, MARGIN_M)
    layout = dense_layout(bounds_m, 0.03, 20)
    poses = canonical_to_world(scene.body, scene.motion.select(rows))
    field = carve_visual_hull(scene.body, skin, poses, scene.camera, masked_images, bounds_m, layout, 0.9)
    chest, back = (
        scene.body.vertices[
            (np.abs(scene.body.vertices[:, 0]) < 0.1)
            & (scene.body.vertices[:, 1] > 1.0)
            & (scene.body.vertices[:, 1] < 1.3)
            & (side * scene.body.vertices[:, 2] > 0.08)
        ]
        for side in (1, -1)
    )
    red, blue = (field.colour(torch.from_numpy(points)).median(0).values for points in (chest, back))
    assert red.tolist() == pytest.approx([1, 0, 0], abs=0.05)
    assert blue.tolist() == pytest.approx([0, 0, 1], abs=0.05)
