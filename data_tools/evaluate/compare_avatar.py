"""The finished avatar against the truth of its synthetic capture: surface, skinning, texture, pictures, the ceiling.

Wherever surfaces are compared they were laid over each other by a similarity (rotation, shift, one scale) found by
iterated closest points, because one camera cannot tell size from distance; the scale is reported.
"""

from collections import defaultdict
from collections.abc import Iterator
from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path

import cv2
import numpy as np
import torch
from jaxtyping import Float, Int, UInt8
from torch import Tensor

from data_tools.evaluate.truth import load_ground_truth, load_true_mask
from data_tools.synthetic.rig.retarget import local_quaternions, retarget_rotations
from data_tools.synthetic.scene.capture import SyntheticCapture
from data_tools.synthetic.scene.renderer import pose_vertices, render_subject
from data_tools.synthetic.scene.shadow import find_exterior_faces
from pipeline.avatar.finished_run import FinishedRun, load_finished_run
from pipeline.body.body import Body, Motion, canonical_to_world
from pipeline.body.files import load_camera, load_motion
from pipeline.capture.frame_selection import HELDOUT, TRAIN
from pipeline.core.errors import UserError
from pipeline.core.progress import track, warn
from pipeline.geometry.camera import Camera, transform_world_to_camera
from pipeline.geometry.mesh import Mesh
from pipeline.geometry.rotation import quaternion_to_matrix
from pipeline.geometry.skinning import forward_kinematics
from pipeline.geometry.surface import closest_points_on_mesh
from pipeline.geometry.texture_rendering import blur_coverage, sample_texture
from pipeline.io.image import read_rgba, to_float, to_uint8
from pipeline.metrics.alignment import SimilarityTransform, align_surfaces_icp
from pipeline.metrics.images import additional_blur_sigma_px, frame_scores, mean_scores, reason_not_scorable
from pipeline.metrics.surfaces import sample_surface, surface_scores
from pipeline.texture.files import load_texture
from stages.report import median_edge_spread_px, scored_positions

SURFACE_FRAMES = 4
SURFACE_POINTS = 20_000
SAMPLES_PER_AXIS = 3
DEPTH_WEIGHT, BACK_FACING_WEIGHT = 0.05, 0.02
"""Of a place's depth, which a picture hardly tells, and of a frame that sees a vertex from behind."""

REQUIRED_STAGES = ("frames", "body", "field", "mesh", "texture")


@dataclass(frozen=True)
class ImagePair:
    """A picture with a known answer, and the avatar's: straight RGBA of the truth, premultiplied RGBA of the avatar."""

    truth: UInt8[np.ndarray, "h w 4"]
    avatar: Float[np.ndarray, "h w 4"]

    def scores(self) -> dict[str, float]:
        """See `frame_scores`."""
        return frame_scores(self.avatar, self.truth[..., :3], self.truth[..., 3])


@dataclass(frozen=True)
class Comparison:
    """A finished run and the truth it should have found."""

    run: FinishedRun
    coverage: Float[np.ndarray, "th tw"]
    truth: SyntheticCapture
    folder: Path

    @cached_property
    def rest_mesh(self) -> Mesh:
        """The avatar in the true rig's A-pose."""
        body, joints = self.truth.subject.body, len(self.truth.subject.body.joint_names)
        identity_wxyz = np.tile(np.array([1.0, 0.0, 0.0, 0.0], dtype=np.float32), (1, joints, 1))
        motion = Motion(np.zeros(1, np.int32), np.zeros(1), identity_wxyz, body.joints_m[:1])
        return retarget_avatar_meshes(self, motion)[0]

    @cached_property
    def alignment(self) -> SimilarityTransform:
        """What lays the avatar over the truth in the true rig's A-pose."""
        return align_surfaces_icp(self.rest_mesh, self.true_rest_mesh)

    @cached_property
    def true_rest_mesh(self) -> Mesh:
        """The outside of the true A-pose."""
        return Mesh(self.truth.subject.body.vertices, self._true_faces)

    @cached_property
    def _true_faces(self) -> Int[np.ndarray, "f 3"]:
        return self.truth.subject.body.faces[find_exterior_faces(self.truth.subject.body.mesh())]

    @cached_property
    def _avatar_faces(self) -> Int[np.ndarray, "f 3"]:
        return self.run.avatar.mesh().faces[find_exterior_faces(self.run.avatar.mesh())]

    def true_surface(self, pose: Float[Tensor, "j 4 4"]) -> Mesh:
        """The clothed person in one pose, without what the A-pose hides inside."""
        return Mesh(pose_vertices(self.truth.subject, pose).numpy(), self._true_faces)

    def avatar_surface(self, pose: Float[Tensor, "j 4 4"]) -> Mesh:
        """The avatar in one pose, without what its A-pose hides inside."""
        return Mesh(self.run.avatar.pose_vertices(pose).numpy(), self._avatar_faces)


