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

from data_tools.evaluate.truth import load_truth, true_mask
from data_tools.synthetic.rig.retarget import carried_rotations, local_rotations
from data_tools.synthetic.scene.capture import Capture
from data_tools.synthetic.scene.renderer import pose_vertices, render_subject
from data_tools.synthetic.scene.shadow import seen_from_outside
from pipeline.avatar.finished_run import FinishedRun, load_finished_run
from pipeline.body.body import Body, Motion, canonical_to_world
from pipeline.body.files import load_camera, load_motion
from pipeline.capture.frame_selection import HELDOUT, TRAIN
from pipeline.core.errors import UserError
from pipeline.core.progress import track, warn
from pipeline.geometry.camera import Camera, world_to_camera_points
from pipeline.geometry.mesh import Mesh
from pipeline.geometry.rotation import quaternion_to_matrix
from pipeline.geometry.skinning import forward_kinematics
from pipeline.geometry.surface import closest_on_mesh
from pipeline.geometry.texture_rendering import sample_texture, soften_outline
from pipeline.io.image import read_gray, read_rgba, to_float, to_uint8
from pipeline.metrics.alignment import Similarity, align_surfaces
from pipeline.metrics.images import frame_scores, mean_scores, missing_blur_px, unscorable
from pipeline.metrics.surfaces import sample_surface, surface_scores
from stages.report import outline_spread_px, scored_positions

SURFACE_FRAMES = 4
SURFACE_POINTS = 20_000
SAMPLES = 3
SIGHT_WEIGHT, HIDDEN_WEIGHT = 0.05, 0.02
"""Of a place's depth, which a picture hardly tells, and of a frame that sees a vertex from behind."""

NEEDED = ("frames", "body", "field", "mesh", "texture")


@dataclass(frozen=True)
class Pair:
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
    truth: Capture
    folder: Path

    @cached_property
    def rest(self) -> Mesh:
        """The avatar in the true rig's A-pose."""
        body, joints = self.truth.subject.body, len(self.truth.subject.body.joint_names)
        still = np.tile(np.array([1.0, 0.0, 0.0, 0.0], dtype=np.float32), (1, joints, 1))
        motion = Motion(np.zeros(1, np.int32), np.zeros(1), still, body.joints_m[:1])
        return acted(self, motion)[0]

    @cached_property
    def alignment(self) -> Similarity:
        """What lays the avatar over the truth in the true rig's A-pose."""
        return align_surfaces(self.rest, self.true_rest)

    @cached_property
    def true_rest(self) -> Mesh:
        """The outside of the true A-pose."""
        return Mesh(self.truth.subject.body.vertices, self._true_faces)

    @cached_property
    def _true_faces(self) -> Int[np.ndarray, "f 3"]:
        return self.truth.subject.body.faces[seen_from_outside(self.truth.subject.body.mesh())]

    @cached_property
    def _avatar_faces(self) -> Int[np.ndarray, "f 3"]:
        return self.run.avatar.mesh().faces[seen_from_outside(self.run.avatar.mesh())]

    def true_surface(self, pose: Float[Tensor, "j 4 4"]) -> Mesh:
        """The clothed person in one pose, without what the A-pose hides inside."""
        return Mesh(pose_vertices(self.truth.subject, pose).numpy(), self._true_faces)

    def avatar_surface(self, pose: Float[Tensor, "j 4 4"]) -> Mesh:
        """The avatar in one pose, without what its A-pose hides inside."""
        return Mesh(self.run.avatar.posed(pose).numpy(), self._avatar_faces)


def load_comparison(out: Path, run: Path) -> Comparison:
    """Read a run with a texture and the truth of its capture. UserError as the readers do."""
    return Comparison(
        run=load_finished_run({name: run / name for name in NEEDED}),
        coverage=to_float(read_gray(run / "texture" / "coverage.png")),
        truth=load_truth(out),
        folder=out / "truth",
    )


def compare_shape(pair: Comparison) -> dict[str, float]:
    """The surfaces in the true rig's A-pose."""
    return _aligned_scores(pair.rest, pair.true_rest, pair.alignment)


def compare_filmed(pair: Comparison) -> dict[str, float]:
    """The surfaces in some held-out frames, each in its own pose: the refined one here, the true one there."""
    positions = _some(pair.run.capture.positions(HELDOUT))
    frames = pair.run.capture.frame_index[positions]
    rows = []
    for position, frame in zip(positions, frames, strict=True):
        avatar = pair.avatar_surface(pair.run.refined[position])
        true = pair.true_surface(pair.truth.canonical_to_world[frame])
        rows.append(_aligned_scores(avatar, true, align_surfaces(avatar, true)))
    return mean_scores(rows)


