"""Score a radiance field against the ground truth of its synthetic capture: surface, novel views and poses, haze.

The field is drawn where its surface, extracted at one density and posed, is aligned with the true surface by a
similarity transform, with the joints of both rigs matched (`data_tools.evaluate.comparison`).
"""

from collections.abc import Iterator
from dataclasses import dataclass, replace
from pathlib import Path

import cv2
import numpy as np
import torch
from jaxtyping import Float, UInt8
from torch import Tensor

from data_tools.evaluate.comparison import SURFACE_POINTS, MatchedRigs
from data_tools.evaluate.truth import load_ground_truth
from pipeline.body.body import canonical_to_world
from pipeline.body.files import load_body, load_camera, load_motion
from pipeline.core.errors import UserError
from pipeline.field.field import RadianceField
from pipeline.field.files import load_field, load_occupancy
from pipeline.field.occupancy import BinaryOccupancy
from pipeline.field.rendering import render_field
from pipeline.field.skin_grid import build_skin_grid, skin_margin_m
from pipeline.geometry.camera import Camera
from pipeline.geometry.mesh import Mesh
from pipeline.geometry.shadow_map import find_exterior_faces
from pipeline.geometry.similarity import SimilarityTransform
from pipeline.geometry.skinning import linear_blend_skinning
from pipeline.io.image import read_rgba
from pipeline.kernels.inverse_skinning import SkinGrid
from pipeline.mesh.extraction.isosurface import extract_mesh, sample_canonical_grid
from pipeline.mesh.settings import MeshSettings
from pipeline.mesh.skin_transfer import transfer_skin
from pipeline.metrics.alignment import align_surfaces_icp
from pipeline.metrics.images import frame_scores, mean_scores
from pipeline.metrics.surfaces import surface_scores

VOXEL_M = 0.006
"""Spacing of the density samples of the extracted surface, m."""
ISOVALUE_PER_M = 16.0
"""Density of the extracted surface, 1/m; one for all fields, so that no choice differs between them."""
HAZE_DISTANCE_PX = 6.0
"""Alpha farther than this from the true mask is haze, px: beyond the errors of the poses at hands and feet."""


@dataclass(frozen=True)
class TrueComparison:
    """A field with its extracted, skinned surface, and the rigs of the run and of the truth."""

    field: RadianceField
    occupancy: BinaryOccupancy
    skin: SkinGrid
    surface: Mesh
    weights: Float[Tensor, "v j"]
    rigs: MatchedRigs

    def posed_surface(self, pose: Float[Tensor, "j 4 4"]) -> Mesh:
        """Return the extracted surface in a pose (canonical to world)."""
        vertices = torch.from_numpy(self.surface.vertices.astype(np.float32))
        return Mesh(linear_blend_skinning(vertices, self.weights, pose[None].float())[0].numpy(), self.surface.faces)

    def align(self, pose: Float[Tensor, "j 4 4"], true_pose: Float[Tensor, "k 4 4"]) -> SimilarityTransform:
        """Return the similarity from the surface in a pose to the true person in the pose of its own rig."""
        return align_surfaces_icp(self.posed_surface(pose), self.rigs.true_surface(true_pose))

    def render(
        self, pose: Float[Tensor, "j 4 4"], alignment: SimilarityTransform, camera: Camera
    ) -> Float[np.ndarray, "h w 4"]:
        """Draw the field in a pose, moved by `alignment`, from a camera of the true world; premultiplied."""
        aligned = camera_before_similarity(camera, alignment)
        return render_field(self.field, self.occupancy, self.rigs.body, pose, aligned, self.skin).numpy()


def score_field(run: Path, field_folder: Path, capture: Path) -> dict[str, float]:
    """Score the field in a folder; `run` has the body and `capture` the ground truth.

    Returns:
        field_chamfer_mm, field_normal_angle_deg: extracted surface and truth in the A-pose of the true rig, aligned.
        novel_view_psnr_db, novel_view_psnr_body_db, novel_pose_...: see `frame_scores`, means over the images.
        haze: mean alpha, over novel views and poses, of pixels farther than `HAZE_DISTANCE_PX` from the true mask and
            inside the box of the true mask widened by a tenth of its height.

    Raises:
        UserError: a file is missing or damaged, or the capture has no novel views.
    """
    comparison = load_true_comparison(run, field_folder, capture)
    rigs = comparison.rigs
    surface = comparison.posed_surface(canonical_to_world(rigs.body, rigs.match(rigs.true_rest_motion))[0])
    surface = Mesh(surface.vertices, surface.faces[find_exterior_faces(surface)])
    true_surface = rigs.true_surface(canonical_to_world(rigs.truth.subject.body, rigs.true_rest_motion)[0])
    alignment = align_surfaces_icp(surface, true_surface)
    shape = surface_scores(alignment.transform_mesh(surface), true_surface, SURFACE_POINTS)
    scores = {"field_chamfer_mm": shape["chamfer_mm"], "field_normal_angle_deg": shape["normal_angle_deg"]}
    haze = []
    for name, images in (
        ("novel_view", novel_views(comparison, capture)),
        ("novel_pose", novel_poses(comparison, capture)),
    ):
        rows = []
        for target, rgba in images:
            rows.append(frame_scores(rgba, target[..., :3], target[..., 3]))
            haze.append(haze_alpha(rgba[..., 3], target[..., 3]))
        if not rows:
            raise UserError(f"{capture}/truth has no images of {name.replace('_', ' ')}s: make the capture again")
        mean = mean_scores(rows)
        scores |= {f"{name}_psnr_db": mean["psnr_full"], f"{name}_psnr_body_db": mean["psnr_body"]}
    return scores | {"haze": float(np.mean(haze))}


