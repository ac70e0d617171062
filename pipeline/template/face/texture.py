"""The texture of the face patch: its charts next to the captured atlas, coloured from the captured texture.

Skin takes the colour of the nearest point of the captured surface. An eyeball takes, where its opening shows it, the
colour of the captured surface in front of it, so that the look straight ahead is the filmed one, and the colour of its
white elsewhere. The inside of the mouth is never filmed and has plain colours.
"""

from dataclasses import dataclass

import cv2
import numpy as np
import torch
from jaxtyping import Bool, Float, Int

from pipeline.geometry.atlas import Atlas, Texels, rasterize_texels
from pipeline.geometry.mesh import Mesh
from pipeline.geometry.surface import closest_points_on_mesh
from pipeline.geometry.texture_rendering import sample_texture
from pipeline.template.face.frame import FaceFrame
from pipeline.template.face.front_view import view_from_front
from pipeline.template.face.patch import (
    EYE_LEFT,
    EYE_RIGHT,
    MOUTH,
    SKIN,
    SOCKET_LEFT,
    SOCKET_RIGHT,
    TEETH,
    TONGUE,
    FacePatch,
)
from pipeline.texture.edge_padding import fill_unknown_texels

CHART_BOXES = {
    SKIN: (0.01, 0.31, 0.69, 0.99),
    MOUTH: (0.71, 0.71, 0.99, 0.99),
    SOCKET_LEFT: (0.71, 0.51, 0.84, 0.69),
    SOCKET_RIGHT: (0.86, 0.51, 0.99, 0.69),
    EYE_LEFT: (0.01, 0.01, 0.29, 0.29),
    EYE_RIGHT: (0.31, 0.01, 0.59, 0.29),
    TONGUE: (0.71, 0.31, 0.84, 0.49),
    TEETH: (0.86, 0.31, 0.99, 0.49),
}
"""Left, bottom, right and top of the charts in a square of the size of the captured texture."""

MOUTH_COLOUR, TONGUE_COLOUR, TEETH_COLOUR = (0.36, 0.14, 0.13), (0.66, 0.33, 0.32), (0.86, 0.83, 0.76)
SCLERA_COLOUR = (0.82, 0.79, 0.76)
"""sRGB. Sclera and teeth are darker where the face is: they get the brightness of its skin relative to this one: """

_REFERENCE_SKIN_LUMA = 0.62
_THROAT_DEPTH = 0.35
"""Depth behind the lips, in units of the face, at which the mouth is black."""

_EYE_CHART_RAD = 0.6 * np.pi
"""Angle from the front that the chart of an eyeball covers; what is behind has the colour of its rim."""

_NEAR_M = 0.22
"""Radius around the eyes in which the captured surface is searched."""

_LID_RADII = 1.35
"""Lids are within this multiple of the eyeball's radius."""

_MAX_SIZE_PX = 1024
"""The patch is painted at this size at most, 0.2 mm a texel, and enlarged to that of a larger captured texture."""

_VISIBLE_M = 0.0015
_MIN_EYE_TEXELS = 20
_LUMA = np.array([0.299, 0.587, 0.114])


