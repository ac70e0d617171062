"""Regions of the surface that are probably of one material: of similar albedo, and near each other.

K-means of albedo and place (Lloyd, "Least squares quantization in PCM", 1982), as superpixels are made (Achanta et al.,
"SLIC superpixels", 2012). A garment is several regions, since shine may end where the colour does not.
"""

import numpy as np
from jaxtyping import Float, Int
from scipy.cluster.vq import kmeans2
from scipy.spatial import cKDTree

REGIONS = 40
ALBEDO_SCALE, PLACE_SCALE_M = 0.1, 0.15
"""Differences of albedo (sRGB) and of place that count the same."""

SAMPLES, ITERATIONS, SEED = 6000, 15, 0


def material_regions(
    albedo: Float[np.ndarray, "v 3"], vertices: Float[np.ndarray, "v 3"], regions: int = REGIONS
) -> Int[np.ndarray, "v"]:
    """Return the region of each vertex, from 0 on.

    albedo: sRGB. vertices: m, A-pose. regions: at most this many.
    """
    features = np.column_stack([albedo / ALBEDO_SCALE, vertices / PLACE_SCALE_M]).astype(np.float64)
    random = np.random.default_rng(SEED)
    chosen = features[random.permutation(len(features))[:SAMPLES]]
    count = min(regions, len(chosen))
    centres, _ = kmeans2(chosen, count, iter=ITERATIONS, minit="++", seed=random, missing="warn")
    return np.asarray(np.unique(cKDTree(centres).query(features)[1], return_inverse=True)[1])
