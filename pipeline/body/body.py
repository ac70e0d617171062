"""The parametric body model, the body of one person, and its motion.

`ParametricBody` maps shape parameters to a body in an A-pose. A fit fixes one shape: `Body`, whose A-pose is the bind
pose, and `Motion`, one pose per frame. Joints have the names of Mixamo, which Ready Player Me and Unity's humanoid
mapping use as well, and identity rest orientations, so that a pose here is a glTF pose.

Dimensions: v vertices, f faces, j joints, n frames, p shape parameters.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from functools import lru_cache
from typing import Protocol, runtime_checkable

import numpy as np
import torch
from jaxtyping import Float, Int
from torch import Tensor

from pipeline.body.anny_cache import construct_anny, is_complete
from pipeline.geometry.mesh import Mesh
from pipeline.geometry.rotation import quaternion_to_matrix
from pipeline.geometry.skinning import forward_kinematics, skinning_transforms


@dataclass(frozen=True)
class Body:
    """The body of one person in the A-pose: canonical frame (+Y up, facing +Z, metres, lowest point at y = 0).

    hem_m: height of the hem of a skirt or coat that hangs from leg to leg; None without one.
    """

    joint_names: tuple[str, ...]
    parents: Int[np.ndarray, "j"]
    joints_m: Float[np.ndarray, "j 3"]
    vertices: Float[np.ndarray, "v 3"]
    faces: Int[np.ndarray, "f 3"]
    skin_weights: Float[np.ndarray, "v j"]
    shape: dict[str, float]
    hem_m: float | None = None

    def mesh(self) -> Mesh:
        """Return the A-pose surface."""
        return Mesh(self.vertices, self.faces)

    def joint(self, name: str) -> int:
        """Return the index of a joint.

        Raises:
            ValueError: there is no joint of this name.
        """
        return self.joint_names.index(name)

    def arm_joints(self) -> list[int]:
        """Return the indices of the joints of arms and hands."""
        return [index for index, name in enumerate(self.joint_names) if "Arm" in name or "Hand" in name]

    def height_m(self) -> float:
        """Return the height of the A-pose, from sole to crown."""
        return float(np.ptp(self.vertices[:, 1]))

    def height_on_legs_m(self, share: float) -> float:
        """Return a height on both legs in the A-pose: 0 at the hips, 1 at the knees, more below them."""
        hips_m, knees_m = (
            np.mean([self.joints_m[self.joint(side + name), 1] for side in ("Left", "Right")])
            for name in ("UpLeg", "Leg")
        )
        return float(hips_m + share * (knees_m - hips_m))


@dataclass(frozen=True)
class Motion:
    """A pose in each frame: local rotations (identity: A-pose) and the world position of the root joint.

    frame_index: in the recording. time_s: since the first frame of the recording.
    """

    frame_index: Int[np.ndarray, "n"]
    time_s: Float[np.ndarray, "n"]
    rotations_wxyz: Float[np.ndarray, "n j 4"]
    root_translation_m: Float[np.ndarray, "n 3"]

    def select(self, rows: np.ndarray) -> Motion:
        """Return the motion at selected rows (indices or mask)."""
        return Motion(
            self.frame_index[rows], self.time_s[rows], self.rotations_wxyz[rows], self.root_translation_m[rows]
        )

    def with_poses_at(self, rows: np.ndarray, poses: Motion) -> Motion:
        """Return the motion with other poses at selected rows (indices or mask)."""
        rotations_wxyz, root_translation_m = self.rotations_wxyz.copy(), self.root_translation_m.copy()
        rotations_wxyz[rows], root_translation_m[rows] = poses.rotations_wxyz, poses.root_translation_m
        return self.with_pose(rotations_wxyz, root_translation_m)

    def with_pose(self, rotations_wxyz: np.ndarray, root_translation_m: np.ndarray) -> Motion:
        """Return the same frames with other poses."""
        return replace(
            self,
            rotations_wxyz=np.asarray(rotations_wxyz, dtype=np.float32),
            root_translation_m=np.asarray(root_translation_m, dtype=np.float32),
        )


def canonical_to_world(body: Body, motion: Motion) -> Float[Tensor, "n j 4 4"]:
    """Return the skinning matrices of every frame."""
    joints_m = torch.as_tensor(body.joints_m)
    joint_to_world = forward_kinematics(
        quaternion_to_matrix(torch.as_tensor(motion.rotations_wxyz)),
        torch.as_tensor(motion.root_translation_m),
        joints_m,
        body.parents,
    )
    return skinning_transforms(joint_to_world, joints_m)


def posed_joints_m(body: Body, canonical_to_world: Float[Tensor, "*n j 4 4"]) -> Float[np.ndarray, "*n j 3"]:
    """Return the positions of all joints, m, world; float64."""
    transforms = canonical_to_world.numpy().astype(np.float64)
    return (transforms[..., :3, :3] @ body.joints_m[:, :, None])[..., 0] + transforms[..., :3, 3]


PHENOTYPE_DEFAULTS = {
    "gender": 0.5,
    "age": 2.0 / 3.0,
    "muscle": 0.5,
    "weight": 0.5,
    "height": 0.5,
    "proportions": 0.5,
    "cupsize": 0.5,
    "firmness": 0.5,
    "african": 1.0 / 3.0,
    "asian": 1.0 / 3.0,
    "caucasian": 1.0 / 3.0,
}
"""Anny's phenotypes, each in [0, 1].