@dataclass(frozen=True)
class CapturedSurface:
    """The captured mesh with its atlas and maps; roughness: of the highlights, None for one everywhere."""

    mesh: Mesh
    atlas: Atlas
    diffuse: Float[np.ndarray, "s s 3"]
    specular: Float[np.ndarray, "s s"]
    roughness: Float[np.ndarray, "s s"] | None = None

    def stacked_maps(self) -> Float[np.ndarray, "s s c"]:
        """Return diffuse, specular and, where there is one, roughness as the channels of one map."""
        maps = [self.diffuse, self.specular[..., None]]
        return np.concatenate(maps if self.roughness is None else [*maps, self.roughness[..., None]], axis=2)

    @property
    def matte(self) -> tuple[float, ...]:
        """The channels after the colour of `stacked_maps` of a surface without highlights."""
        return (0.0,) if self.roughness is None else (0.0, 1.0)

    def sample(self, points_m: Float[np.ndarray, "n 3"], near_m: Float[np.ndarray, "3"]) -> Float[np.ndarray, "n c"]:
        """Return `stacked_maps` at the nearest surface points; only the surface around `near_m` counts."""
        rows = self._rows_near(near_m)
        _, face, barycentric = closest_points_on_mesh(points_m, Mesh(self.mesh.vertices, self.mesh.faces[rows]))
        corners = self.atlas.uv[self.atlas.faces_uv[rows][face]]
        uv = torch.from_numpy(np.einsum("nk,nkc->nc", barycentric, corners).astype(np.float32))
        return sample_texture(torch.from_numpy(self.stacked_maps()), uv).numpy()

    def drop_to_surface(
        self, points_m: Float[np.ndarray, "n 3"], frame: FaceFrame, steps: int = 4
    ) -> Float[np.ndarray, "n 3"]:
        """Return the points moved along the line of sight onto the surface, which faces the viewer there."""
        near = Mesh(self.mesh.vertices, self.mesh.faces[self._rows_near(frame.origin_m)])
        points = frame.to_face(points_m)
        for _ in range(steps):
            at_m = frame.to_canonical_m(points)
            _, face, barycentric = closest_points_on_mesh(at_m, near)
            points[:, 2] = frame.to_face(np.einsum("nk,nkc->nc", barycentric, near.vertices[near.faces[face]]))[:, 2]
        return frame.to_canonical_m(points)

    def _rows_near(self, centre_m: np.ndarray) -> Int[np.ndarray, "g"]:
        middle = self.mesh.vertices[self.mesh.faces].mean(axis=1)
        return np.flatnonzero(np.linalg.norm(middle - centre_m, axis=1) < _NEAR_M)


def layout_charts(patch: FacePatch) -> Float[np.ndarray, "t 2"]:
    """Return texture coordinates of the patch in the unit square: each part in its box of `CHART_BOXES`."""
    uv = patch.uv.astype(np.float64).copy()
    for eye in (EYE_LEFT, EYE_RIGHT):
        rows = patch.part == eye
        uv[patch.faces_uv[rows]] = _eyeball_uv(patch, eye)[patch.mesh.faces[rows]]
    for part, (left, bottom, right, top) in CHART_BOXES.items():
        used = np.unique(patch.faces_uv[patch.part == part])
        if part == TEETH:
            uv[used] = [0.5 * (left + right), 0.5 * (bottom + top)]
            continue
        low, high = uv[used].min(axis=0), uv[used].max(axis=0)
        scale = float(np.min(np.array([right - left, top - bottom]) / (high - low)))
        uv[used] = np.array([left, bottom]) + (uv[used] - low) * scale
    return uv.astype(np.float32)


def paint_patch(
    patch: FacePatch, uv: Float[np.ndarray, "t 2"], captured: CapturedSurface
) -> Float[np.ndarray, "s s c"]:
    """Return the maps of the patch as `CapturedSurface.stacked_maps`, of the size of the captured ones.

    uv: of `layout_charts`.
    """
    size_px, faces = min(len(captured.diffuse), _MAX_SIZE_PX), patch.mesh.faces.astype(np.int32)
    atlas = Atlas(uv, patch.faces_uv.astype(np.int32), np.zeros(len(uv), np.int32))
    texels = rasterize_texels(atlas, size_px)
    part, points_m = patch.part[texels.face], texels.interpolate(faces, patch.mesh.vertices)
    view = view_from_front(patch.mesh, patch.frame)
    colour = np.tile([0.0, 0.0, 0.0, *captured.matte], (len(part), 1))
    on_skin = np.isin(part, (SKIN, SOCKET_LEFT, SOCKET_RIGHT))
    colour[on_skin] = captured.sample(points_m[on_skin], patch.frame.origin_m)
    brightness = float(np.median(colour[part == SKIN][:, :3] @ _LUMA)) / _REFERENCE_SKIN_LUMA
    shade = float(np.clip(brightness, 0.35, 1.1))
    depth = np.clip(-_behind_lips(patch, points_m[part == MOUTH]) / _THROAT_DEPTH, 0.0, 1.0)[:, None]
    colour[part == MOUTH, :3] = shade * np.array(MOUTH_COLOUR) * (1.0 - 0.85 * depth)
    colour[part == TONGUE, :3] = shade * np.array(TONGUE_COLOUR)
    colour[part == TEETH, :3] = shade * np.array(TEETH_COLOUR)
    in_eye = np.isin(part, (EYE_LEFT, EYE_RIGHT))
    sclera = shade * np.array(SCLERA_COLOUR)
    visible = view.sees(points_m[in_eye], _VISIBLE_M)
    before_m = captured.drop_to_surface(points_m[in_eye], patch.frame)
    filmed = captured.sample(before_m, patch.frame.origin_m)
    colour[in_eye] = _eye_colours(texels, in_eye, visible, filmed, np.append(sclera, captured.matte))
    known = texels.coverage_mask()
    maps = texels.to_texture(colour)
    left, bottom, right, top = CHART_BOXES[TEETH]
    rows, columns = (
        slice(int((1.0 - top) * size_px), int((1.0 - bottom) * size_px)),
        slice(int(left * size_px), int(right * size_px)),
    )
    maps[rows, columns] = (*(shade * np.array(TEETH_COLOUR)), *captured.matte)
    known[rows, columns] = True
    hidden = on_skin & ~view.sees(points_m, _VISIBLE_M) & _near_eyeballs(patch, points_m)
    known[texels.rows[hidden], texels.columns[hidden]] = False
    filled = fill_unknown_texels(maps, known)
    return np.asarray(cv2.resize(filled, captured.diffuse.shape[1::-1], interpolation=cv2.INTER_LINEAR))


