"""Score a finished avatar against the ground truth of its synthetic capture: surface, skinning, texture and renders.

Surfaces are aligned by a similarity transform (rotation, translation, one scale) from iterated closest points before
they are compared, because one camera cannot determine absolute scale; the scale is reported, and the Chamfer distance
without any alignment beside it.
"""

from collections import defaultdict
from dataclasses import replace

import numpy as np
import torch
from jaxtyping import Float, UInt8
from torch import Tensor

from data_tools.evaluate.comparison import SURFACE_POINTS, Comparison, ImagePair, retarget_motion
from data_tools.evaluate.highlights import highlight_scores, lamp_error_deg
from data_tools.evaluate.shown_surface import shown_faces
from data_tools.evaluate.static_texture import render_static, static_brightness
from data_tools.evaluate.truth import load_true_mask
from data_tools.evaluate.upper_bound import map_between_worlds, render_upper_bound
from data_tools.synthetic.scene.renderer import pose_vertices
from pipeline.avatar.clay import render_clay_views
from pipeline.body.body import Motion, canonical_to_world
from pipeline.body.files import load_camera, load_motion
from pipeline.capture.frame_selection import HELDOUT, evenly_spaced
from pipeline.core.errors import UserError
from pipeline.core.progress import warn
from pipeline.geometry.alpha import premultiply_to_float
from pipeline.geometry.camera import Camera
from pipeline.geometry.mesh import Mesh
from pipeline.geometry.similarity import SimilarityTransform
from pipeline.geometry.surface import closest_points_on_mesh
from pipeline.geometry.texture_rendering import blur_coverage, sample_texture, turntable_cameras
from pipeline.io.image import read_rgba, to_uint8
from pipeline.metrics.alignment import align_surfaces_icp
from pipeline.metrics.images import additional_blur_sigma_px, frame_scores, mean_scores, reason_not_scorable
from pipeline.metrics.surfaces import chamfer_distance_mm, sample_surface, surface_scores
from stages.report import median_edge_blur_px, scored_positions

SURFACE_FRAMES = 4
SAMPLES_PER_AXIS = 3
CLAY_VIEWS, CLAY_HEIGHT_PX = 8, 480


def compare_rest_surfaces(comparison: Comparison) -> dict[str, float]:
    """Score the surface of the avatar in the A-pose of the true rig.

    Unaligned, both stand on the same floor with the hips above the same point. stature_mm, true_stature_mm: heights of
    both in this pose.
    """
    avatar, true = comparison.standing_mesh, comparison.true_rest_mesh
    return (
        comparison.rest_correspondence.scores()
        | {
            "scale_to_truth": comparison.alignment.scale,
            "chamfer_unaligned_mm": chamfer_distance_mm(avatar, true, SURFACE_POINTS),
        }
        | {"stature_mm": _stature_mm(avatar), "true_stature_mm": _stature_mm(true)}
    )


def compare_matched_surfaces(comparison: Comparison) -> dict[str, float]:
    """Score the surface of the avatar in the A-pose of the true rig, with the rigs' joints matched."""
    return comparison.matched_correspondence.scores() | {"scale_to_truth": comparison.matched_alignment.scale}


def compare_shown_surface(comparison: Comparison) -> dict[str, float]:
    """Score the part of the true surface that a frame shows, as `SurfaceCorrespondence.label_scores`.

    In the A-pose of the true rig, with the rigs' joints matched, aligned as the whole surfaces are.
    """
    shown = shown_faces(comparison.rigs).astype(np.int64)
    return comparison.matched_correspondence.label_scores(shown, 1) or {}


def compare_labelled_surfaces(comparison: Comparison) -> dict[str, dict[str, float]]:
    """Score each labelled part of the truth in its A-pose, see `SurfaceCorrespondence.label_scores`.

    Parts that are invisible from outside are left out; a capture without labels has no parts.
    """
    labels = comparison.true_labels
    if labels is None:
        return {}
    rows = {
        name: comparison.rest_correspondence.label_scores(labels.of_face, label)
        for label, name in enumerate(labels.names)
    }
    return {name: scores for name, scores in rows.items() if scores is not None}


def compare_heldout_surfaces(comparison: Comparison) -> dict[str, float]:
    """Score the surface in some held-out frames: the avatar in the refined pose, the truth in the true pose.

    Unaligned, both are where their own camera sees them.
    """
    positions = _evenly_spaced(comparison.run.capture.positions(HELDOUT))
    frames = comparison.run.capture.frame_index[positions]
    rows = []
    for position, frame in zip(positions, frames, strict=True):
        avatar = comparison.avatar_surface(comparison.run.refined_canonical_to_world[position])
        true = comparison.rigs.true_surface(comparison.truth.canonical_to_world[frame])
        seen = map_between_worlds(torch.from_numpy(avatar.vertices), comparison.run.camera, comparison.truth.camera)
        unaligned_mm = chamfer_distance_mm(Mesh(seen.numpy(), avatar.faces), true, SURFACE_POINTS)
        scores = _aligned_scores(avatar, true, align_surfaces_icp(avatar, true))
        rows.append(scores | {"chamfer_unaligned_mm": unaligned_mm})
    return mean_scores(rows)