def compare_novel_poses(pair: Comparison) -> tuple[dict[str, float], list[Pair]]:
    """Skinning: surfaces and pictures when both rigs do a motion that was never filmed."""
    motion = load_motion(pair.folder / "novel_poses" / "motion.npz")
    rows, pictures = [], []
    for index, (pose, avatar) in enumerate(
        zip(canonical_to_world(pair.truth.subject.body, motion), acted(pair, motion), strict=True)
    ):
        true = pair.true_surface(pose)
        alignment = align_surfaces(avatar, true)
        rows.append(_aligned_scores(avatar, true, alignment))
        answer = read_rgba(pair.folder / "novel_poses" / f"{index:06d}.png")
        pictures.append(Pair(answer, _drawn(pair, alignment.moved(avatar), pair.truth.camera)))
    return mean_scores(rows), pictures


def compare_novel_views(pair: Comparison) -> list[Pair]:
    """Pictures from cameras that never filmed; the avatar in the true pose of the first frame, laid over the truth."""
    avatar = acted(pair, pair.truth.motion.select(np.array([0])))[0]
    surface = align_surfaces(avatar, pair.true_surface(pair.truth.canonical_to_world[0])).moved(avatar)
    return [
        Pair(read_rgba(path.with_suffix(".png")), _drawn(pair, surface, load_camera(path)))
        for path in sorted((pair.folder / "novel_views").glob("*.npz"))
    ]


def compare_texture(pair: Comparison, seed: int = 0) -> dict[str, float]:
    """Colours at points spread evenly over the avatar against the true texture at the nearest place.

    Both stand in the true rig's A-pose.

    Returns:
        coverage: share of the surface that the video showed. colour_error: mean absolute difference there, of 255.
        balanced_colour_error: after one gain a channel, because the light of the video is in the texture.
    """
    avatar = Mesh(pair.rest.vertices, pair.run.avatar.faces.numpy())
    true = pair.truth.subject.body.mesh()
    points, _ = sample_surface(avatar, SURFACE_POINTS, seed)
    uv = _uv_at(points, avatar, pair.run.avatar.uv, pair.run.avatar.faces_uv.numpy())
    seen = sample_texture(torch.from_numpy(pair.coverage)[..., None], uv)[:, 0].numpy() > 0.5
    found = sample_texture(pair.run.avatar.diffuse, uv[seen]).numpy()
    subject = pair.truth.subject
    places = pair.alignment(points[seen])
    there = _uv_at(places, true, torch.from_numpy(subject.uv), subject.faces_uv)
    answer = sample_texture(subject.texture_tensor(), there).numpy()
    gain = [_gain(*channels) for channels in zip(found.T, answer.T, strict=True)]
    return {
        "coverage": float(seen.mean()),
        "colour_error": 255.0 * float(np.abs(found - answer).mean()),
        "balanced_colour_error": 255.0 * float(np.abs(found * gain - answer).mean()),
    }


def compare_held_out(pair: Comparison) -> dict[str, dict[str, float]]:
    """Scores of the held-out frames that only the truth can give, means over frames.

    Returns:
        ceiling: of `ceiling_pictures`, outlines as soft as those of the report's mesh. field_true_mask,
        mesh_true_mask, ceiling_true_mask: targets cut out of the video by the true mask, where the report takes the
        mask that the frames stage found; meshes have sharp outlines, as true masks have. A frame whose true mask
        cannot be scored is left out there, with a warning.

    Raises:
        UserError: there is no other frame.
    """
    run = pair.run
    rows: defaultdict[str, list[dict[str, float]]] = defaultdict(list)
    blur_px = missing_blur_px(outline_spread_px(run))
    positions = scored_positions(run.capture)
    for position, perfect in zip(positions.tolist(), ceiling_pictures(pair, positions), strict=True):
        image, mask = (to_uint8(part(position)) for part in (run.capture.image, run.capture.mask))
        rows["ceiling"].append(frame_scores(soften_outline(perfect, blur_px), image, mask))
        pose, cut = run.refined[position], _true_mask(pair, position)
        if (reason := unscorable(cut)) is not None:
            frame = run.capture.frame_index[position]
            warn(f"held-out frame {frame} is not compared within the true mask of {pair.folder}: {reason}")
            continue
        mesh = run.avatar.render(run.avatar.posed(pose), run.camera, SAMPLES)
        for name, drawn in {"field": run.draw_field(pose), "mesh": mesh, "ceiling": perfect}.items():
            rows[f"{name}_true_mask"].append(frame_scores(drawn, image, cut))
    if "mesh_true_mask" not in rows:
        raise UserError(f"no held-out frame can be compared within the true masks of {pair.folder}; is it its truth?")
    return {name: mean_scores(scores) for name, scores in rows.items()}