def _eye_colours(
    texels: Texels,
    in_eye: Bool[np.ndarray, "t"],
    visible: Bool[np.ndarray, "n"],
    filmed: Float[np.ndarray, "n c"],
    white: Float[np.ndarray, "c"],
) -> Float[np.ndarray, "n c"]:
    """Return the filmed colour where the eyeball is visible between the lids, blended into the colour of the sclera.

    white: usual colour of the sclera in this light, and its gloss; the brightest of what is filmed counts as much.
    """
    sclera = white.copy()
    if visible.sum() > _MIN_EYE_TEXELS:
        luma = filmed[visible, :3] @ _LUMA
        sclera[:3] = 0.5 * (white[:3] + filmed[visible, :3][luma >= np.quantile(luma, 0.8)].mean(axis=0))
    shown = np.zeros((texels.size_px, texels.size_px), dtype=bool)
    image = np.zeros((*shown.shape, len(white)), np.float32)
    rows, columns = texels.rows[in_eye], texels.columns[in_eye]
    shown[rows, columns], image[rows, columns] = visible, filmed
    width = max(1, texels.size_px // 256)
    shown = cv2.erode(shown.astype(np.uint8), np.ones((3, 3))).astype(bool)  # the margin shows the lid
    widened = cv2.dilate(shown.astype(np.float32), np.ones((2 * width + 1, 2 * width + 1)))
    amount = cv2.GaussianBlur(widened, (0, 0), width)[rows, columns, None]
    return amount * fill_unknown_texels(image, shown)[rows, columns] + (1.0 - amount) * sclera


def _near_eyeballs(patch: FacePatch, points_m: Float[np.ndarray, "n 3"]) -> Bool[np.ndarray, "n"]:
    """Return which points are at the lids: the folds of lids take no colour of the eye that is filmed before them."""
    near = np.zeros(len(points_m), dtype=bool)
    for eye in (EYE_LEFT, EYE_RIGHT):
        ball_m = patch.mesh.vertices[patch.vertex_part == eye]
        centre_m, radius_m = 0.5 * (ball_m.min(axis=0) + ball_m.max(axis=0)), 0.5 * np.ptp(ball_m[:, 1])
        near |= np.linalg.norm(points_m - centre_m, axis=1) < _LID_RADII * radius_m
    return near


def _eyeball_uv(patch: FacePatch, eye: int) -> Float[np.ndarray, "v 2"]:
    """Return an azimuthal equidistant map of an eyeball around its front, in [0, 1]."""
    rows = patch.vertex_part == eye
    centre_m = 0.5 * (patch.mesh.vertices[rows].min(axis=0) + patch.mesh.vertices[rows].max(axis=0))
    x, y, z = ((patch.mesh.vertices - centre_m) @ patch.frame.axes.T).T
    across = np.hypot(x, y)
    radius = 0.5 * np.minimum(np.arctan2(across, z) / _EYE_CHART_RAD, 1.0) / np.maximum(across, 1e-9)
    return np.stack([0.5 + radius * x, 0.5 + radius * y], axis=1)


def _behind_lips(patch: FacePatch, points_m: Float[np.ndarray, "n 3"]) -> Float[np.ndarray, "n"]:
    """Return how far in front of the mouth's opening points are, in units of the face; negative inside."""
    depth = patch.frame.to_face(points_m)[:, 2]
    return np.asarray(depth - np.quantile(depth, 0.95))
