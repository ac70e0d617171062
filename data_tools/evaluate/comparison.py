"""A finished run and the ground truth of its synthetic capture, as loaded for a comparison."""

from dataclasses import dataclass
from functools import cached_property
from pathlib import Path

import numpy as np
import torch
from jaxtyping import Bool, Float, Int, UInt8
from torch import Tensor

from data_tools.evaluate.rig_offsets import joint_rotations_in_camera, mean_rotation_offsets, rotate_joints
from data_tools.evaluate.truth import load_ground_truth
from data_tools.synthetic.rig.labels import FaceLabels
from data_tools.synthetic.scene.capture import SyntheticCapture
from data_tools.synthetic.scene.renderer import pose_vertices
from pipeline.avatar.finished_run import FinishedRun, load_finished_run
from pipeline.avatar.motion.feet import snap_feet_to_floor
from pipeline.avatar.motion.retarget import retarget_rotations
from pipeline.body.body import Body, Motion, canonical_to_world
from pipeline.geometry.camera import Camera
from pipeline.geometry.mesh import Mesh
from pipeline.geometry.rotation import quaternion_to_matrix
from pipeline.geometry.shadow_map import find_exterior_faces
from pipeline.geometry.similarity import SimilarityTransform
from pipeline.geometry.skinning import forward_kinematics, local_quaternions
from pipeline.io.image import to_float
from pipeline.metrics.alignment import align_surfaces_icp
from pipeline.metrics.images import frame_scores
from pipeline.metrics.surfaces import SurfaceCorrespondence, surface_correspondence
from pipeline.texture.files import load_texture

SURFACE_POINTS = 20_000
"""Sample points per surface."""

REQUIRED_STAGES = ("frames", "body", "field", "mesh", "texture")


@dataclass(frozen=True)
class ImagePair:
    """A true image and the render of the avatar from the same camera.

    Attributes:
        truth: straight RGBA.
        avatar: premultiplied RGBA in [0, 1].
    """

    truth: UInt8[np.ndarray, "h w 4"]
    avatar: Float[np.ndarray, "h w 4"]

    def scores(self) -> dict[str, float]:
        """Return the scores of `frame_scores`."""
        return frame_scores(self.avatar, self.truth[..., :3], self.truth[..., 3])


@dataclass(frozen=True, eq=False)
class MatchedRigs:
    """The fitted person of a run beside the true one: two rigs, whose joints are matched by their mean difference.

    Attributes:
        body, motion, camera: fitted.
    """

    body: Body
    motion: Motion
    camera: Camera
    truth: SyntheticCapture

    @cached_property
    def joint_offsets(self) -> Float[Tensor, "j 3 3"]:
        """Mean rotation over the frames of the run from the retargeted true motion to the fitted motion."""
        true_motion = self.truth.motion.select(self.motion.frame_index)
        return mean_rotation_offsets(
            joint_rotations_in_camera(self.body, self.motion, self.camera),
            joint_rotations_in_camera(self.body, self.retarget(true_motion), self.truth.camera),
        )

    def retarget(self, motion: Motion) -> Motion:
        """Retarget a motion of the true rig, see `retarget_motion`."""
        return retarget_motion(self.body, self.truth.subject.body, motion)

    def match(self, motion: Motion) -> Motion:
        """Retarget a motion of the true rig such that both rigs agree as they do, on average, in the video."""
        return rotate_joints(self.body, self.retarget(motion), self.joint_offsets)

    @cached_property
    def true_rest_motion(self) -> Motion:
        """The A-pose of the true rig: one frame."""
        body, joints = self.truth.subject.body, len(self.truth.subject.body.joint_names)
        identity_wxyz = np.tile(np.array([1.0, 0.0, 0.0, 0.0], dtype=np.float32), (1, joints, 1))
        return Motion(np.zeros(1, np.int32), np.zeros(1), identity_wxyz, body.joints_m[:1])

    @cached_property
    def true_exterior(self) -> Bool[np.ndarray, "f"]:
        """Which faces of the true person are exterior in the A-pose."""
        return find_exterior_faces(self.truth.subject.body.mesh())

    @cached_property
    def true_faces(self) -> Int[np.ndarray, "f 3"]:
        """The faces of `true_exterior`."""
        return self.truth.subject.body.faces[self.true_exterior]

    def true_surface(self, pose: Float[Tensor, "j 4 4"]) -> Mesh:
        """Return the true person in one pose, with the faces that are exterior in the A-pose."""
        return Mesh(pose_vertices(self.truth.subject, pose).numpy(), self.true_faces)