def load_true_comparison(run: Path, field_folder: Path, capture: Path) -> TrueComparison:
    """Read field and truth, and extract the surface of the field."""
    body, camera = load_body(run / "body" / "body.npz"), load_camera(run / "body" / "camera.npz")
    motion, truth = load_motion(field_folder / "motion.npz"), load_ground_truth(capture)
    field = load_field(field_folder / "field.safetensors")
    occupancy = load_occupancy(field_folder / "occupancy.npz")

    def density_fn(points_m: Tensor) -> Tensor:
        occupied, density = occupancy.contains(points_m), torch.zeros(len(points_m))
        density[occupied] = field.density(points_m[occupied])
        return density

    settings = MeshSettings()
    samples = sample_canonical_grid(density_fn, occupancy.occupied_bounds_m(), body, VOXEL_M, settings)
    surface = extract_mesh(samples, ISOVALUE_PER_M, settings)
    skin = build_skin_grid(body, skin_margin_m(body, occupancy.bounds_m.numpy()))
    weights = transfer_skin(surface, body).weights
    return TrueComparison(field, occupancy, skin, surface, weights, MatchedRigs(body, motion, camera, truth))


def novel_views(
    comparison: TrueComparison, capture: Path
) -> Iterator[tuple[UInt8[np.ndarray, "h w 4"], Float[np.ndarray, "h w 4"]]]:
    """Yield true images (straight RGBA) and renders of the first frame from other cameras."""
    rigs, truth = comparison.rigs, comparison.rigs.truth
    pose = canonical_to_world(rigs.body, rigs.match(truth.motion.select(np.array([0]))))[0]
    alignment = comparison.align(pose, truth.canonical_to_world[0])
    for path in sorted((capture / "truth" / "novel_views").glob("*.npz")):
        yield read_rgba(path.with_suffix(".png")), comparison.render(pose, alignment, load_camera(path))


def novel_poses(
    comparison: TrueComparison, capture: Path
) -> Iterator[tuple[UInt8[np.ndarray, "h w 4"], Float[np.ndarray, "h w 4"]]]:
    """Yield true images (straight RGBA) and renders of poses that the video does not contain."""
    folder, rigs = capture / "truth" / "novel_poses", comparison.rigs
    motion = load_motion(folder / "motion.npz")
    true_poses = canonical_to_world(rigs.truth.subject.body, motion)
    for index, pose in enumerate(canonical_to_world(rigs.body, rigs.match(motion))):
        alignment = comparison.align(pose, true_poses[index])
        yield read_rgba(folder / f"{index:06d}.png"), comparison.render(pose, alignment, rigs.truth.camera)


def camera_before_similarity(camera: Camera, transform: SimilarityTransform) -> Camera:
    """Return the camera that sees x where `camera` sees `transform(x)`; depths are divided by the scale."""
    rotation, translation_m = camera.world_to_camera[:3, :3], camera.world_to_camera[:3, 3]
    world_to_camera = np.eye(4)
    world_to_camera[:3, :3] = rotation @ transform.rotation
    world_to_camera[:3, 3] = (rotation @ transform.translation_m + translation_m) / transform.scale
    return replace(camera, world_to_camera=world_to_camera.astype(np.float32))


def haze_alpha(alpha: Float[np.ndarray, "h w"], true_alpha: UInt8[np.ndarray, "h w"]) -> float:
    """Return the mean alpha of the pixels off the true mask: farther than `HAZE_DISTANCE_PX` from any pixel of it.

    Counted are pixels in the box of the mask widened by a tenth of its height on all sides, so that the size of the
    image does not matter.

    Raises:
        ValueError: the mask is empty.
    """
    mask = true_alpha > 0
    if not mask.any():
        raise ValueError("the true mask is empty: there is nothing that haze could be beside")
    rows, columns = np.nonzero(mask.any(1))[0], np.nonzero(mask.any(0))[0]
    margin = round(0.1 * (rows[-1] - rows[0] + 1))
    near = np.zeros_like(mask)
    near[max(0, rows[0] - margin) : rows[-1] + 1 + margin, max(0, columns[0] - margin) : columns[-1] + 1 + margin] = (
        True
    )
    distance_px = cv2.distanceTransform((~mask).astype(np.uint8), cv2.DIST_L2, cv2.DIST_MASK_PRECISE)
    return float(alpha[near & (distance_px > HAZE_DISTANCE_PX)].mean())
