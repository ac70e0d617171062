"""Alignment of poses to a surface by Gauss-Newton steps: by its colours and its silhouette, or by the silhouette alone.

Each pixel says by how much, along its colour gradient, the surface point that it shows should move in the image
(Lucas and Kanade, "An Iterative Image Registration Technique", 1981; with the mean gradient of render and image as in
Benhimane and Malis, "Real-time image-based tracking of planes using efficient second-order minimization", 2004). The
silhouette counts in the same way: alpha is a fourth channel. The corrections of all views are solved together, with a
prior that ties those of successive frames; views of the whole turn share one surface, as in bundle adjustment.
Colours are compared after their local mean is removed, so that light that changes as the person turns does not move
the person.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import NamedTuple

import cv2
import numpy as np
import torch
from jaxtyping import Bool, Float, Float32, Int
from torch import Tensor

from pipeline.body.body import Body, Motion
from pipeline.body.fit.camera_parameters import project_with_jacobian
from pipeline.body.fit.linear_body import descendant_matrix
from pipeline.body.pose_correction import PoseCorrection
from pipeline.geometry.camera import Camera, project
from pipeline.geometry.differentiable_raster import render_pixels
from pipeline.kernels.common.opencv_threads import single_threaded_opencv
from pipeline.kernels.common.thread_pool import ThreadPool
from pipeline.kernels.interpolate import interpolate
from pipeline.mesh.correction_prior import CorrectionPrior
from pipeline.mesh.skin_transfer import SkinnedTopology
from pipeline.mesh.views import PosedView, Shader

MAX_PERSON_PX = 320
"""Height of the person in images in which frames are aligned to a finished surface: 480 px give the same poses."""
SCALES = (0.5, 1.0)
"""Sizes of these images, one after the other."""
BLUR_SIGMA_PX = 1.2
"""Blur of render and image before their gradients are taken: an error of a pose is a pixel or two."""
LIGHT_SIGMA_RATIO = 0.02
"""Radius of the local mean that is removed from the colours, as a share of the height of the crop."""
SIGMA_OF_SMALLER_PX = 2.5
"""Standard deviation, at least, of a wide blur in the smaller picture to which it is applied."""
PIXEL_STRIDE = 2
PIXELS = np.s_[..., ::PIXEL_STRIDE, ::PIXEL_STRIDE]
"""Every second row and column is used: the blur makes neighbours say the same."""
MAX_DEPTH_STEP_M = 0.03
"""Pixels next to a larger step of depth are not used for colour: the render there is two surfaces."""
BACKGROUND_DEPTH_M = 1e3
SILHOUETTE_BAND_PX = 4
"""Largest distance of a pixel from the rendered surface at which alpha counts."""
COLOUR_NOISE, ALPHA_NOISE = 0.01, 0.1
"""Smallest standard deviation of colours, and standard deviation of alpha (masks are a pixel or two loose)."""


@dataclass(frozen=True)
class AlignedSurface:
    """The surface to which poses are aligned.

    vertices: A-pose, m. skin: their faces and skin weights. attributes: attributes (v, c) of the vertices from their
    places in a pose (v, 3), m. shader: colours (n, 3) in [0, 1] from attributes (n, c); None: the outline alone counts.
    """

    vertices: Float[Tensor, "v 3"]
    skin: SkinnedTopology
    attributes: Callable[[Float[Tensor, "v 3"]], Float[Tensor, "v c"]]
    shader: Callable[[Float[Tensor, "n c"]], Float[Tensor, "n 3"]] | None

    @classmethod
    def with_colours(cls, vertices: Float[Tensor, "v 3"], skin: SkinnedTopology, shader: Shader) -> "AlignedSurface":
        """Return a surface whose colours are a function of the place in the A-pose."""
        return cls(vertices, skin, lambda _: vertices, shader)

    @classmethod
    def without_colours(cls, vertices: Float[Tensor, "v 3"], skin: SkinnedTopology) -> "AlignedSurface":
        """Return a surface of which the outline alone counts."""
        return cls(vertices, skin, lambda posed: posed[:, :0], None)


@dataclass(frozen=True)
class ImageEvidence:
    """What pixels of a view say about the motion of the surface points that they show.

    points_m: surface points, world. structure: sum over channels of gradient · gradientᵀ over variance, 1/px². pull:
    sum of gradient · (image - render) over variance, 1/px. subtree_weights: skin weights of each joint with all below.
    """

    points_m: Float[np.ndarray, "n 3"]
    subtree_weights: Float[np.ndarray, "n k"]
    structure: Float[np.ndarray, "n 2 2"]
    pull: Float[np.ndarray, "n 2"]


class PoseOffsets(NamedTuple):
    """The values of a `PoseCorrection`: rotation vectors of its joints (rad) and shifts of the root (m)."""

    rotation_rad: Float[Tensor, "n k 3"]
    shift_m: Float[Tensor, "n 3"]

    def of(self, body: Body, motion: Motion) -> PoseCorrection:
        """Return the correction of a motion with these values."""
        correction = PoseCorrection(body, motion)
        correction.rotation_rad, correction.shift_m = self
        return correction


def align_motion(
    surface: AlignedSurface,
    body: Body,
    motion: Motion,
    views: Sequence[PosedView],
    prior: CorrectionPrior,
    iterations: int,
) -> Motion:
    """Return the motion aligned to its views from coarse to fine, see `align_poses`; iterations: at each size."""
    correction = PoseCorrection(body, motion)
    for scale in SCALES:
        scaled = [view.scaled(scale) for view in views]
        correction = align_poses(surface, scaled, correction, prior, iterations).of(body, motion)
    return correction.apply(motion)


def align_poses(
    surface: AlignedSurface,
    views: Sequence[PosedView],
    correction: PoseCorrection,
    prior: CorrectionPrior,
    iterations: int,
) -> PoseOffsets:
    """Return the offsets with which renders of the surface match the views best.

    Args:
        surface: its colours and its outline, or its outline alone.
        views: one view for each frame of the correction; their poses are not read.
        correction: starting point.
        prior: of the corrections of all these frames.
        iterations: number of Gauss-Newton steps.
    """
    body, threads = correction.body, ThreadPool(torch.get_num_threads())
    offsets = PoseOffsets(correction.rotation_rad.detach(), correction.shift_m.detach())
    weights = surface.skin.weights @ descendant_matrix(body.parents.tolist())[correction.joints].T.float()
    rows = torch.arange(len(views))

    @torch.no_grad()
    def evidence_of_view(view: PosedView, pose: Float[Tensor, "j 4 4"]) -> tuple[np.ndarray, np.ndarray]:
        posed_view = PosedView(view.image, view.mask, view.camera, pose)
        evidence = gather_evidence(surface, weights, posed_view)
        return normal_equations(evidence, view.camera, body, pose.numpy(), correction.joints.numpy())

    for _ in range(iterations):
        poses = offsets.of(body, correction.motion).canonical_to_world(rows)
        with single_threaded_opencv():
            systems = threads.map(evidence_of_view, views, poses)
        matrices, vectors = (np.stack(parts) for parts in zip(*systems, strict=True))
        present = np.concatenate([offsets.rotation_rad.flatten(1), offsets.shift_m], axis=1)
        update = prior.solve(matrices, vectors, present)
        moved = torch.from_numpy(present + update).float()
        offsets = PoseOffsets(moved[:, :-3].reshape(offsets.rotation_rad.shape), moved[:, -3:].clone())
    return offsets


def gather_evidence(surface: AlignedSurface, subtree_weights: Float[Tensor, "v k"], view: PosedView) -> ImageEvidence:
    """Compare the render of the surface with a view, in colour inside the surface and in alpha at its silhouette."""
    camera, shape = view.camera, (view.camera.height, view.camera.width)
    skin, shader = surface.skin, surface.shader or (lambda attributes: attributes)
    posed = view.pose_vertices(surface.vertices, skin.weights)
    projected, topology = project(posed, camera), (skin.faces, skin.adjacency)
    drawn = render_pixels(*projected, topology, shape, surface.attributes(posed), shader)
    render = np.zeros((drawn.values.shape[1], camera.height * camera.width), np.float32)
    render[:, drawn.pixel.numpy()] = drawn.values.numpy().T
    render = render.reshape(-1, *shape)
    mask = view.mask.numpy().astype(np.float32) / 255.0

    covered = torch.nonzero(drawn.face_id.reshape(-1) >= 0).squeeze(1)
    point_of_pixel = np.full(drawn.face_id.numel(), -1)
    point_of_pixel[covered.numpy()] = np.arange(len(covered))
    nearest_point, distance_px = _nearest_points(point_of_pixel.reshape(shape))
    near = distance_px[PIXELS] < SILHOUETTE_BAND_PX
    evidence = _silhouette_evidence(near, render[-1], mask)
    if surface.shader is not None:
        frame = np.concatenate([np.moveaxis(view.image.numpy(), 2, 0) * (mask / 255.0), mask[None]])
        inside = _is_inside(render[3], mask, np.minimum(drawn.depth_m.numpy(), BACKGROUND_DEPTH_M))
        evidence += _colour_evidence(inside[PIXELS], render, frame)
    used = (evidence[0] + evidence[2] > 0.0) & near
    xx, xy, yy, pull_x, pull_y = evidence[:, used]
    structure = np.stack([xx, xy, xy, yy], axis=-1).reshape(-1, 2, 2)

    seen = covered[torch.from_numpy(nearest_point[PIXELS][used])]
    attributes = torch.cat([posed, subtree_weights], dim=1)
    at_pixel = seen, drawn.face_id.reshape(-1)[seen], camera.width
    points = interpolate(*at_pixel, *projected, skin.faces, attributes).numpy()
    return ImageEvidence(points[:, :3], points[:, 3:], structure, np.stack([pull_x, pull_y], axis=-1))


def _nearest_points(
    point_of_pixel: Int[np.ndarray, "h w"],
) -> tuple[Int[np.ndarray, "h w"], Float32[np.ndarray, "h w"]]:
    """Return the point of the nearest pixel that has one (-1: none), and the distance to that pixel, px."""
    has_point = point_of_pixel >= 0
    distance_px, label = cv2.distanceTransformWithLabels(
        (~has_point).astype(np.uint8), cv2.DIST_L2, 5, labelType=cv2.DIST_LABEL_PIXEL
    )
    point_of_label = np.zeros(int(label.max()) + 1, dtype=np.int64)
    point_of_label[label[has_point]] = point_of_pixel[has_point]
    return point_of_label[label], distance_px


def _is_inside(
    render_alpha: Float32[np.ndarray, "h w"], mask: Float32[np.ndarray, "h w"], depth_m: Float32[np.ndarray, "h w"]
) -> Bool[np.ndarray, "h w"]:
    """Return the pixels well inside render and mask, away from steps of depth."""
    both = ((render_alpha > 0.99) & (mask > 0.99)).astype(np.uint8)
    kernel = np.ones((3, 3), np.uint8)
    is_step = cv2.dilate(depth_m, kernel) - cv2.erode(depth_m, kernel) > 2.0 * MAX_DEPTH_STEP_M
    reach_px = 2 * int(np.ceil(3.0 * BLUR_SIGMA_PX)) + 1
    inner = cv2.erode(np.pad(both, 1), np.ones((reach_px, reach_px), np.uint8))[1:-1, 1:-1]
    return inner.astype(bool) & ~is_step


def _colour_evidence(
    inside: Bool[np.ndarray, "m n"], render: Float32[np.ndarray, "4 h w"], frame: Float32[np.ndarray, "4 h w"]
) -> Float32[np.ndarray, "5 m n"]:
    """Return the evidence (see `_evidence`) of the colours, less their local means, at `PIXELS` that are inside.

    render, frame: premultiplied colours and alpha, in [0, 1].
    """
    wide_px = LIGHT_SIGMA_RATIO * render.shape[1]
    details = [
        _blurred_colours(picture, BLUR_SIGMA_PX) - _blurred_colours(picture * other[3], wide_px)
        for picture, other in ((render, frame), (frame, render))
    ]
    residual = (details[1] - details[0])[PIXELS]
    noise = COLOUR_NOISE
    if inside.any():
        noise += 1.4826 * float(np.median(np.abs(residual[:, inside])))
    # Colours of one pixel err together.
    weight = inside * _geman_mcclure(residual, noise, 2.0) / 3.0
    return _evidence(weight, 0.5 * (details[0] + details[1]), residual)


def _silhouette_evidence(
    near: Bool[np.ndarray, "m n"],
    render_alpha: Float32[np.ndarray, "h w"],
    mask: Float32[np.ndarray, "h w"],
) -> Float32[np.ndarray, "5 m n"]:
    """Return the evidence (see `_evidence`) of alpha at `PIXELS` that are near the rendered surface."""
    blurred = [cv2.GaussianBlur(alpha, (0, 0), BLUR_SIGMA_PX)[None] for alpha in (render_alpha, mask)]
    residual = (blurred[1] - blurred[0])[PIXELS]
    return _evidence(near * _geman_mcclure(residual, ALPHA_NOISE, 3.0), 0.5 * (blurred[0] + blurred[1]), residual)


def _evidence(
    weight: Float32[np.ndarray, "c m n"], picture: Float32[np.ndarray, "c h w"], residual: Float32[np.ndarray, "c m n"]
) -> Float32[np.ndarray, "5 m n"]:
    """Return structure (xx, xy, yy) and pull (x, y) of channels with these weights, at `PIXELS`.

    picture: its gradient is that of the channels. residual: image - render.
    """
    along_x, along_y = _gradient(picture)
    weighted_x, weighted_y = weight * along_x, weight * along_y
    products = (weighted_x * along_x, weighted_x * along_y, weighted_y * along_y)
    return np.stack([part.sum(0) for part in (*products, weighted_x * residual, weighted_y * residual)])


def _geman_mcclure(residual: Float32[np.ndarray, "*n"], noise: float, limit: float) -> Float32[np.ndarray, "*n"]:
    """Return weights of residuals: an inverse variance that fades beyond `limit` standard deviations.

    It is divided by the number of pixels that say the same: the blur correlates 4 pi sigma² of them.
    """
    redundancy = 4.0 * np.pi * BLUR_SIGMA_PX**2 / PIXEL_STRIDE**2
    return 1.0 / (redundancy * np.square(noise * (1.0 + np.square(residual / (limit * noise)))))


def _blurred_colours(premultiplied: Float32[np.ndarray, "4 h w"], sigma_px: float) -> Float32[np.ndarray, "3 h w"]:
    """Return the mean of the colours weighted by alpha and a Gaussian; a wide one is applied to a smaller picture."""
    size = premultiplied.shape[:0:-1]
    factor = max(1, int(sigma_px / SIGMA_OF_SMALLER_PX))
    smaller = tuple(max(1, round(side / factor)) for side in size)
    sigmas_px = sigma_px * smaller[0] / size[0], sigma_px * smaller[1] / size[1]

    def blur(plane: Float32[np.ndarray, "h w"]) -> Float32[np.ndarray, "h w"]:
        if factor == 1:
            return cv2.GaussianBlur(plane, (0, 0), sigma_px)
        plane = cv2.resize(plane, smaller, interpolation=cv2.INTER_AREA)
        blurred = cv2.GaussianBlur(plane, (0, 0), sigmas_px[0], sigmaY=sigmas_px[1])
        return cv2.resize(blurred, size, interpolation=cv2.INTER_LINEAR)

    planes = np.stack([blur(plane) for plane in premultiplied])
    return planes[:3] / np.maximum(planes[3], 1e-6)


def _gradient(picture: Float32[np.ndarray, "c h w"]) -> tuple[Float32[np.ndarray, "c m n"], ...]:
    """Return the central differences of each channel along x and along y at `PIXELS`, 1/px."""
    padded = np.pad(picture, ((0, 0), (1, 1), (1, 1)), mode="edge")
    along_x = 0.5 * (padded[:, 1:-1, 2:][PIXELS] - padded[:, 1:-1, :-2][PIXELS])
    along_y = 0.5 * (padded[:, 2:, 1:-1][PIXELS] - padded[:, :-2, 1:-1][PIXELS])
    return along_x, along_y


def normal_equations(
    evidence: ImageEvidence,
    camera: Camera,
    body: Body,
    canonical_to_world: Float[np.ndarray, "j 4 4"],
    joints: Int[np.ndarray, "k"],
) -> tuple[Float[np.ndarray, "p p"], Float[np.ndarray, "p"]]:
    """Return matrix and right side of the least squares for one view.

    The p = 3 k + 3 unknowns are those of `PoseCorrection`: a rotation vector of each joint in its own axes, rad, and
    the shift of the root, m. A point that moves by d px takes its colour along and changes the render by -gradient · d;
    this change is to be image - render.
    """
    points_m = evidence.points_m.astype(np.float32)
    pixel_by_point = project_with_jacobian(torch.from_numpy(points_m)[None], camera)[1][0].numpy()
    rotations = canonical_to_world[joints, :3, :3].astype(np.float32)
    joints_world_m = np.einsum("kij,kj->ki", rotations, body.joints_m[joints]) + canonical_to_world[joints, :3, 3]
    # (x - c) × p = x × p - c × p: one product of [x × p, p] with a 6 x 3 matrix of each joint; x and c from the root.
    levers_m = (points_m - joints_world_m[0].astype(np.float32))[:, None]
    centres_m = (joints_world_m - joints_world_m[0]).astype(np.float32)
    moments = np.concatenate([_cross(levers_m, pixel_by_point), pixel_by_point], axis=2)
    about_joint = -np.einsum("kaj,kji->kai", _cross(centres_m[:, None], np.eye(3, dtype=np.float32)), rotations)
    by_joint = np.concatenate([rotations, about_joint], axis=1).transpose(1, 0, 2).reshape(6, -1)
    torques = (moments.transpose(1, 0, 2) @ by_joint).reshape(2, len(points_m), len(joints), 3)
    torques *= evidence.subtree_weights[:, :, None]
    along_x, along_y = np.concatenate(
        [torques.reshape(2, len(points_m), 3 * len(joints)), pixel_by_point.transpose(1, 0, 2)], axis=2
    )
    xx, xy, yy = (evidence.structure[:, i, k, None] for i, k in ((0, 0), (0, 1), (1, 1)))
    matrix = along_x.T @ (xx * along_x + xy * along_y) + along_y.T @ (xy * along_x + yy * along_y)
    vector = -along_x.T @ evidence.pull[:, 0] - along_y.T @ evidence.pull[:, 1]
    return 0.5 * (matrix + matrix.T).astype(np.float64), vector.astype(np.float64)


def _cross(first: Float32[np.ndarray, "*n 3"], second: Float32[np.ndarray, "*m 3"]) -> Float32[np.ndarray, "*k 3"]:
    """Return the cross products; `numpy.cross` takes ten times as long."""
    (a, b, c), (x, y, z) = np.moveaxis(first, -1, 0), np.moveaxis(second, -1, 0)
    return np.stack([b * z - c * y, c * x - a * z, a * y - b * x], axis=-1)