def compare_novel_poses(comparison: Comparison) -> tuple[dict[str, dict[str, float]], list[ImagePair]]:
    """Score skinning: surfaces and images of both rigs in poses that the video does not contain.

    Returns:
        novel_poses: scores of the surfaces whose limbs have equal directions; unaligned, the hips of both are in the
        same place. novel_poses_matched: the same with the rigs' joints matched.
        Image pairs with the rigs' joints matched.
    """
    motion = load_motion(comparison.folder / "novel_poses" / "motion.npz")
    body, true_body = comparison.run.body, comparison.truth.subject.body
    true_surfaces = [comparison.rigs.true_surface(pose) for pose in canonical_to_world(true_body, motion)]

    def surfaces(avatar_motion: Motion) -> list[Mesh]:
        return [comparison.avatar_surface(pose) for pose in canonical_to_world(body, avatar_motion)]

    def scores(avatars: list[Mesh], alignments: list[SimilarityTransform]) -> dict[str, float]:
        return mean_scores(
            _aligned_scores(avatar, true, alignment)
            | {"chamfer_unaligned_mm": chamfer_distance_mm(avatar, true, SURFACE_POINTS)}
            for avatar, true, alignment in zip(avatars, true_surfaces, alignments, strict=True)
        )

    retargeted, matched = surfaces(retarget_motion(body, true_body, motion)), surfaces(comparison.rigs.match(motion))
    retargeted_to_truth, matched_to_truth = (
        list(map(align_surfaces_icp, avatars, true_surfaces)) for avatars in (retargeted, matched)
    )
    image_pairs = [
        ImagePair(
            read_rgba(comparison.folder / "novel_poses" / f"{index:06d}.png"),
            render_under_light(comparison, alignment.transform_mesh(avatar), comparison.truth.camera),
        )
        for index, (avatar, alignment) in enumerate(zip(matched, matched_to_truth, strict=True))
    ]
    return {
        "novel_poses": scores(retargeted, retargeted_to_truth),
        "novel_poses_matched": scores(matched, matched_to_truth),
    }, image_pairs


def compare_novel_views(comparison: Comparison) -> list[ImagePair]:
    """Render novel views: the avatar in the true pose of the first frame, joints matched, aligned to the truth."""
    motion = comparison.rigs.match(comparison.truth.motion.select(np.array([0])))
    avatar = comparison.avatar_surface(canonical_to_world(comparison.run.body, motion)[0])
    surface = align_surfaces_icp(
        avatar, comparison.rigs.true_surface(comparison.truth.canonical_to_world[0])
    ).transform_mesh(avatar)
    return [
        ImagePair(read_rgba(path.with_suffix(".png")), render_under_light(comparison, surface, load_camera(path)))
        for path in sorted((comparison.folder / "novel_views").glob("*.npz"))
    ]


def compare_ceiling(comparison: Comparison) -> dict[str, dict[str, float]]:
    """Score the ceiling of novel views and poses: the true mesh with its best static texture.

    Returns:
        novel_views_ceiling, novel_poses_ceiling: scores as those of the avatar, for what the capture contains.
    """
    truth, folder = comparison.truth, comparison.folder
    brightness = static_brightness(comparison)
    targets = {
        "novel_views": [(path, truth.canonical_to_world[0]) for path in sorted(folder.glob("novel_views/*.npz"))]
    }
    if (folder / "novel_poses").is_dir():
        poses = canonical_to_world(truth.subject.body, load_motion(folder / "novel_poses" / "motion.npz"))
        targets["novel_poses"] = [(folder / "novel_poses" / f"{index:06d}", pose) for index, pose in enumerate(poses)]
    scores = {}
    for name, views in targets.items():
        pairs = []
        for path, pose in views:
            camera = load_camera(path) if path.suffix else truth.camera
            drawn = render_static(
                truth.subject, pose_vertices(truth.subject, pose), brightness, camera, SAMPLES_PER_AXIS
            )
            pairs.append(ImagePair(read_rgba(path.with_suffix(".png")), drawn))
        if pairs:
            scores[f"{name}_ceiling"] = mean_scores(pair.scores() for pair in pairs)
    return scores