def ceiling_pictures(pair: Comparison, positions: Int[np.ndarray, "k"]) -> Iterator[Float[np.ndarray, "h w 4"]]:
    """The true mesh and texture, truly lit, drawn in the refined poses by the fitted camera; outlines are sharp.

    What is missing to a perfect picture here is the fault of pose and camera alone. What a perfect reconstruction could
    make good by another shape of the A-pose is not counted: see `absorbed`.
    """
    run, subject = pair.run, pair.truth.subject
    held = replace(subject, body=replace(subject.body, vertices=absorbed(pair)))
    joint = _carriers(subject.body, run.body)
    camera = replace(run.camera, world_to_camera=pair.truth.camera.world_to_camera)
    for position in track(positions.tolist(), "held-out frames"):
        posed = pose_vertices(held, run.refined[position, joint])
        vertices = _between_worlds(posed, run.camera, pair.truth.camera)
        yield render_subject(held, vertices, camera, pair.truth.light, pair.truth.samples)


def absorbed(pair: Comparison) -> Float[np.ndarray, "v 3"]:
    """The true vertices as a perfect reconstruction would hold them in the A-pose of the fit.

    Each is where, carried by the refined poses of the training frames, it lies nearest to where it truly was (least
    squares; B the blended matrix of a vertex, y its true place: sum of w |P (B v - y)|^2). P counts what lies along the
    line of sight little, as a picture does; w counts frames in which the surface faces the camera.
    """
    run, truth = pair.run, pair.truth
    body, positions = truth.subject.body, run.capture.positions(TRAIN)
    joint, weights = _carriers(body, run.body), torch.from_numpy(body.skin_weights)
    motion = truth.motion.select(run.capture.frame_index[positions])
    scale = 1.0 / pair.alignment.scale
    into_fitted = _into_fitted_world(torch.from_numpy(motion.root_translation_m), scale, truth.camera, run.camera)
    turn = torch.from_numpy(run.camera.world_to_camera[:3, :3])
    seen = turn.T @ torch.diag(torch.tensor([1.0, 1.0, SIGHT_WEIGHT])) @ turn
    square, right = torch.zeros(len(body.vertices), 3, 3), torch.zeros(len(body.vertices), 3)
    for matrix, position, pose in zip(into_fitted, positions.tolist(), canonical_to_world(body, motion), strict=True):
        there = pose_vertices(truth.subject, (matrix @ pose.double()).float())
        blended = torch.einsum("vj,jab->vab", weights, run.refined[position, joint])
        facing = _facing(there, body.faces, run.camera)[:, None, None]
        linear = facing * (blended[:, :3, :3].mT @ seen)
        square += linear @ blended[:, :3, :3]
        right += (linear @ (there - blended[:, :3, 3])[..., None]).squeeze(-1)
    return torch.linalg.solve(square, right).numpy()


def _facing(vertices: Float[Tensor, "v 3"], faces: np.ndarray, camera: Camera) -> Float[Tensor, "v"]:
    """Cosine between normal and line of sight where the surface faces the camera, and a little where it does not."""
    normals = torch.from_numpy(Mesh(vertices.numpy(), faces).vertex_normals()).float()
    towards = torch.nn.functional.normalize(torch.from_numpy(camera.centre_m()) - vertices, dim=1)
    return (normals * towards).sum(1).clamp_min(0.0) + HIDDEN_WEIGHT


def _carriers(body: Body, fitted: Body) -> Int[np.ndarray, "j"]:
    """The fitted joint that carries each joint of another rig: that of its name, or its parent's."""
    joint = np.zeros(len(body.joint_names), dtype=np.int64)
    for number, (name, parent) in enumerate(zip(body.joint_names, body.parents, strict=True)):
        joint[number] = fitted.joint(name) if name in fitted.joint_names else joint[max(parent, 0)]
    return joint