def load_comparison(out: Path, run: Path) -> Comparison:
    """Read a run with a texture and the truth of its capture. UserError as the readers do."""
    return Comparison(
        run=load_finished_run({name: run / name for name in REQUIRED_STAGES}),
        coverage=to_float(load_texture(run / "texture").coverage),
        truth=load_ground_truth(out),
        folder=out / "truth",
    )


def compare_rest_surfaces(comparison: Comparison) -> dict[str, float]:
    """The surfaces in the true rig's A-pose."""
    return _aligned_scores(comparison.rest_mesh, comparison.true_rest_mesh, comparison.alignment)


def compare_heldout_surfaces(comparison: Comparison) -> dict[str, float]:
    """The surfaces in some held-out frames, each in its own pose: the refined one here, the true one there."""
    positions = _evenly_spaced(comparison.run.capture.positions(HELDOUT))
    frames = comparison.run.capture.frame_index[positions]
    rows = []
    for position, frame in zip(positions, frames, strict=True):
        avatar = comparison.avatar_surface(comparison.run.refined_canonical_to_world[position])
        true = comparison.true_surface(comparison.truth.canonical_to_world[frame])
        rows.append(_aligned_scores(avatar, true, align_surfaces_icp(avatar, true)))
    return mean_scores(rows)


def compare_novel_poses(comparison: Comparison) -> tuple[dict[str, float], list[ImagePair]]:
    """Skinning: surfaces and pictures when both rigs do a motion that was never filmed."""
    motion = load_motion(comparison.folder / "novel_poses" / "motion.npz")
    rows, pictures = [], []
    for index, (pose, avatar) in enumerate(
        zip(
            canonical_to_world(comparison.truth.subject.body, motion),
            retarget_avatar_meshes(comparison, motion),
            strict=True,
        )
    ):
        true = comparison.true_surface(pose)
        alignment = align_surfaces_icp(avatar, true)
        rows.append(_aligned_scores(avatar, true, alignment))
        expected = read_rgba(comparison.folder / "novel_poses" / f"{index:06d}.png")
        pictures.append(
            ImagePair(expected, _render_avatar(comparison, alignment.transform_mesh(avatar), comparison.truth.camera))
        )
    return mean_scores(rows), pictures


def compare_novel_views(comparison: Comparison) -> list[ImagePair]:
    """Pictures from cameras that never filmed; the avatar in the true pose of the first frame, laid over the truth."""
    avatar = retarget_avatar_meshes(comparison, comparison.truth.motion.select(np.array([0])))[0]
    surface = align_surfaces_icp(
        avatar, comparison.true_surface(comparison.truth.canonical_to_world[0])
    ).transform_mesh(avatar)
    return [
        ImagePair(read_rgba(path.with_suffix(".png")), _render_avatar(comparison, surface, load_camera(path)))
        for path in sorted((comparison.folder / "novel_views").glob("*.npz"))
    ]


