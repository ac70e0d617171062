"""Texture the clothed person procedurally: the colour of each texel is a function of the canonical position."""

from dataclasses import dataclass

import cv2
import numpy as np
import torch
from jaxtyping import Float, Int
from scipy.ndimage import distance_transform_edt

from data_tools.synthetic.person.anatomy import ATTACHMENT, EYE, SKIRT, TONGUE, Anatomy
from data_tools.synthetic.person.attachment import HAIRSTYLES
from data_tools.synthetic.person.dressing import ClothedSurface
from data_tools.synthetic.person.face import paint_eyes, paint_skin
from data_tools.synthetic.person.noise import ValueNoise
from data_tools.synthetic.person.outfit import LAYERS, Outfit, compute_layer_depths_m, neckline_depth_m
from data_tools.synthetic.person.skirt import waist_and_hem_m
from pipeline.io.image import to_float
from pipeline.kernels.raster import rasterize

PRINT_WIDTH_M = 0.26
SKIN_LAYER = -1

_GOLD = (0.96, 0.78, 0.22)
_OPAQUE = [255.0]


@dataclass(frozen=True)
class Texels:
    """Surface points of the covered texels; rows are texels."""

    points_m: Float[np.ndarray, "n 3"]
    arm_head_weights: Float[np.ndarray, "n 2"]
    labels: Int[np.ndarray, "n"]


def paint_texture(
    clothed: ClothedSurface, anatomy: Anatomy, outfit: Outfit, noise: ValueNoise, size_px: int
) -> Float[np.ndarray, "s s 3"]:
    """Render the sRGB texture of the clothed surface; uncovered texels take the nearest covered colour."""
    face_id, barycentric = _rasterize_atlas(clothed, size_px)
    covered = face_id >= 0
    texels = _texels(clothed, face_id[covered], barycentric[covered])
    texture = np.zeros((size_px, size_px, 3), dtype=np.float32)
    texture[covered] = _texel_colours(texels, anatomy, outfit, noise)
    rows, columns = distance_transform_edt(~covered, return_distances=False, return_indices=True)
    return texture[rows, columns]


def _rasterize_atlas(
    clothed: ClothedSurface, size_px: int
) -> tuple[Int[np.ndarray, "s s"], Float[np.ndarray, "s s 3"]]:
    """Return face index (-1 if uncovered) and barycentric coordinates at each texel centre; row 0 is v = 1."""
    position_px = torch.from_numpy(clothed.uv * [size_px, -size_px] + [0.0, size_px]).float()
    face_id, barycentric, _ = rasterize(
        position_px, torch.ones(len(position_px)), torch.from_numpy(clothed.faces_uv), size_px, size_px
    )
    return face_id.numpy(), barycentric.numpy()


def _texels(clothed: ClothedSurface, faces: Int[np.ndarray, "n"], barycentric: Float[np.ndarray, "n 3"]) -> Texels:
    corners = clothed.body.faces[faces]
    blend = barycentric[:, :, None]
    return Texels(
        points_m=(clothed.drape_m[corners] * blend).sum(axis=1),
        arm_head_weights=(clothed.arm_head_weights[corners] * blend).sum(axis=1),
        labels=clothed.labels[faces],
    )


