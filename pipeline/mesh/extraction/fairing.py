"""Fairing of the extracted surface: a smooth offset from the fitted body.

The density determines the depth of a surface without texture to a few millimetres only, so that the extracted surface
has bumps. Cloth that lies on a body varies over lengths in proportion to the thickness of the part it covers. The
offset, the signed distance to the extracted surface less that to the body, is therefore smoothed by a Gaussian whose
standard deviation is a fraction of the local thickness, and added to the signed distance to the body again.

Where few frames show the surface (`pipeline.mesh.extraction.evidence`) the density is arbitrary. There the offset is
that of what is seen around it, farther away the less is seen: a normalised convolution (Knutsson and Westin,
"Normalized and differential convolution", 1993). What no frame shows is thus as far off the body as what is seen beside
it. A skirt is completed before (`pipeline.mesh.extraction.skirt_ring`); what is added is smooth, and keeps its hem.

Hands and the skin of the head keep the details of the body model (fingers, nose, lips); elsewhere the body is smoothed
in the same way first, because cloth and hair do not show them. In the face the offset is smoothed over a fixed length.
Convex parts do not shrink as they would if the surface itself were smoothed.

Local thickness: Hildebrand and Ruegsegger, "A new method for the model-independent assessment of thickness in
three-dimensional images", 1997.

Grids with half the resolution of the canonical grid are called coarse.
"""

import numpy as np
from jaxtyping import Bool, Float
from scipy import ndimage
from scipy.spatial import cKDTree

from pipeline.body.body import Body
from pipeline.geometry.mesh import Mesh
from pipeline.geometry.surface import isosurface, repair, signed_distance_m
from pipeline.mesh.extraction.between_legs import close_valleys
from pipeline.mesh.extraction.evidence import Evidence
from pipeline.mesh.extraction.isosurface import CanonicalGrid, signed_distance_grid, upsample
from pipeline.mesh.extraction.skirt_ring import complete_skirt
from pipeline.mesh.face import face_weight, head_skin_weight, head_vertices
from pipeline.mesh.settings import MeshSettings

SIGMAS_M = (0.0, 0.005, 0.01, 0.02, 0.03, 0.06)
"""Standard deviations of the smoothed offsets that are blended."""
FACE_SIGMA_M, UNSEEN_SIGMA_M = 0.03, 0.06
"""Standard deviation of the smoothing in the face, and where no frame shows the surface."""
MIN_EVIDENCE = 0.01
"""Weight of an offset that no frame shows."""
RADII_M = (0.01, 0.02, 0.03, 0.04, 0.06, 0.08, 0.10, 0.12)
"""Radii of the balls that measure the local thickness."""
EXACT_BAND_M = 0.045
"""Distance from the extracted surface within which the offset is exact; interpolated farther away, where it has little
weight."""
DETAIL_BAND_M = 0.012
"""Distance from the result within which the details of head and hands are evaluated."""
DETAIL_BLEND_M, MIN_DETAIL = 0.015, 0.01
"""Width of the transition from the body to the smoothed body, and the share below which the former is ignored."""
CLOSE_OFFSET_M, LOOSE_OFFSET_M = 0.02, 0.06
"""Below the first distance from the body the offset is from the body itself, beyond the second from a smoothed one: the
distance to the body has creases between the legs, which a skirt has not."""
SKIN_SIGMA_M = 0.01
"""Smoothing of the offset that tells hair from skin."""
EVIDENCE_BAND_M, EVIDENCE_SIGMA_M = 0.1, 0.015
"""Distance from the body within which the evidence is that of the nearest vertex, and its smoothing."""
LOOSE_SIGMA_M = 0.03
"""Smoothing of the distance to the body where cloth is loose."""