def compare_texture(comparison: Comparison, seed: int = 0) -> dict[str, float]:
    """Colours at points spread evenly over the avatar against the true texture at the nearest place.

    Both stand in the true rig's A-pose.

    Returns:
        coverage: share of the surface that the video showed. colour_error: mean absolute difference there, of 255.
        balanced_colour_error: after one gain a channel, because the light of the video is in the texture.
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
    expected = sample_texture(subject.texture_tensor(), uv_true).numpy()
    gain = [_least_absolute_gain(*channels) for channels in zip(avatar_colours.T, expected.T, strict=True)]
    return {
        "coverage": float(observed.mean()),
        "colour_error": 255.0 * float(np.abs(avatar_colours - expected).mean()),
        "balanced_colour_error": 255.0 * float(np.abs(avatar_colours * gain - expected).mean()),
    }


def compare_heldout_images(comparison: Comparison) -> dict[str, dict[str, float]]:
    """Scores of the held-out frames that only the truth can give, means over frames.

    Returns:
        ceiling: of `render_upper_bound`, outlines as soft as those of the report's mesh. field_true_mask,
        mesh_true_mask, ceiling_true_mask: targets cut out of the video by the true mask, where the report takes the
        mask that the frames stage found; meshes have sharp outlines, as true masks have. A frame whose true mask
        cannot be scored is left out there, with a warning.

    Raises:
        UserError: there is no other frame.
    """
    run = comparison.run
    rows: defaultdict[str, list[dict[str, float]]] = defaultdict(list)
    blur_px = additional_blur_sigma_px(median_edge_spread_px(run))
    positions = scored_positions(run.capture)
    for position, upper_bound_rgba in zip(positions.tolist(), render_upper_bound(comparison, positions), strict=True):
        image, mask = (to_uint8(part(position)) for part in (run.capture.image, run.capture.mask))
        rows["upper_bound"].append(frame_scores(blur_coverage(upper_bound_rgba, blur_px), image, mask))
        pose, person_mask = run.refined_canonical_to_world[position], _true_mask(comparison, position)
        if (reason := reason_not_scorable(person_mask)) is not None:
            frame = run.capture.frame_index[position]
            warn(f"held-out frame {frame} is not compared within the true mask of {comparison.folder}: {reason}")
            continue
        mesh = run.avatar.render(run.avatar.pose_vertices(pose), run.camera, SAMPLES_PER_AXIS)
        for name, drawn in {"field": run.field_renderer(pose), "mesh": mesh, "upper_bound": upper_bound_rgba}.items():
            rows[f"{name}_true_mask"].append(frame_scores(drawn, image, person_mask))
    if "mesh_true_mask" not in rows:
        raise UserError(
            f"no held-out frame can be compared within the true masks of {comparison.folder}; is it its truth?"
        )
    return {name: mean_scores(scores) for name, scores in rows.items()}


def render_upper_bound(comparison: Comparison, positions: Int[np.ndarray, "k"]) -> Iterator[Float[np.ndarray, "h w 4"]]:
    """The true mesh and texture, truly lit, drawn in the refined poses by the fitted camera; outlines are sharp.

    What is missing to a perfect picture here is the fault of pose and camera alone. What a perfect reconstruction could
    make good by another shape of the A-pose is not counted: see `unpose_true_vertices`.
    """
    run, subject = comparison.run, comparison.truth.subject
    unposed_subject = replace(subject, body=replace(subject.body, vertices=unpose_true_vertices(comparison)))
    joint = _fitted_joint_of(subject.body, run.body)
    camera = replace(run.camera, world_to_camera=comparison.truth.camera.world_to_camera)
    for position in track(positions.tolist(), "held-out frames"):
        posed = pose_vertices(unposed_subject, run.refined_canonical_to_world[position, joint])
        vertices = _map_between_worlds(posed, run.camera, comparison.truth.camera)
        yield render_subject(unposed_subject, vertices, camera, comparison.truth.light, comparison.truth.samples)


def unpose_true_vertices(comparison: Comparison) -> Float[np.ndarray, "v 3"]:
    """The true vertices as a perfect reconstruction would hold them in the A-pose of the fit.

    Each is where, carried by the refined poses of the training frames, it lies nearest to where it truly was (least
    squares; B the blended matrix of a vertex, y its true place: sum of w |P (B v - y)|^2). P counts what lies along the
    line of sight little, as a picture does; w counts frames in which the surface faces the camera.
    """
    run, truth = comparison.run, comparison.truth
    body, positions = truth.subject.body, run.capture.positions(TRAIN)
    joint, weights = _fitted_joint_of(body, run.body), torch.from_numpy(body.skin_weights)
    motion = truth.motion.select(run.capture.frame_index[positions])
    scale = 1.0 / comparison.alignment.scale
    true_to_fitted = _true_to_fitted_world(torch.from_numpy(motion.root_translation_m), scale, truth.camera, run.camera)
    rotation_matrix = torch.from_numpy(run.camera.world_to_camera[:3, :3])
    view_weights = rotation_matrix.T @ torch.diag(torch.tensor([1.0, 1.0, DEPTH_WEIGHT])) @ rotation_matrix
    normal_matrix, normal_rhs = torch.zeros(len(body.vertices), 3, 3), torch.zeros(len(body.vertices), 3)
    for matrix, position, pose in zip(
        true_to_fitted, positions.tolist(), canonical_to_world(body, motion), strict=True
    ):
        true_vertices = pose_vertices(truth.subject, (matrix @ pose.double()).float())
        blended = torch.einsum("vj,jab->vab", weights, run.refined_canonical_to_world[position, joint])
        view_cosine = _view_cosine(true_vertices, body.faces, run.camera)[:, None, None]
        linear = view_cosine * (blended[:, :3, :3].mT @ view_weights)
        normal_matrix += linear @ blended[:, :3, :3]
        normal_rhs += (linear @ (true_vertices - blended[:, :3, 3])[..., None]).squeeze(-1)
    return torch.linalg.solve(normal_matrix, normal_rhs).numpy()


def _view_cosine(vertices: Float[Tensor, "v 3"], faces: np.ndarray, camera: Camera) -> Float[Tensor, "v"]:
    """Cosine between normal and line of sight where the surface faces the camera, and a little where it does not."""
    normals = torch.from_numpy(Mesh(vertices.numpy(), faces).vertex_normals()).float()
    towards = torch.nn.functional.normalize(torch.from_numpy(camera.centre_m()) - vertices, dim=1)
    return (normals * towards).sum(1).clamp_min(0.0) + BACK_FACING_WEIGHT


def _fitted_joint_of(body: Body, fitted: Body) -> Int[np.ndarray, "j"]:
    """The fitted joint that carries each joint of another rig: that of its name, or its parent's."""
    joint = np.zeros(len(body.joint_names), dtype=np.int64)
    for number, (name, parent) in enumerate(zip(body.joint_names, body.parents, strict=True)):
        joint[number] = fitted.joint(name) if name in fitted.joint_names else joint[max(parent, 0)]
    return joint