def compare_clay(comparison: Comparison) -> list[ImagePair]:
    """Render truth and avatar in clay, in the A-pose of the true rig and aligned, from `CLAY_VIEWS` sides."""
    run, true = comparison.run.avatar, comparison.true_rest_mesh
    avatar = comparison.alignment.transform_mesh(Mesh(comparison.rest_mesh.vertices, run.faces.numpy()))
    corners = true.vertices[true.faces].reshape(-1, 3)
    cameras = turntable_cameras(corners.min(axis=0), corners.max(axis=0), CLAY_VIEWS, CLAY_HEIGHT_PX)
    return [
        ImagePair(truth, premultiply_to_float(drawn))
        for truth, drawn in zip(
            render_clay_views(true, true.vertex_normals(), cameras).smooth,
            render_clay_views(avatar, run.vertex_normals(avatar.vertices), cameras).smooth,
            strict=True,
        )
    ]


def compare_texture(comparison: Comparison, seed: int = 0) -> dict[str, float]:
    """Compare colours at uniform surface points of the avatar with the true texture at the nearest true point.

    Both are in the A-pose of the true rig.

    Returns:
        coverage: fraction of the surface that was observed.
        colour_error: mean absolute difference on the observed surface, of 255.
        balanced_colour_error: after one gain per channel, because the texture contains the lighting of the video.
        specular_correlation, roughness_error, ...: see `highlight_scores`, on the observed surface, and the angle from
            the lamp of the highlights to the key light; missing where the true person has no highlights.
    """
    observed, avatar_colours, expected = observed_colours(comparison, seed)
    gain = [_least_absolute_gain(*channels) for channels in zip(avatar_colours.T, expected.T, strict=True)]
    return {
        "coverage": len(observed) / SURFACE_POINTS,
        "colour_error": 255.0 * float(np.abs(avatar_colours - expected).mean()),
        "balanced_colour_error": 255.0 * float(np.abs(avatar_colours * gain - expected).mean()),
        **compare_highlights(comparison, observed),
    }


def observed_colours(
    comparison: Comparison, seed: int = 0
) -> tuple[Float[np.ndarray, "n 3"], Float[np.ndarray, "n 3"], Float[np.ndarray, "n 3"]]:
    """Return those of `SURFACE_POINTS` uniform points of `rest_mesh` that were observed, m, and colours there.

    Returns:
        Points, sRGB of the avatar, and sRGB of the truth at the nearest true points.
    """
    avatar = Mesh(comparison.rest_mesh.vertices, comparison.run.avatar.faces.numpy())
    true = comparison.truth.subject.body.mesh()
    points, _ = sample_surface(avatar, SURFACE_POINTS, seed)
    uv = _nearest_uv(points, avatar, comparison.run.avatar.uv, comparison.run.avatar.faces_uv.numpy())
    observed = sample_texture(torch.from_numpy(comparison.coverage)[..., None], uv)[:, 0].numpy() > 0.5
    avatar_colours = sample_texture(comparison.run.avatar.diffuse, uv[observed]).numpy()
    subject = comparison.truth.subject
    points_true = comparison.alignment(points[observed])
    uv_true = _nearest_uv(points_true, true, torch.from_numpy(subject.uv), subject.faces_uv)
    return points[observed], avatar_colours, sample_texture(subject.texture_tensor(), uv_true).numpy()


def compare_highlights(comparison: Comparison, points: Float[np.ndarray, "n 3"]) -> dict[str, float]:
    """Return `highlight_scores` and `lamp_error_deg` at surface points; nothing where the true person is matte."""
    truth, own = comparison.truth, comparison.run.avatar.gloss
    if truth.light.specular_strength == 0:
        return {}
    avatar = Mesh(comparison.rest_mesh.vertices, comparison.run.avatar.faces.numpy())
    _, true_faces, _ = closest_points_on_mesh(comparison.alignment(points), truth.subject.body.mesh())
    strength, roughness = np.zeros(len(points)), np.ones(len(points))
    if own is not None:
        _, faces, barycentric = closest_points_on_mesh(points, avatar)
        strength = (own.strength.numpy()[avatar.faces[faces]] * barycentric).sum(axis=1)
        roughness[:] = own.highlights.roughness
        if own.roughness is not None:
            roughness = (own.roughness.numpy()[avatar.faces[faces]] * barycentric).sum(axis=1)
    scores = highlight_scores(strength, roughness, truth.subject, truth.light, true_faces)
    if own is None:
        return scores
    world_to_true_world = truth.camera.world_to_camera[:3, :3].T @ comparison.run.camera.world_to_camera[:3, :3]
    return scores | {"lamp_error_deg": lamp_error_deg(world_to_true_world @ own.highlights.direction, truth.light)}


