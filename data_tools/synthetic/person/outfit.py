"""Outfit of the built-in person, and the regions of the body that each clothing layer covers."""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float

from data_tools.synthetic.person.anatomy import Anatomy

LAYERS = ("shoes", "trousers", "shirt", "hair")
"""Offset surfaces from the skin outwards; a later layer occludes an earlier one."""

LEGWEAR = ("trousers", "skirt")
"""Clothing of the legs: a layer, or the separate surface of `data_tools.synthetic.person.skirt`."""

TUCKED_SHIRT_BELOW_HIPS_M = -0.03
"""`Outfit.shirt_below_hips_m` of a shirt that is tucked into a skirt."""

JACKET_SLEEVE_FRACTION = 0.96
"""Length of the sleeves of a jacket relative to the arm without the hand."""

JACKET_SEAM_SPACING_M, JACKET_BORDER_M = 0.09, 0.05
"""Heights between two seams, and distance from the borders within which the padding grows."""

CROTCH_BELOW_HIPS_M = 0.08

HEM_FLARE_M = 0.07
"""Default of `Outfit.hem_flare_m`."""

Colour = tuple[float, float, float]


@dataclass(frozen=True)
class Outfit:
    """Cuts of the clothes, and colours (sRGB in [0, 1]).

    Attributes:
        legwear: one of `LEGWEAR`.
        sleeve_fraction: length of the sleeve relative to the upper arm.
        shirt_below_hips_m: height of the hips above the hem of the shirt.
        plaid: second colour of the skirt.
        hem_flare_m: additional radius of the skirt at the hem, compared with cloth that falls straight.
        sleeve_flare_m: additional radius of the sleeves at their hem.
        trouser_flare_m: additional radius of the trousers at their hem.
        jacket_m: additional thickness of a padded jacket, whose sleeves reach the wrists; 0: a shirt.
        heel_m: height of the heels of the feet above the floor in shoes.
        hem_m: height of the hem of the skirt above the floor; None: above the knees.
        attachment: one of `data_tools.synthetic.person.attachment.ATTACHMENTS`.
    """

    legwear: str
    sleeve_fraction: float
    shirt_below_hips_m: float
    shirt: Colour
    stripe: Colour
    trousers: Colour
    skirt: Colour
    plaid: Colour
    shoes: Colour
    hair: Colour
    iris: Colour
    skin: Colour
    print_text: str
    hem_flare_m: float = HEM_FLARE_M
    sleeve_flare_m: float = 0.0
    trouser_flare_m: float = 0.0
    jacket_m: float = 0.0
    heel_m: float = 0.0
    attachment: str | None = None
    hem_m: float | None = None


_SHIRTS: tuple[tuple[Colour, Colour], ...] = (
    ((0.72, 0.13, 0.14), (0.93, 0.90, 0.84)),
    ((0.13, 0.33, 0.55), (0.95, 0.80, 0.25)),
    ((0.88, 0.86, 0.80), (0.15, 0.42, 0.36)),
    ((0.16, 0.45, 0.30), (0.94, 0.93, 0.88)),
)
_TROUSERS: tuple[Colour, ...] = ((0.22, 0.29, 0.42), (0.55, 0.47, 0.35), (0.20, 0.20, 0.22))
_SKIRTS: tuple[tuple[Colour, Colour], ...] = (
    ((0.16, 0.36, 0.40), (0.93, 0.76, 0.33)),
    ((0.52, 0.16, 0.26), (0.92, 0.88, 0.80)),
    ((0.74, 0.66, 0.50), (0.28, 0.20, 0.34)),
)
_SHOES: tuple[Colour, ...] = ((0.16, 0.17, 0.20), (0.50, 0.20, 0.16), (0.30, 0.36, 0.40))
_HAIR: tuple[Colour, ...] = ((0.17, 0.11, 0.08), (0.07, 0.06, 0.06), (0.42, 0.27, 0.14))
_IRIS: tuple[Colour, ...] = ((0.30, 0.19, 0.10), (0.25, 0.38, 0.48), (0.28, 0.36, 0.22))
_SKIN: tuple[Colour, ...] = ((0.86, 0.65, 0.54), (0.72, 0.51, 0.39), (0.52, 0.35, 0.26))