def fair_surface(
    mesh: Mesh,
    samples: CanonicalGrid,
    body: Body,
    outer_surface: Mesh,
    evidence: Evidence,
    settings: MeshSettings,
) -> Mesh:
    """Return the surface with a smoothed offset from the body, closed and dense as from marching cubes.

    Args:
        mesh: the extracted surface, closed, m.
        samples: the grid from which it was extracted.
        body: the fitted body in its canonical pose.
        outer_surface: its surface without cavities, to which offsets refer: behind lips and lids a surface that lies
            deeper than the body's would have holes.
        evidence: what the frames tell.
        settings: `fairing_ratio` is the standard deviation over the local thickness; 0 returns the mesh as it is.

    Raises:
        OpenSurfaceError: the result could not be repaired.
    """
    if settings.fairing_ratio <= 0.0:
        return mesh
    coarse = samples.downsampled()
    counts = np.array(coarse.density.shape)
    surface_m = signed_distance_grid(mesh, coarse.origin_m, counts, coarse.spacing_m)
    near = np.abs(surface_m) < EXACT_BAND_M
    surface_m[near] = signed_distance_m(np.argwhere(near) * coarse.spacing_m + coarse.origin_m, mesh)
    skirt = complete_skirt(surface_m, coarse, body, evidence.of_ring)
    surface_m = skirt.distance_m
    near |= (skirt.share > 0.0) & (np.abs(surface_m) < EXACT_BAND_M)
    points = np.argwhere(near) * coarse.spacing_m + coarse.origin_m
    body_m = coarse.body_distance_m.copy()
    body_m[near] = signed_distance_m(points, outer_surface)
    sigma_m = settings.fairing_ratio * local_thickness_m(body_m < 0.0, coarse.spacing_m)
    face, skin = _face_and_skin(coarse, body, body_m - surface_m)
    sigma_m = ndimage.gaussian_filter(sigma_m + face * (FACE_SIGMA_M - sigma_m), 1.0)
    clothed_m = _without_creases(smooth_with_local_sigma(body_m, sigma_m, coarse.spacing_m), coarse.spacing_m)
    detail = ndimage.gaussian_filter(np.maximum(coarse.hand_weight > 0.0, skin), DETAIL_BLEND_M / coarse.spacing_m)
    reference_m = clothed_m + detail * (body_m - clothed_m)
    seen = _evidence_grid(coarse, body, evidence.of_vertices)
    seen += (1.0 - seen) * ndimage.gaussian_filter(skirt.share, EVIDENCE_SIGMA_M / coarse.spacing_m, truncate=3.0)
    offset_sigma_m = sigma_m + (1.0 - seen) * np.maximum(UNSEEN_SIGMA_M - sigma_m, 0.0)
    weight = np.maximum(seen, MIN_EVIDENCE)
    offset_m = smooth_with_local_sigma(surface_m - reference_m, offset_sigma_m, coarse.spacing_m, weight)
    shape = samples.density.shape
    value_m = upsample(offset_m, shape)
    value_m *= 1.0 - samples.hand_weight
    value_m += upsample(reference_m, shape)
    if skirt.share.any():
        value_m += upsample(skirt.share, shape) * (upsample(skirt.distance_m, shape) - value_m)
    value_m = close_valleys(value_m, samples)
    fine_detail = upsample(detail, shape)
    near_detail = (np.abs(value_m) < DETAIL_BAND_M) & (fine_detail > MIN_DETAIL)
    share = fine_detail[near_detail]
    del fine_detail
    indices = np.argwhere(near_detail)
    exact_m = signed_distance_m(indices * samples.spacing_m + samples.origin_m, outer_surface)
    coarse_m = ndimage.map_coordinates(body_m, indices.T / 2.0, order=1)
    value_m[near_detail] += share * (exact_m - coarse_m)
    del near_detail
    return repair(isosurface(np.negative(value_m, out=value_m), 0.0, samples.origin_m, samples.spacing_m))


def local_thickness_m(inside: Bool[np.ndarray, "x y z"], spacing_m: float) -> Float[np.ndarray, "x y z"]:
    """Return the radius of the largest of the balls `RADII_M` that fits into the solid and contains a sample, m.

    Samples outside have the value of the nearest one inside.
    """
    depth_m = spacing_m * ndimage.distance_transform_edt(inside)
    thickness_m = np.full(inside.shape, RADII_M[0])
    for radius_m in RADII_M[1:]:
        centres = depth_m >= radius_m
        if not centres.any():
            break
        thickness_m[spacing_m * ndimage.distance_transform_edt(~centres) <= radius_m] = radius_m
    nearest = ndimage.distance_transform_edt(~inside, return_distances=False, return_indices=True)
    return thickness_m[tuple(nearest)]