def _true_to_fitted_world(
    roots_m: Float[Tensor, "n 3"], scale: float, camera: Camera, fitted: Camera
) -> Float[Tensor, "n 4 4"]:
    """From the true world into the fitted one, where the person is smaller and nearer without looking different: what
    shrinks it about its root, and moves the root to where it looks as large."""
    roots = transform_world_to_camera(roots_m.double(), camera)
    depth = scale * fitted.fx / fitted.width * camera.width / camera.fx
    moved = torch.linalg.inv(torch.from_numpy(fitted.world_to_camera).double())
    rotation_matrix = moved[:3, :3] @ torch.from_numpy(camera.world_to_camera).double()[:3, :3]
    targets = (roots * torch.tensor([scale, scale, depth])) @ moved[:3, :3].T + moved[:3, 3]
    matrices = torch.eye(4, dtype=torch.float64).repeat(len(roots_m), 1, 1)
    matrices[:, :3, :3] = scale * rotation_matrix
    matrices[:, :3, 3] = targets - scale * roots_m.double() @ rotation_matrix.T
    return matrices


def retarget_motion(body: Body, source_body: Body, motion: Motion) -> Motion:
    """The actor's motion for another rig: limbs point where the actor's do, whatever A-pose each rig calls its rest.

    Joints are matched by name; those that the actor lacks follow their parent.
    """
    recorded_joint_of = {name: source_body.joint(name) for name in body.joint_names if name in source_body.joint_names}
    local = quaternion_to_matrix(torch.from_numpy(motion.rotations_wxyz).double())
    rest_joints_m = torch.from_numpy(source_body.joints_m).double()
    world = forward_kinematics(
        local, torch.from_numpy(motion.root_translation_m).double(), rest_joints_m, source_body.parents
    )
    reference = (np.tile(np.eye(3), (len(rest_joints_m), 1, 1)), rest_joints_m.numpy())
    rotations = retarget_rotations(body, recorded_joint_of, world[..., :3, :3].numpy(), reference, np.eye(3))
    return motion.with_pose(local_quaternions(rotations, body.parents), motion.root_translation_m)