def choose_outfit(seed: int, legwear: str = "trousers") -> Outfit:
    """Choose the outfit of a seed; seed 0 takes the first of each colour. legwear: one of `LEGWEAR`."""
    choice_indices = np.random.default_rng(seed).integers(0, 1_000_000, 6) if seed else np.zeros(6, dtype=np.int64)
    shirt, stripe = _SHIRTS[choice_indices[0] % len(_SHIRTS)]
    skirt, plaid = _SKIRTS[choice_indices[1] % len(_SKIRTS)]
    return Outfit(
        legwear=legwear,
        sleeve_fraction=0.66,
        shirt_below_hips_m=0.07 if legwear == "trousers" else TUCKED_SHIRT_BELOW_HIPS_M,
        shirt=shirt,
        stripe=stripe,
        trousers=_TROUSERS[choice_indices[1] % len(_TROUSERS)],
        skirt=skirt,
        plaid=plaid,
        shoes=_SHOES[choice_indices[2] % len(_SHOES)],
        hair=_HAIR[choice_indices[3] % len(_HAIR)],
        iris=_IRIS[choice_indices[4] % len(_IRIS)],
        skin=_SKIN[choice_indices[5] % len(_SKIN)],
        print_text=f"{24 + seed % 70:02d}",
    )


def compute_layer_depths_m(
    points_m: Float[np.ndarray, "n 3"], arm_head_weights: Float[np.ndarray, "n 2"], anatomy: Anatomy, outfit: Outfit
) -> Float[np.ndarray, "n 4"]:
    """Compute the signed distance of surface points to the border of each of `LAYERS`, metres; negative outside.

    Args:
        points_m: canonical positions in the A-pose.
        arm_head_weights: from `anatomy.compute_arm_head_weights`.
    """
    height = points_m[:, 1]
    on_arm, on_head = arm_head_weights[:, 0] > 0.5, arm_head_weights[:, 1] > 0.35
    foot, hips = anatomy.joints_m["LeftFoot"], anatomy.joints_m["Hips"]
    trousers = np.minimum(hips[1] + 0.03 - height, height - (foot[1] - 0.025))
    if outfit.legwear != "trousers":
        trousers = np.full_like(trousers, -1.0)
    shirt = np.minimum(neckline_depth_m(points_m, anatomy), height - (hips[1] - outfit.shirt_below_hips_m))
    depths = [
        foot[1] + 0.02 - height,
        np.where(on_arm, -1.0, trousers),
        np.where(on_arm, _sleeve_depth_m(points_m, anatomy, outfit), shirt),
        np.where(on_head, _hair_depth_m(points_m, anatomy), -1.0),
    ]
    return np.stack(depths, axis=1).astype(np.float32)


def neckline_depth_m(points_m: Float[np.ndarray, "n 3"], anatomy: Anatomy) -> Float[np.ndarray, "n"]:
    """Return the depth below the neckline: a plane through the root of the neck, lower at the front."""
    normal = np.array([0.0, 1.0, 0.62]) / np.hypot(1.0, 0.62)
    root = anatomy.joints_m["Neck"] + np.array([0.0, 0.012, 0.0])
    return _dot(root - points_m, normal)