def _texel_colours(texels: Texels, anatomy: Anatomy, outfit: Outfit, noise: ValueNoise) -> Float[np.ndarray, "n 3"]:
    """Return the colour of the outermost layer at each texel."""
    depths = compute_layer_depths_m(texels.points_m, texels.arm_head_weights, anatomy, outfit)
    outermost = np.full(len(depths), SKIN_LAYER)
    for column in range(len(LAYERS)):
        outermost[depths[:, column] > 0] = column
    outermost[texels.labels != 0] = SKIN_LAYER
    colours = np.empty((len(depths), 3), dtype=np.float32)
    for column, layer in enumerate(LAYERS):
        rows = outermost == column
        colours[rows] = _PAINTERS[layer](texels.points_m[rows], depths[rows, column], anatomy, outfit, noise)
    rows = outermost == SKIN_LAYER
    colours[rows] = paint_skin(texels.points_m[rows], anatomy, outfit, noise)
    rows = texels.labels == EYE
    colours[rows] = paint_eyes(texels.points_m[rows], anatomy, outfit)
    colours[texels.labels == TONGUE] = (0.55, 0.25, 0.25)
    rows = texels.labels == SKIRT
    colours[rows] = _paint_skirt(texels.points_m[rows], anatomy, outfit, noise)
    rows = texels.labels == ATTACHMENT
    paint = _paint_hair if outfit.attachment in HAIRSTYLES else _paint_cotton
    colours[rows] = paint(texels.points_m[rows], depths[rows, 0], anatomy, outfit, noise)
    return np.clip(colours, 0.0, 1.0)


def _shaded(base: tuple[float, float, float], brightness: Float[np.ndarray, "n"]) -> Float[np.ndarray, "n 3"]:
    return np.asarray(base, dtype=np.float32) * brightness[:, None]


def _paint_shirt(
    points: np.ndarray, depth: np.ndarray, anatomy: Anatomy, outfit: Outfit, noise: ValueNoise
) -> Float[np.ndarray, "n 3"]:
    """Colour knitted cloth with two stripes, a collar, an emblem on the chest and a number on the back."""
    hips, weave = anatomy.joints_m["Hips"], noise(points, 0.0022) * 0.05 + noise.fractal(points, 0.06) * 0.05
    colours = _shaded(outfit.shirt, 1.0 + weave)
    above_hem = points[:, 1] - (hips[1] - outfit.shirt_below_hips_m)
    from_hem = np.where(np.abs(points[:, 0]) < anatomy.joints_m["LeftArm"][0], above_hem, depth)
    below_collar = neckline_depth_m(points, anatomy)
    striped = ((from_hem > 0.045) & (from_hem < 0.062)) | ((from_hem > 0.075) & (from_hem < 0.082))
    colours[striped] = _shaded(outfit.stripe, 1.0 + weave)[striped]
    at_collar = below_collar < 0.016
    colours[at_collar] = _shaded(outfit.stripe, 0.92 + weave)[at_collar]
    seam = (np.abs(depth - 0.012) < 0.0012) & (below_collar > 0.05)
    colours[seam] *= 0.72
    for is_front in (True, False):
        _project_print(colours, points, anatomy, outfit, is_front)
    return colours


def _project_print(
    colours: Float[np.ndarray, "n 3"], points: np.ndarray, anatomy: Anatomy, outfit: Outfit, is_front: bool
) -> None:
    """Project the emblem onto the chest, or the number onto the back, along Z; blend into `colours` in place."""
    chest = 0.5 * (anatomy.joints_m["Spine2"] + anatomy.joints_m["Spine1"])
    middle_z = anatomy.joints_m["LeftArm"][2]
    across = (points[:, 0] - chest[0]) * (1.0 if is_front else -1.0)
    rows = (points[:, 2] > middle_z) == is_front
    artwork = _emblem(outfit) if is_front else _number(outfit)
    size_px = len(artwork)
    column_px = (across / PRINT_WIDTH_M + 0.5) * size_px
    row_px = (0.5 - (points[:, 1] - chest[1] - 0.03) / PRINT_WIDTH_M) * size_px
    rows &= (column_px >= 0) & (column_px < size_px) & (row_px >= 0) & (row_px < size_px)
    ink = artwork[row_px[rows].astype(int), column_px[rows].astype(int)]
    colours[rows] += ink[:, 3:] * (ink[:, :3] - colours[rows])