def compare_heldout_images(comparison: Comparison) -> dict[str, dict[str, float]]:
    """Score the held-out frames with ground truth; scores are means over frames.

    Returns:
        upper_bound: of `render_upper_bound` with the edge blur of the report's mesh.
        field_true_mask, mesh_true_mask, upper_bound_true_mask: targets are cut out of the video by the true mask
        instead of the mask of the frames stage; meshes have sharp edges, like the true masks. A frame whose true mask
        cannot be scored is left out of these, with a warning.

    Raises:
        UserError: no frame can be scored with its true mask.
    """
    run = comparison.run
    rows: defaultdict[str, list[dict[str, float]]] = defaultdict(list)
    blur_px = additional_blur_sigma_px(median_edge_blur_px(run))
    positions = scored_positions(run.capture)
    for position, upper_bound_rgba in zip(positions.tolist(), render_upper_bound(comparison, positions), strict=True):
        image, mask = (to_uint8(read(position)) for read in (run.capture.image, run.capture.mask))
        rows["upper_bound"].append(frame_scores(blur_coverage(upper_bound_rgba, blur_px), image, mask))
        pose, person_mask = run.refined_canonical_to_world[position], _true_mask(comparison, position)
        if (reason := reason_not_scorable(person_mask)) is not None:
            frame = run.capture.frame_index[position]
            warn(f"held-out frame {frame} is not scored with the true mask of {comparison.folder}: {reason}")
            continue
        posed = run.avatar.pose_vertices(pose)
        mesh = run.avatar.render(posed, run.camera, SAMPLES_PER_AXIS, run.avatar.light, position)
        for name, render in {"field": run.field_renderer(pose), "mesh": mesh, "upper_bound": upper_bound_rgba}.items():
            rows[f"{name}_true_mask"].append(frame_scores(render, image, person_mask))
    if "mesh_true_mask" not in rows:
        raise UserError(
            f"no held-out frame can be scored with the true masks of {comparison.folder}; "
            "name the capture that this run was made from"
        )
    return {name: mean_scores(scores) for name, scores in rows.items()}


def _stature_mm(mesh: Mesh) -> float:
    return 1000.0 * float(np.ptp(mesh.vertices[mesh.faces, 1]))


def _aligned_scores(avatar: Mesh, true: Mesh, alignment: SimilarityTransform) -> dict[str, float]:
    scores = surface_scores(alignment.transform_mesh(avatar), true, SURFACE_POINTS)
    return scores | {"scale_to_truth": alignment.scale}


def _true_mask(comparison: Comparison, position: int) -> UInt8[np.ndarray, "h w"]:
    """Return the true coverage of a selected frame, 0 to 255, at the image size of the run."""
    capture = comparison.run.capture
    frame_index = int(capture.frame_index[position])
    return load_true_mask(comparison.folder.parent, frame_index, (capture.width, capture.height))


def render_under_light(comparison: Comparison, surface: Mesh, camera: Camera) -> Float[np.ndarray, "h w 4"]:
    """Render the avatar, posed in the true world, under the light that the run estimated in its own world."""
    run, true_camera = comparison.run, comparison.truth.camera
    vertices = map_between_worlds(torch.from_numpy(surface.vertices).float(), true_camera, run.camera)
    from_run_world = np.linalg.inv(true_camera.world_to_camera) @ run.camera.world_to_camera
    camera = replace(camera, world_to_camera=(camera.world_to_camera @ from_run_world).astype(np.float32))
    return run.avatar.render(vertices, camera, SAMPLES_PER_AXIS, run.avatar.light)


def _nearest_uv(
    points: Float[np.ndarray, "n 3"], mesh: Mesh, uv: Float[Tensor, "t 2"], faces_uv: np.ndarray
) -> Float[Tensor, "n 2"]:
    """Return the UV coordinates of the mesh point nearest to each point."""
    _, faces, barycentric = closest_points_on_mesh(points, mesh)
    corners = uv[torch.from_numpy(faces_uv[faces].astype(np.int64))]
    return (corners * torch.from_numpy(barycentric)[..., None]).sum(1).float()


def _least_absolute_gain(values: Float[np.ndarray, "n"], targets: Float[np.ndarray, "n"]) -> float:
    """Return the gain with the least absolute error: the median of the ratios, weighted by the values."""
    ratios = targets / np.maximum(values, 1e-6)
    order = np.argsort(ratios)
    cumulative_weight = np.cumsum(values[order])
    return float(ratios[order[np.searchsorted(cumulative_weight, 0.5 * cumulative_weight[-1])]])


def _evenly_spaced(positions: np.ndarray) -> np.ndarray:
    return positions[evenly_spaced(len(positions), SURFACE_FRAMES)]