def smooth_with_local_sigma(
    values: Float[np.ndarray, "x y z"],
    sigma_m: Float[np.ndarray, "x y z"],
    spacing_m: float,
    weight: Float[np.ndarray, "x y z"] | None = None,
) -> Float[np.ndarray, "x y z"]:
    """Smooth a grid by a Gaussian whose standard deviation varies from sample to sample, at most the last `SIGMAS_M`.

    Each sample interpolates linearly between the results of the two nearest standard deviations.

    weight: of each sample in the mean, > 0; None: all are equal.
    """
    result = np.zeros_like(values)
    for row, level_m in enumerate(SIGMAS_M):
        rising = (sigma_m - SIGMAS_M[row - 1]) / (level_m - SIGMAS_M[row - 1]) if row > 0 else np.inf
        falling = (SIGMAS_M[row + 1] - sigma_m) / (SIGMAS_M[row + 1] - level_m) if row + 1 < len(SIGMAS_M) else np.inf
        share = np.clip(np.minimum(rising, falling), 0.0, 1.0)
        result += share * (_smooth(values, level_m / spacing_m, weight) if level_m else values)
    return result


def _smooth(
    values: Float[np.ndarray, "x y z"], sigma_voxels: float, weight: Float[np.ndarray, "x y z"] | None
) -> Float[np.ndarray, "x y z"]:
    if weight is None:
        return ndimage.gaussian_filter(values, sigma_voxels, truncate=3.0)
    total = ndimage.gaussian_filter(weight, sigma_voxels, truncate=3.0)
    return ndimage.gaussian_filter(weight * values, sigma_voxels, truncate=3.0) / total


def _evidence_grid(samples: CanonicalGrid, body: Body, evidence: Float[np.ndarray, "v"]) -> Float[np.ndarray, "x y z"]:
    """Return the evidence of the nearest body vertex at all samples, smoothed."""
    near = np.abs(samples.body_distance_m) < EVIDENCE_BAND_M
    grid = np.ones(samples.density.shape)
    points_m = np.argwhere(near) * samples.spacing_m + samples.origin_m
    grid[near] = evidence[cKDTree(body.vertices).query(points_m)[1]]
    outer = ndimage.distance_transform_edt(~near, return_distances=False, return_indices=True)
    return ndimage.gaussian_filter(grid[tuple(outer)], EVIDENCE_SIGMA_M / samples.spacing_m, truncate=3.0)


def _without_creases(body_m: Float[np.ndarray, "x y z"], spacing_m: float) -> Float[np.ndarray, "x y z"]:
    """Return the distance to the body, smoothed where cloth would be loose."""
    loose = np.clip((body_m - CLOSE_OFFSET_M) / (LOOSE_OFFSET_M - CLOSE_OFFSET_M), 0.0, 1.0)
    return body_m + loose * (ndimage.gaussian_filter(body_m, LOOSE_SIGMA_M / spacing_m, truncate=3.0) - body_m)


def _face_and_skin(
    samples: CanonicalGrid, body: Body, offset_m: Float[np.ndarray, "x y z"]
) -> tuple[Float[np.ndarray, "x y z"], Float[np.ndarray, "x y z"]]:
    """Return the weights of the face and of the skin of the whole head (`pipeline.mesh.face`) at all samples.

    offset_m: distance of the surface from the body at each sample, m.
    """
    face, skin = np.zeros(samples.density.shape), np.zeros(samples.density.shape)
    head = head_vertices(body)
    if head.any():
        low_m = body.vertices[head, 1].min()
        first = max(0, int(np.ceil((low_m - samples.origin_m[1]) / samples.spacing_m)))
        offset_m = ndimage.gaussian_filter(offset_m[:, first:], SKIN_SIGMA_M / samples.spacing_m)
        points_m = np.argwhere(np.ones(offset_m.shape, dtype=bool)) * samples.spacing_m + samples.origin_m
        points_m[:, 1] += first * samples.spacing_m
        for weights, weight_fn in ((face, face_weight), (skin, head_skin_weight)):
            weights[:, first:] = weight_fn(points_m, offset_m.ravel(), body).reshape(offset_m.shape)
    return face, skin
