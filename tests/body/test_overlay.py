import numpy as np
import pytest

from pipeline.body.body import load_anny
from pipeline.body.fit.silhouette_icp import posed_vertices
from pipeline.body.overlay import (
    BODY_OUTLINE_RGB,
    MASK_OUTLINE_RGB,
    TILE_COLUMNS,
    TILE_ROWS,
    TILES_PER_ROW,
    WARNING_RGB,
    draw_overlay,
    side_colours,
    tile_overlays,
)
from tests.body.acting import synthetic_recording


@pytest.fixture(scope="module")
def tile() -> np.ndarray:
    return render_tile("")


def render_tile(warning: str) -> np.ndarray:
    """Return the overlay of a person who faces the camera, on a grey image."""
    scene = synthetic_recording(load_anny(), 3, turn_rad=0.0)
    image = np.full((scene.camera.height, scene.camera.width, 3), 90, dtype=np.uint8)
    vertices = posed_vertices(scene.model, scene.state)[0]
    body = load_anny().at_shape(load_anny().shape_defaults)
    mask = np.zeros(image.shape[:2], dtype=np.uint8)
    mask[20:300, 60:200] = 255
    return draw_overlay(image, mask, vertices, body, scene.camera, "frame 0", warning)


def test_both_outlines_are_render_tile(tile: np.ndarray) -> None:
    assert tile.shape == (TILE_ROWS, TILE_COLUMNS, 3)
    for colour in (BODY_OUTLINE_RGB, MASK_OUTLINE_RGB):
        assert (tile == colour).all(-1).sum() > 200


def test_a_frame_with_a_warning_has_a_border_and_a_label(tile: np.ndarray) -> None:
    marked, short = render_tile("unusable"), render_tile("u")
    red = (marked == WARNING_RGB).all(-1)
    assert not (tile == WARNING_RGB).all(-1).any()
    assert all(side.all() for side in (red[1, 1:-1], red[-2, 1:-1], red[1:-1, 1], red[1:-1, -2]))
    assert (marked != short).any()
    assert np.array_equal(marked[20:400, 20:-20], tile[20:400, 20:-20])


def test_the_left_side_is_orange_and_on_the_right_of_the_image(tile: np.ndarray) -> None:
    red, blue = tile[..., 0].astype(int), tile[..., 2].astype(int)
    orange = np.argwhere((red - blue > 40) & (tile[..., 1] < 200))
    blueish = np.argwhere((blue - red > 40) & (tile[..., 1] < 200))
    assert orange[:, 1].mean() > TILE_COLUMNS / 2 > blueish[:, 1].mean()


def test_every_face_has_a_side_colour() -> None:
    body = load_anny().at_shape(load_anny().shape_defaults)
    colours = side_colours(body)
    assert len(colours) == len(body.faces)
    left = body.vertices[body.faces[:, 0], 0] > 0.3
    assert len(np.unique(colours[left], axis=0)) == 1


def test_last_row_is_padded_with_black() -> None:
    tiles = [np.full((4, 5, 3), shade, dtype=np.uint8) for shade in range(1, TILES_PER_ROW + 2)]
    grid = tile_overlays(tiles)
    assert grid.shape == (8, 5 * TILES_PER_ROW, 3)
    assert grid[0, 0, 0] == 1
    assert grid[4, 0, 0] == TILES_PER_ROW + 1
    assert grid[4:, 5:].max() == 0