Gender 0 is male. Age 2/3 is a young adult (0 baby, 1/3 child, 2/3 young, 1 old).
"""

LOCAL_CHANGES = {
    "upperarm-length": ("measure-upperarm-length-incr",),
    "lowerarm-length": ("measure-lowerarm-length-incr",),
    "upperleg-length": ("measure-upperleg-height-incr",),
    "lowerleg-length": ("measure-lowerleg-height-incr",),
    "neck-length": ("measure-neck-height-incr",),
    "nape-to-waist": ("measure-napetowaist-dist-incr",),
    "waist-to-hip": ("measure-waisttohip-dist-incr",),
    "shoulder-width": ("measure-shoulder-dist-incr",),
    "torso-width": ("torso-scale-horiz-incr",),
    "torso-depth": ("torso-scale-depth-incr",),
    "hip-depth": ("hip-scale-depth-incr",),
    "bust-girth": ("measure-bust-circ-incr",),
    "waist-girth": ("measure-waist-circ-incr",),
    "hips-girth": ("measure-hips-circ-incr",),
    "stomach-tone": ("stomach-tone-incr",),
    "neck-girth": ("measure-neck-circ-incr",),
    "upperarm-girth": ("measure-upperarm-circ-incr",),
    "thigh-girth": ("measure-thigh-circ-incr",),
    "knee-girth": ("measure-knee-circ-incr",),
    "calf-girth": ("measure-calf-circ-incr",),
    "ankle-girth": ("measure-ankle-circ-incr",),
    "head-height": ("head-scale-vert-incr",),
    "head-width": ("head-scale-horiz-incr",),
    "head-depth": ("head-scale-depth-incr",),
    "foot-size": ("l-foot-scale-incr", "r-foot-scale-incr"),
    "hand-size": ("l-hand-scale-incr", "r-hand-scale-incr"),
}
"""Symmetric changes of body parts, each in [-1, 1] with default 0, and their names in Anny."""

SCALE = "scale"
"""Uniform scale of the body; the phenotype `height` changes the proportions as well."""

SHAPE_DEFAULTS = {**PHENOTYPE_DEFAULTS, **dict.fromkeys(LOCAL_CHANGES, 0.0), SCALE: 1.0}
"""Shape parameters with their defaults."""

ANNY_OPTIONS = {
    "rig": "mixamo",
    "phenotypes": "all",
    "skinning_method": "lbs",
    "local_changes": [name for names in LOCAL_CHANGES.values() for name in names],
}
"""Arguments of `anny.Anny`."""

ANNY_LANDMARKS_M = {
    "nose": (0.000, 1.703, 0.141),
    "eye_inner": (0.018, 1.739, 0.117),
    "eye": (0.027, 1.739, 0.114),
    "eye_outer": (0.038, 1.739, 0.107),
    "ear": (0.058, 1.719, 0.057),
    "mouth": (0.018, 1.665, 0.131),
    "shoulder": (0.174, 1.495, 0.006),
    "elbow": (0.364, 1.270, 0.023),
    "wrist": (0.509, 1.115, 0.200),
    "pinky": (0.552, 1.056, 0.243),
    "index": (0.539, 1.062, 0.273),
    "thumb": (0.516, 1.082, 0.260),
    "hip": (0.100, 0.953, 0.015),
    "knee": (0.155, 0.530, 0.020),
    "ankle": (0.195, 0.110, -0.002),
    "heel": (0.194, 0.045, -0.046),
    "foot_index": (0.190, 0.035, 0.185),
    "hand_wrist": (0.515, 1.114, 0.196),
    "hand_thumb": (0.485, 1.101, 0.268),
    "hand_index": (0.535, 1.077, 0.284),
    "hand_pinky": (0.559, 1.048, 0.230),
    "face_eye_outer": (0.046, 1.722, 0.122),
    "face_eye_inner": (0.016, 1.719, 0.127),
    "face_mouth": (0.026, 1.649, 0.134),
    "face_nose": (0.000, 1.685, 0.157),
    "face_bridge": (0.000, 1.726, 0.137),
}
"""Positions of the left and central landmarks (`landmark_regressor.LANDMARKS`) on the A-pose of the default shape."""


@runtime_checkable
class ParametricBody(Protocol):
    """Interface of a body model that can be fitted: `AnnyBody`, and `SmplBody` in `pipeline.body.smpl`.

    joint_names: Mixamo's names, at least `linear_body.ACTIVE_JOINTS`.
    landmark_positions_m: positions of the left and central landmarks (`landmark_regressor.LANDMARKS`, by name) on the
        A-pose of the default shape.
    """

    shape_names: tuple[str, ...]
    shape_defaults: Tensor
    joint_names: tuple[str, ...]
    parents: np.ndarray
    faces: np.ndarray
    skin_weights: np.ndarray
    landmark_positions_m: Mapping[str, tuple[float, float, float]]

    def rest_pose(self, shape: Tensor) -> tuple[Tensor, Tensor]:
        """Return the A-pose vertices (v, 3) and joints (j, 3) of a shape, metres."""
        ...

    def rest_poses(self, shapes: Tensor) -> tuple[Tensor, Tensor]:
        """Return `rest_pose` of several shapes (b, p): (b, v, 3) and (b, j, 3)."""
        ...

    def at_shape(self, shape: Tensor) -> Body:
        """Return the body of one shape."""
        ...


def body_at_shape(model: ParametricBody, shape: Float[Tensor, "p"]) -> Body:
    """Return the body of one person: a model at one shape."""
    with torch.no_grad():
        vertices, joints_m = model.rest_pose(shape)
    return Body(
        joint_names=model.joint_names,
        parents=model.parents,
        joints_m=joints_m.numpy(),
        vertices=vertices.numpy(),
        faces=model.faces,
        skin_weights=model.skin_weights,
        shape={name: float(value) for name, value in zip(model.shape_names, shape, strict=True)},
    )


class AnnyBody:
    """Anny (Apache-2.0 code, CC0 data) with the 52-joint Mixamo rig as a `ParametricBody`.

    Anny's frame (+Z up, facing -Y) is rotated to +Y up, facing +Z. Its rest pose is an A-pose. The first construction
    on a machine builds a cache, see `pipeline.body.anny_cache`.
    """

    def __init__(self) -> None:
        model = construct_anny(ANNY_OPTIONS).to(torch.float32)
        self._model = model
        self.shape_names: tuple[str, ...] = tuple(SHAPE_DEFAULTS)
        self.shape_defaults: Float[Tensor, "p"] = torch.tensor(list(SHAPE_DEFAULTS.values()))
        self.joint_names: tuple[str, ...] = tuple(name.split(":")[-1] for name in model.bone_labels)
        self.parents: Int[np.ndarray, "j"] = np.array(model.bone_parents, dtype=np.int32)
        self.faces: Int[np.ndarray, "f 3"] = model.get_triangular_faces().numpy().astype(np.int32)
        self.skin_weights: Float[np.ndarray, "v j"] = self._dense_weights()
        self.landmark_positions_m: Mapping[str, tuple[float, float, float]] = ANNY_LANDMARKS_M
        self.uv: Float[np.ndarray, "t 2"] = model.texture_coordinates.numpy().astype(np.float32)
        self.base_mesh_vertices: Int[np.ndarray, "v"] = model.base_mesh_vertex_indices.numpy()
        self.faces_uv: Int[np.ndarray, "f 3"] = model.face_texture_coordinate_indices.numpy().astype(np.int32)

    def _dense_weights(self) -> Float[np.ndarray, "v j"]:
        indices = self._model.vertex_bone_indices.numpy()
        dense = np.zeros((len(indices), len(self.joint_names)), dtype=np.float32)
        np.add.at(dense, (np.arange(len(indices))[:, None], indices), self._model.vertex_bone_weights.numpy())
        return dense / dense.sum(axis=1, keepdims=True)

    def rest_pose(self, shape: Float[Tensor, "p"]) -> tuple[Float[Tensor, "v 3"], Float[Tensor, "j 3"]]:
        """Return the A-pose vertices and joints of a shape (m, canonical frame), differentiable.

        shape: ordered as `shape_names`.
        """
        vertices, joints_m = self.rest_poses(shape[None])
        return vertices[0], joints_m[0]

    def rest_poses(self, shapes: Float[Tensor, "b p"]) -> tuple[Float[Tensor, "b v 3"], Float[Tensor, "b j 3"]]:
        """Return `rest_pose` of several shapes, whose blend shapes (90 MB) are then read once."""
        values = {name: shapes[:, i] for i, name in enumerate(self.shape_names)}
        coefficients = self._model.get_phenotype_blendshape_coefficients(
            **{name: values[name] for name in PHENOTYPE_DEFAULTS},
            local_changes={label: values[name] for name, labels in LOCAL_CHANGES.items() for label in labels},
        )
        vertices = self._model.get_rest_vertices(coefficients)
        heads = self._model.template_bone_heads + torch.einsum(
            "bk,kjc->bjc", coefficients, self._model.bone_heads_blendshapes
        )
        to_y_up = torch.tensor([[1.0, 0.0, 0.0], [0.0, 0.0, 1.0], [0.0, -1.0, 0.0]])
        vertices, joints_m = vertices @ to_y_up.T, heads @ to_y_up.T
        root_m = joints_m[:, 0]
        origin = torch.stack([root_m[:, 0], vertices[..., 1].amin(1), root_m[:, 2]], dim=1)[:, None]
        scale = values[SCALE][:, None, None]
        return (vertices - origin) * scale, (joints_m - origin) * scale

    def at_shape(self, shape: Float[Tensor, "p"]) -> Body:
        """Return the body of one shape."""
        return body_at_shape(self, shape)


@lru_cache(maxsize=1)
def load_anny() -> AnnyBody:
    """Return the built-in body model, loaded once per process."""
    return AnnyBody()


def is_prepared() -> bool:
    """Return whether the cache of the built-in body model is complete."""
    return is_complete(ANNY_OPTIONS)


def prepare() -> None:
    """Build the cache of the built-in body model."""
    load_anny()
