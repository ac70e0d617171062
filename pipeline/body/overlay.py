"""Overlay image of a fit: the body over some frames, left side orange, right side blue, with marked problems."""

from collections.abc import Sequence

import cv2
import numpy as np
import torch
from jaxtyping import Bool, Float, UInt8
from torch import Tensor

from pipeline.body.body import Body
from pipeline.geometry.camera import Camera, project
from pipeline.geometry.mesh import Mesh
from pipeline.geometry.skinning import linear_blend_skinning
from pipeline.kernels.raster import rasterize

TILE_ROWS = 480
TILE_COLUMNS = 360
TILES_PER_ROW = 6

LEFT_RGB, RIGHT_RGB, MIDDLE_RGB = (255.0, 150.0, 60.0), (70.0, 150.0, 255.0), (215.0, 215.0, 215.0)
BODY_OUTLINE_RGB, MASK_OUTLINE_RGB = (255, 235, 0), (0, 255, 255)
WARNING_RGB = (255, 40, 40)
BODY_OPACITY = 0.55
"""Opacity of the body over the image."""


def side_colours(body: Body) -> Float[np.ndarray, "f 3"]:
    """Return a colour (0 to 255) of every face by the side of its main joint, so that left-right swaps are visible."""
    sides = np.array([("Left" in name) - ("Right" in name) for name in body.joint_names])
    side = sides[body.skin_weights.argmax(axis=1)][body.faces[:, 0]]
    return np.array([MIDDLE_RGB, LEFT_RGB, RIGHT_RGB])[side]


def pose_vertices(body: Body, canonical_to_world: Float[Tensor, "j 4 4"]) -> Float[Tensor, "v 3"]:
    """Return the world vertices of the body in one pose."""
    return linear_blend_skinning(
        torch.as_tensor(body.vertices), torch.as_tensor(body.skin_weights), canonical_to_world[None]
    )[0]


def draw_overlay(
    image: UInt8[np.ndarray, "h w 3"],
    mask: UInt8[np.ndarray, "h w"],
    vertices_world: Float[Tensor, "v 3"],
    body: Body,
    camera: Camera,
    caption: str,
    warning: str = "",
) -> UInt8[np.ndarray, "tile_h tile_w 3"]:
    """Return a tile: the shaded body over the darkened frame, its outline yellow, the outline of the mask cyan.

    warning: problem of the frame, printed after the caption; a frame with a warning gets a red border.
    """
    vertices_px, depth_m = project(vertices_world, camera)
    faces = torch.as_tensor(body.faces)
    face_id, _, _ = rasterize(vertices_px, depth_m, faces, image.shape[0], image.shape[1])
    visible_face = face_id.numpy()
    covered = visible_face >= 0
    to_camera = Mesh(vertices_world.numpy(), body.faces).face_normals() @ _view_direction(vertices_world, camera)
    shade = 0.25 + 0.75 * np.clip(to_camera, 0.0, 1.0)
    colours = side_colours(body) * shade[:, None]
    shaded = image.astype(np.float32) * 0.8
    shaded[covered] = (1.0 - BODY_OPACITY) * shaded[covered] + BODY_OPACITY * colours[visible_face[covered]]
    tile, to_tile = _crop(shaded.round().astype(np.uint8), covered | (mask > 127))
    _outline(tile, _crop_like(mask > 127, to_tile, tile), MASK_OUTLINE_RGB)
    _outline(tile, _crop_like(covered, to_tile, tile), BODY_OUTLINE_RGB)
    label = f"{caption}  {warning}"
    cv2.putText(tile, label, (8, TILE_ROWS - 8), cv2.FONT_HERSHEY_SIMPLEX, 0.5, (255, 255, 255), 1, cv2.LINE_AA)
    if warning:
        cv2.rectangle(tile, (1, 1), (TILE_COLUMNS - 2, TILE_ROWS - 2), WARNING_RGB, 3)
    return tile


def tile_overlays(tiles: Sequence[UInt8[np.ndarray, "tile_h tile_w 3"]]) -> UInt8[np.ndarray, "h w 3"]:
    """Return tiles in rows of `TILES_PER_ROW`, with black tiles at the end of the last row."""
    filled = list(tiles) + [np.zeros_like(tiles[0])] * (-len(tiles) % TILES_PER_ROW)
    rows = [
        np.concatenate(filled[start : start + TILES_PER_ROW], axis=1) for start in range(0, len(filled), TILES_PER_ROW)
    ]
    return np.concatenate(rows, axis=0)


def _view_direction(vertices_world: Float[Tensor, "v 3"], camera: Camera) -> Float[np.ndarray, "3"]:
    """Return the unit vector from the centroid of the body to the camera."""
    to_camera = camera.centre_m() - vertices_world.mean(0).numpy()
    return to_camera / np.linalg.norm(to_camera)


def _crop(
    image: UInt8[np.ndarray, "h w 3"], person: Bool[np.ndarray, "h w"]
) -> tuple[UInt8[np.ndarray, "tile_h tile_w 3"], Float[np.ndarray, "2 3"]]:
    """Return a tile filled by the person, and the affine map from image to tile (pixel indices)."""
    rows, columns = np.flatnonzero(person.any(1)), np.flatnonzero(person.any(0))
    if len(rows) == 0:
        rows, columns = np.array([0, image.shape[0] - 1]), np.array([0, image.shape[1] - 1])
    scale = 0.92 * min(TILE_ROWS / (rows[-1] - rows[0] + 1), TILE_COLUMNS / (columns[-1] - columns[0] + 1))
    centre = 0.5 * np.array([columns[0] + columns[-1], rows[0] + rows[-1]])
    shift = 0.5 * np.array([TILE_COLUMNS, TILE_ROWS]) - scale * centre
    to_tile = np.array([[scale, 0.0, shift[0]], [0.0, scale, shift[1]]])
    return cv2.warpAffine(image, to_tile, (TILE_COLUMNS, TILE_ROWS), flags=cv2.INTER_LINEAR), to_tile


def _crop_like(
    area: Bool[np.ndarray, "h w"], to_tile: Float[np.ndarray, "2 3"], tile: UInt8[np.ndarray, "tile_h tile_w 3"]
) -> UInt8[np.ndarray, "tile_h tile_w"]:
    return cv2.warpAffine(area.astype(np.uint8), to_tile, tile.shape[1::-1], flags=cv2.INTER_LINEAR)


def _outline(
    tile: UInt8[np.ndarray, "tile_h tile_w 3"], area: UInt8[np.ndarray, "tile_h tile_w"], rgb: tuple[int, int, int]
) -> None:
    outlines, _ = cv2.findContours(area, cv2.RETR_LIST, cv2.CHAIN_APPROX_NONE)
    cv2.drawContours(tile, outlines, -1, rgb, 1)