def retarget_avatar_meshes(comparison: Comparison, motion: Motion) -> list[Mesh]:
    """The avatar in every pose of a true motion; where it stands and how large it is follows from an alignment."""
    body = comparison.run.body
    poses = canonical_to_world(body, retarget_motion(body, comparison.truth.subject.body, motion))
    return [comparison.avatar_surface(pose) for pose in poses]


def _aligned_scores(avatar: Mesh, true: Mesh, alignment: SimilarityTransform) -> dict[str, float]:
    scores = surface_scores(alignment.transform_mesh(avatar), true, SURFACE_POINTS)
    return scores | {"scale_to_truth": alignment.scale}


def _true_mask(comparison: Comparison, position: int) -> UInt8[np.ndarray, "h w"]:
    """The person's true coverage of a chosen frame, at the size of the run's images."""
    capture = comparison.run.capture
    mask = load_true_mask(comparison.folder.parent, int(capture.frame_index[position]))
    return cv2.resize(mask, (capture.width, capture.height), interpolation=cv2.INTER_AREA)


def _render_avatar(comparison: Comparison, surface: Mesh, camera: Camera) -> Float[np.ndarray, "h w 4"]:
    return comparison.run.avatar.render(torch.from_numpy(surface.vertices).float(), camera, SAMPLES_PER_AXIS)


def _nearest_uv(
    points: Float[np.ndarray, "n 3"], mesh: Mesh, uv: Float[Tensor, "t 2"], faces_uv: np.ndarray
) -> Float[Tensor, "n 2"]:
    """Atlas coordinates of the place on the mesh nearest to each point."""
    _, faces, barycentric = closest_points_on_mesh(points, mesh)
    corners = uv[torch.from_numpy(faces_uv[faces].astype(np.int64))]
    return (corners * torch.from_numpy(barycentric)[..., None]).sum(1).float()


def _least_absolute_gain(values: Float[np.ndarray, "n"], targets: Float[np.ndarray, "n"]) -> float:
    """The factor with the least absolute error: the median of the ratios, each as heavy as its value."""
    ratios = targets / np.maximum(values, 1e-6)
    order = np.argsort(ratios)
    cumulative_weight = np.cumsum(values[order])
    return float(ratios[order[np.searchsorted(cumulative_weight, 0.5 * cumulative_weight[-1])]])


def _map_between_worlds(vertices: Float[Tensor, "v 3"], camera: Camera, target: Camera) -> Float[Tensor, "v 3"]:
    """Points of one camera's world in the other's, where they look the same from the other."""
    matrix = torch.from_numpy(np.linalg.inv(target.world_to_camera) @ camera.world_to_camera).to(vertices)
    return vertices @ matrix[:3, :3].T + matrix[:3, 3]


def _evenly_spaced(positions: np.ndarray) -> np.ndarray:
    return np.unique(positions[np.linspace(0, len(positions) - 1, SURFACE_FRAMES).round().astype(int)])