def _sleeve_depth_m(points_m: Float[np.ndarray, "n 3"], anatomy: Anatomy, outfit: Outfit) -> Float[np.ndarray, "n"]:
    """Return the distance along the upper arm, or the arm, to the hem of the sleeve."""
    joints = anatomy.joints_m
    depth = np.empty(len(points_m))
    is_left = points_m[:, 0] > joints["Hips"][0]
    for side, rows in (("Left", is_left), ("Right", ~is_left)):
        shoulder, end = joints[f"{side}Arm"], joints[f"{side}Hand" if outfit.jacket_m else f"{side}ForeArm"]
        length = np.linalg.norm(end - shoulder)
        along = _dot(points_m[rows] - shoulder, end - shoulder) / length
        depth[rows] = (JACKET_SLEEVE_FRACTION if outfit.jacket_m else outfit.sleeve_fraction) * length - along
    return depth


def sleeve_flare_offset_m(
    points_m: Float[np.ndarray, "n 3"], arm_head_weights: Float[np.ndarray, "n 2"], anatomy: Anatomy, outfit: Outfit
) -> Float[np.ndarray, "n"]:
    """Return the additional thickness of the shirt: from 0 at the shoulder to `Outfit.sleeve_flare_m` at the hem.

    Arguments as in `compute_layer_depths_m`.
    """
    upper_arm_m = np.linalg.norm(anatomy.joints_m["LeftForeArm"] - anatomy.joints_m["LeftArm"])
    to_hem = 1.0 - _sleeve_depth_m(points_m, anatomy, outfit) / (outfit.sleeve_fraction * upper_arm_m)
    return outfit.sleeve_flare_m * np.where(arm_head_weights[:, 0] > 0.5, np.clip(to_hem, 0.0, 1.0), 0.0)


def jacket_offset_m(
    points_m: Float[np.ndarray, "n 3"], depth_m: Float[np.ndarray, "n"], outfit: Outfit
) -> Float[np.ndarray, "n"]:
    """Return the additional thickness of a padded jacket: three quarters at its seams, none at its borders.

    depth_m: of the shirt, from `compute_layer_depths_m`.
    """
    bulge = np.abs(np.sin(np.pi * points_m[:, 1] / JACKET_SEAM_SPACING_M)) ** 0.5
    return outfit.jacket_m * np.clip(depth_m / JACKET_BORDER_M, 0.0, 1.0) * (0.75 + 0.25 * bulge)


def trouser_flare_offset_m(
    points_m: Float[np.ndarray, "n 3"], anatomy: Anatomy, outfit: Outfit
) -> Float[np.ndarray, "n"]:
    """Return the additional thickness of the trousers: from 0 at the crotch to `Outfit.trouser_flare_m` at the hem."""
    crotch, foot = anatomy.joints_m["Hips"][1] - CROTCH_BELOW_HIPS_M, anatomy.joints_m["LeftFoot"][1]
    return outfit.trouser_flare_m * np.clip((crotch - points_m[:, 1]) / (crotch - foot), 0.0, 1.0)


def _hair_depth_m(points_m: Float[np.ndarray, "n 3"], anatomy: Anatomy) -> Float[np.ndarray, "n"]:
    """Return the depth inside the hair region: forehead, around the ears, nape."""
    from_skull = points_m - anatomy.skull_m()
    side = np.abs(from_skull[:, 0])
    hairline = 0.62 * from_skull[:, 1] - 0.78 * from_skull[:, 2] + 0.024 + 0.12 * np.maximum(side - 0.03, 0.0)
    nape = points_m[:, 1] - (anatomy.mouth_m[1] + 0.012)
    ear_distance_m = np.linalg.norm((points_m[:, None] - anatomy.ears_m) / np.array([2.0, 1.0, 0.72]), axis=2).min(
        axis=1
    )
    return np.minimum(np.minimum(hairline, nape), ear_distance_m - 0.037)


def _dot(points: Float[np.ndarray, "n 3"], direction: Float[np.ndarray, "3"]) -> Float[np.ndarray, "n"]:
    """Return inner products in a fixed summation order; BLAS results depend on the number of threads."""
    return points[:, 0] * direction[0] + points[:, 1] * direction[1] + points[:, 2] * direction[2]
