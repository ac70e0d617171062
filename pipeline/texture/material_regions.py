"""Regions of the surface that are probably of one material: of similar albedo, and near each other.

K-means of albedo and place (Lloyd, "Least squares quantization in PCM", 1982), as superpixels are made (Achanta et al.,
"SLIC superpixels", 2012). A garment is several regions, since shine may end where the colour does not.
"""

import numpy as np
from jaxtyping import Bool, Float, Int
from scipy.cluster.vq import kmeans2
from scipy.spatial import cKDTree

REGIONS = 40
ALBEDO_SCALE, PLACE_SCALE_M = 0.1, 0.15
"""Differences of albedo (sRGB) and of place that count the same."""

MAX_JOIN_DISTANCE = 2.0
"""Between centres of regions, in these scales: as far as neighbours of one colour are apart."""

SAMPLES, ITERATIONS, SEED = 6000, 15, 0


def material_regions(
    albedo: Float[np.ndarray, "v 3"], vertices: Float[np.ndarray, "v 3"], regions: int = REGIONS
) -> Int[np.ndarray, "v"]:
    """Return the region of each vertex, from 0 on.

    albedo: sRGB. vertices: m, A-pose. regions: at most this many.
    """
    features = _features(albedo, vertices)
    random = np.random.default_rng(SEED)
    chosen = features[random.permutation(len(features))[:SAMPLES]]
    count = min(regions, len(chosen))
    centres, _ = kmeans2(chosen, count, iter=ITERATIONS, minit="++", seed=random, missing="warn")
    return np.asarray(np.unique(cKDTree(centres).query(features)[1], return_inverse=True)[1])


def join_regions(
    region: Int[np.ndarray, "v"],
    is_known: Bool[np.ndarray, "r"],
    albedo: Float[np.ndarray, "v 3"],
    vertices: Float[np.ndarray, "v 3"],
) -> Int[np.ndarray, "v"]:
    """Return the regions, each unknown one joined to the known one that is nearest in albedo and place.

    They keep their numbers. A region farther than `MAX_JOIN_DISTANCE` from all known ones stays as it is.
    """
    known = np.flatnonzero(is_known)
    if not len(known):
        return region
    count = np.bincount(region)
    centres = np.stack([np.bincount(region, axis) for axis in _features(albedo, vertices).T], axis=1) / count[:, None]
    distance, nearest = cKDTree(centres[known]).query(centres)
    joined = np.where(distance < MAX_JOIN_DISTANCE, known[nearest], np.arange(len(count)))
    return np.asarray(joined[region])


def _features(albedo: Float[np.ndarray, "v 3"], vertices: Float[np.ndarray, "v 3"]) -> Float[np.ndarray, "v 6"]:
    return np.column_stack([albedo / ALBEDO_SCALE, vertices / PLACE_SCALE_M]).astype(np.float64)