def _emblem(outfit: Outfit, size_px: int = 768) -> Float[np.ndarray, "s s 4"]:
    """Draw a ring around a five-pointed star with text below; straight RGBA in [0, 1]."""
    colour, dark = _rgb(outfit.stripe), _rgb(tuple(0.35 * c for c in outfit.shirt))
    art, alpha = np.zeros((size_px, size_px, 3), np.uint8), np.zeros((size_px, size_px), np.uint8)
    centre, unit = (size_px // 2, int(0.40 * size_px)), size_px / 768
    angles = np.pi * (np.arange(10) / 5.0 - 0.5)
    radii = np.where(np.arange(10) % 2 == 0, 215, 88) * unit
    star = np.rint(np.stack([np.cos(angles), np.sin(angles)], 1) * radii[:, None] + centre).astype(np.int32)
    text_origin_px = (int(118 * unit), int(706 * unit))
    for canvas, ring, inner, gold in ((art, colour, dark, _rgb(_GOLD)), (alpha, _OPAQUE, _OPAQUE, _OPAQUE)):
        cv2.circle(canvas, centre, int(262 * unit), ring, -1, cv2.LINE_AA)
        cv2.circle(canvas, centre, int(226 * unit), inner, -1, cv2.LINE_AA)
        cv2.fillPoly(canvas, [star], gold, cv2.LINE_AA)
        cv2.putText(canvas, "NORTH " + outfit.print_text, text_origin_px, cv2.FONT_HERSHEY_DUPLEX, 2.9 * unit, ring, 9)
    return to_float(np.dstack([art, alpha]))


def _number(outfit: Outfit, size_px: int = 768) -> Float[np.ndarray, "s s 4"]:
    """Draw the number in large digits; straight RGBA in [0, 1]."""
    art = np.zeros((size_px, size_px, 3), np.uint8)
    art[:] = _rgb(outfit.stripe)
    alpha = np.zeros((size_px, size_px), np.uint8)
    scale = 15.0 * size_px / 768
    (width, height), _ = cv2.getTextSize(outfit.print_text, cv2.FONT_HERSHEY_SIMPLEX, scale, 60)
    text_origin_px = ((size_px - width) // 2, (size_px + height) // 2)
    cv2.putText(alpha, outfit.print_text, text_origin_px, cv2.FONT_HERSHEY_SIMPLEX, scale, _OPAQUE, 60, cv2.LINE_AA)
    return to_float(np.dstack([art, alpha]))


def _rgb(colour: tuple[float, ...]) -> list[float]:
    """Convert a colour from [0, 1] to the range 0 to 255 that OpenCV draws."""
    return [float(round(255 * c)) for c in colour]


def _paint_trousers(
    points: np.ndarray, depth: np.ndarray, anatomy: Anatomy, outfit: Outfit, noise: ValueNoise
) -> Float[np.ndarray, "n 3"]:
    """Colour twill with worn thighs, side seams, front pockets and a stitched hem."""
    joints = anatomy.joints_m
    twill = noise(points, (0.0018, 0.012, 0.0018)) * 0.13 + noise.fractal(points, 0.09) * 0.10
    thigh_y = 0.5 * (joints["LeftUpLeg"][1] + joints["LeftLeg"][1])
    worn = 0.22 * np.exp(-(((points[:, 1] - thigh_y) / 0.16) ** 2)) * (points[:, 2] > joints["LeftUpLeg"][2] + 0.03)
    colours = _shaded(outfit.trousers, 1.0 + twill + worn)
    leg = np.stack([joints[f"Left{name}"] for name in ("Foot", "Leg", "UpLeg")])
    leg_x, leg_z = (np.interp(points[:, 1], leg[:, 1], leg[:, axis]) for axis in (0, 2))
    on_side_seam = (np.abs(points[:, 2] - leg_z) < 0.0022) & (np.abs(points[:, 0]) > leg_x)
    stitched = (points[:, 1] < joints["LeftFoot"][1] + 0.02) & (np.abs(depth - 0.016) < 0.0014)
    colours[on_side_seam] *= 0.62
    colours[stitched] = colours[stitched] * 0.3 + np.array([0.55, 0.42, 0.22]) * 0.7
    return colours


def _paint_skirt(points: np.ndarray, anatomy: Anatomy, outfit: Outfit, noise: ValueNoise) -> Float[np.ndarray, "n 3"]:
    """Colour plaid wool: translucent horizontal and vertical bands, and two lines above the hem."""
    hips, weave = anatomy.joints_m["Hips"], noise(points, 0.0025) * 0.06 + noise.fractal(points, 0.08) * 0.06
    angle = np.arctan2(points[:, 2] - hips[2], points[:, 0] - hips[0])
    above_hem = points[:, 1] - waist_and_hem_m(anatomy, outfit)[1]
    colours = _shaded(outfit.skirt, 1.0 + weave)
    around, down = np.mod(above_hem + 0.02, 0.11) < 0.035, np.mod(angle / (2.0 * np.pi) * 16.0, 1.0) < 0.3
    on_thin_line = (np.abs(np.mod(above_hem, 0.11) - 0.062) < 0.003) | (np.abs(above_hem - 0.012) < 0.004)
    ink = _shaded(outfit.plaid, 1.0 + weave)
    opacity = 0.45 * around + 0.30 * down + 0.5 * on_thin_line
    return colours + np.minimum(opacity, 0.9)[:, None] * (ink - colours)


def _paint_shoes(
    points: np.ndarray, depth: np.ndarray, anatomy: Anatomy, outfit: Outfit, noise: ValueNoise
) -> Float[np.ndarray, "n 3"]:
    """Colour canvas shoes with light sole, toe cap and laces."""
    foot, toes = anatomy.joints_m["LeftFoot"], anatomy.joints_m["LeftToeBase"]
    colours = _shaded(outfit.shoes, 1.0 + noise(points, 0.004) * 0.10)
    on_tongue = (points[:, 2] > foot[2] + 0.05) & (points[:, 2] < toes[2] - 0.01) & (points[:, 1] > 0.045)
    laced = on_tongue & (np.abs(np.abs(points[:, 0]) - foot[0]) < 0.022) & (np.mod(points[:, 2], 0.018) < 0.007)
    is_light_part = (points[:, 1] < 0.020) | (points[:, 2] > toes[2] + 0.045) | laced
    colours[is_light_part] = np.array([0.90, 0.89, 0.86]) * (1.0 + noise(points, 0.02)[is_light_part, None] * 0.04)
    return colours


def _paint_hair(
    points: np.ndarray, depth: np.ndarray, anatomy: Anatomy, outfit: Outfit, noise: ValueNoise
) -> Float[np.ndarray, "n 3"]:
    """Colour hair with strands that run down and back from the crown."""
    strands = noise(points, (0.0028, 0.03, 0.03)) * 0.34 + noise(points + 5.0, (0.009, 0.05, 0.05)) * 0.28
    return _shaded(outfit.hair, 1.12 + strands)


def _paint_cotton(
    points: np.ndarray, depth: np.ndarray, anatomy: Anatomy, outfit: Outfit, noise: ValueNoise
) -> Float[np.ndarray, "n 3"]:
    """Colour cotton with seams from the crown down."""
    skull = anatomy.skull_m()
    angle = np.arctan2(points[:, 2] - skull[2], points[:, 0] - skull[0])
    colours = _shaded(outfit.stripe, 1.0 + noise(points, 0.003) * 0.05)
    on_seam = (np.abs(np.mod(angle / np.pi * 3.0 + 0.5, 1.0) - 0.5) < 0.02) & (points[:, 1] > skull[1] + 0.05)
    colours[on_seam] *= 0.7
    return colours


_PAINTERS = {"shoes": _paint_shoes, "trousers": _paint_trousers, "shirt": _paint_shirt, "hair": _paint_hair}
