"""Hands that show the colour of what they touch: trousers, where they hang beside them, or a shirt, on the hip.

Fitted hands may be centimetres off, so that frames show the clothes behind where a hand should be. Both hands of a
person have one colour; pixels whose chromaticity is not that of most, near another limb, are not of the hand.
"""

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
import torch
from jaxtyping import Int
from scipy.spatial import cKDTree

from pipeline.kernels.common.opencv_threads import single_threaded_opencv
from pipeline.kernels.common.thread_pool import shared_thread_pool
from pipeline.texture.bake import TexturedSurface, sample_frame_colours
from pipeline.texture.contact import Limbs
from pipeline.texture.lighting.light_fit import weighted_median
from pipeline.texture.settings import TextureSettings
from pipeline.texture.views import BakeView

MIN_CHROMA_DIFFERENCE, SPREADS = 0.1, 4.0
"""Difference of a chromaticity (a share of red + green + blue) from the usual one, and how many usual differences, from
which on a pixel is not of the hand. That is at most 0.3 % of the pixels of hands away from the body, 1 to 11 % of hands
that hang beside trousers, and half of those of a hand on the hip."""
HAND_REACH_M = 0.12
"""Distance from another limb up to which a hand may be mistaken for it."""
MIN_BRIGHTNESS = 0.1
"""Red + green + blue below which a chromaticity is noise."""


def hide_foreign_hands(
    views: Sequence[BakeView], surface: TexturedSurface, limbs: Limbs, settings: TextureSettings
) -> list[BakeView]:
    """Return the views as if vertices of hands that show another limb's colour faced away from the camera.

    surface: its texels are the vertices; their columns are the vertex indices.
    """
    hands = replace(surface, texels=surface.texels.select(limbs.is_hand[surface.texels.columns]))
    vertex = hands.texels.columns
    if not len(vertex) or not views:
        return list(views)
    pool = shared_thread_pool(torch.get_num_threads())
    with single_threaded_opencv():
        samples = pool.map(lambda view: sample_frame_colours(view, hands, settings), views)
    colour, weight = (np.stack([part.numpy() for part in parts]) for parts in zip(*samples, strict=True))
    chroma = colour / np.maximum(colour.sum(axis=2, keepdims=True), MIN_BRIGHTNESS)
    seen = weight > 0.0
    if not seen.any():
        return list(views)
    usual = np.array([weighted_median(chroma[seen][:, channel], weight[seen]) for channel in range(3)])
    difference = np.abs(chroma - usual).max(axis=2)
    limit = max(MIN_CHROMA_DIFFERENCE, SPREADS * weighted_median(difference[seen], weight[seen]))
    is_foreign = seen & (difference > limit)
    return [_hide_near_others(view, vertex[rows], limbs) for view, rows in zip(views, is_foreign, strict=True)]


def _hide_near_others(view: BakeView, vertices: Int[np.ndarray, "k"], limbs: Limbs) -> BakeView:
    """Return the view without those of some vertices that are near another limb."""
    places_m, cosine = view.vertices_world.numpy(), view.view_cosine.clone()
    for own in np.unique(limbs.limb[vertices]):
        of_limb = vertices[limbs.limb[vertices] == own]
        others = cKDTree(places_m[limbs.limb != own])
        is_near = np.isfinite(others.query(places_m[of_limb], distance_upper_bound=HAND_REACH_M)[0])
        cosine[torch.from_numpy(of_limb[is_near])] = 0.0
    return replace(view, view_cosine=cosine)