def _into_fitted_world(
    roots_m: Float[Tensor, "n 3"], scale: float, camera: Camera, fitted: Camera
) -> Float[Tensor, "n 4 4"]:
    """From the true world into the fitted one, where the person is smaller and nearer without looking different: what
    shrinks it about its root, and moves the root to where it looks as large."""
    roots = world_to_camera_points(roots_m.double(), camera)
    depth = scale * fitted.fx / fitted.width * camera.width / camera.fx
    moved = torch.linalg.inv(torch.from_numpy(fitted.world_to_camera).double())
    turn = moved[:3, :3] @ torch.from_numpy(camera.world_to_camera).double()[:3, :3]
    targets = (roots * torch.tensor([scale, scale, depth])) @ moved[:3, :3].T + moved[:3, 3]
    matrices = torch.eye(4, dtype=torch.float64).repeat(len(roots_m), 1, 1)
    matrices[:, :3, :3] = scale * turn
    matrices[:, :3, 3] = targets - scale * roots_m.double() @ turn.T
    return matrices


def taken_over(body: Body, actor: Body, motion: Motion) -> Motion:
    """The actor's motion for another rig: limbs point where the actor's do, whatever A-pose each rig calls its rest.

    Joints are matched by name; those that the actor lacks follow their parent.
    """
    source = {name: actor.joint(name) for name in body.joint_names if name in actor.joint_names}
    local = quaternion_to_matrix(torch.from_numpy(motion.rotations_wxyz).double())
    places = torch.from_numpy(actor.joints_m).double()
    world = forward_kinematics(local, torch.from_numpy(motion.root_translation_m).double(), places, actor.parents)
    reference = (np.tile(np.eye(3), (len(places), 1, 1)), places.numpy())
    rotations = carried_rotations(body, source, world[..., :3, :3].numpy(), reference, np.eye(3))
    return motion.with_pose(local_rotations(rotations, body.parents), motion.root_translation_m)


def acted(pair: Comparison, motion: Motion) -> list[Mesh]:
    """The avatar in every pose of a true motion; where it stands and how large it is follows from an alignment."""
    body = pair.run.body
    poses = canonical_to_world(body, taken_over(body, pair.truth.subject.body, motion))
    return [pair.avatar_surface(pose) for pose in poses]


def _aligned_scores(avatar: Mesh, true: Mesh, alignment: Similarity) -> dict[str, float]:
    scores = surface_scores(alignment.moved(avatar), true, SURFACE_POINTS)
    return scores | {"scale_to_truth": alignment.scale}


def _true_mask(pair: Comparison, position: int) -> UInt8[np.ndarray, "h w"]:
    """The person's true coverage of a chosen frame, at the size of the run's images."""
    capture = pair.run.capture
    mask = true_mask(pair.folder.parent, int(capture.frame_index[position]))
    return cv2.resize(mask, (capture.width, capture.height), interpolation=cv2.INTER_AREA)


def _drawn(pair: Comparison, surface: Mesh, camera: Camera) -> Float[np.ndarray, "h w 4"]:
    return pair.run.avatar.render(torch.from_numpy(surface.vertices).float(), camera, SAMPLES)


def _uv_at(
    points: Float[np.ndarray, "n 3"], mesh: Mesh, uv: Float[Tensor, "t 2"], faces_uv: np.ndarray
) -> Float[Tensor, "n 2"]:
    """Atlas coordinates of the place on the mesh nearest to each point."""
    _, faces, barycentric = closest_on_mesh(points, mesh)
    corners = uv[torch.from_numpy(faces_uv[faces].astype(np.int64))]
    return (corners * torch.from_numpy(barycentric)[..., None]).sum(1).float()


def _gain(values: Float[np.ndarray, "n"], targets: Float[np.ndarray, "n"]) -> float:
    """The factor with the least absolute error: the median of the ratios, each as heavy as its value."""
    ratios = targets / np.maximum(values, 1e-6)
    order = np.argsort(ratios)
    heavy = np.cumsum(values[order])
    return float(ratios[order[np.searchsorted(heavy, 0.5 * heavy[-1])]])


def _between_worlds(vertices: Float[Tensor, "v 3"], camera: Camera, target: Camera) -> Float[Tensor, "v 3"]:
    """Points of one camera's world in the other's, where they look the same from the other."""
    matrix = torch.from_numpy(np.linalg.inv(target.world_to_camera) @ camera.world_to_camera).to(vertices)
    return vertices @ matrix[:3, :3].T + matrix[:3, 3]


def _some(positions: np.ndarray) -> np.ndarray:
    return np.unique(positions[np.linspace(0, len(positions) - 1, SURFACE_FRAMES).round().astype(int)])