@dataclass(frozen=True)
class Comparison:
    """A finished run and its ground truth.

    Attributes:
        coverage: of the texture, in [0, 1]; above 0.5 the texel was observed in the video.
        folder: of the ground truth.
    """

    run: FinishedRun
    coverage: Float[np.ndarray, "th tw"]
    truth: SyntheticCapture
    folder: Path

    @cached_property
    def rigs(self) -> MatchedRigs:
        """The rig of the avatar and the true one."""
        return MatchedRigs(self.run.body, self.run.motion, self.run.camera, self.truth)

    @cached_property
    def rest_mesh(self) -> Mesh:
        """The exterior of the avatar in the A-pose of the true rig, with the hips where the true hips are."""
        return self.avatar_surface(canonical_to_world(self.run.body, self._rest_motion)[0])

    @cached_property
    def standing_mesh(self) -> Mesh:
        """The exterior of the avatar in the A-pose of the true rig, with its feet on y = 0."""
        standing = snap_feet_to_floor(self.run.body, self._rest_motion, 0.0)
        return self.avatar_surface(canonical_to_world(self.run.body, standing)[0])

    @cached_property
    def rest_correspondence(self) -> SurfaceCorrespondence:
        """Corresponding points of `rest_mesh`, aligned, and `true_rest_mesh`."""
        return surface_correspondence(
            self.alignment.transform_mesh(self.rest_mesh), self.true_rest_mesh, SURFACE_POINTS
        )

    @cached_property
    def matched_rest_mesh(self) -> Mesh:
        """The exterior of the avatar in the A-pose of the true rig, see `MatchedRigs.match`."""
        return self.avatar_surface(canonical_to_world(self.run.body, self.rigs.match(self.rigs.true_rest_motion))[0])

    @cached_property
    def matched_alignment(self) -> SimilarityTransform:
        """The similarity from `matched_rest_mesh` to `true_rest_mesh`."""
        return align_surfaces_icp(self.matched_rest_mesh, self.true_rest_mesh)

    @cached_property
    def matched_correspondence(self) -> SurfaceCorrespondence:
        """Corresponding points of `matched_rest_mesh`, aligned, and `true_rest_mesh`."""
        return surface_correspondence(
            self.matched_alignment.transform_mesh(self.matched_rest_mesh), self.true_rest_mesh, SURFACE_POINTS
        )

    @cached_property
    def _rest_motion(self) -> Motion:
        """The A-pose of the true rig, retargeted to the rig of the avatar: one frame."""
        return self.rigs.retarget(self.rigs.true_rest_motion)

    @cached_property
    def alignment(self) -> SimilarityTransform:
        """The similarity from the avatar to the truth, both in the A-pose of the true rig."""
        return align_surfaces_icp(self.rest_mesh, self.true_rest_mesh)

    @cached_property
    def true_rest_mesh(self) -> Mesh:
        """The exterior of the true person in the A-pose."""
        return Mesh(self.truth.subject.body.vertices, self.rigs.true_faces)

    @cached_property
    def true_labels(self) -> FaceLabels | None:
        """The labels of the faces of `true_rest_mesh`; None if the capture has none."""
        labels = self.truth.subject.labels
        return None if labels is None else labels.select(self.rigs.true_exterior)

    @cached_property
    def _avatar_faces(self) -> Int[np.ndarray, "f 3"]:
        return self.run.avatar.mesh().faces[find_exterior_faces(self.run.avatar.mesh())]

    def avatar_surface(self, pose: Float[Tensor, "j 4 4"]) -> Mesh:
        """Return the avatar in one pose, with the faces that are exterior in its A-pose."""
        return Mesh(self.run.avatar.pose_vertices(pose).numpy(), self._avatar_faces)


def load_comparison(out: Path, run: Path) -> Comparison:
    """Read a run and the ground truth of its capture.

    Raises:
        UserError: a stage up to `texture` is not finished, or the ground truth is missing or damaged.
    """
    return Comparison(
        run=load_finished_run({name: run / name for name in REQUIRED_STAGES}),
        coverage=to_float(load_texture(run / "texture").coverage),
        truth=load_ground_truth(out),
        folder=out / "truth",
    )


def retarget_motion(body: Body, source_body: Body, motion: Motion) -> Motion:
    """Retarget a motion from one rig to another so that limbs have equal directions, whatever the rest poses are.

    Joints are matched by name; joints that the source rig lacks follow their parent.
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
