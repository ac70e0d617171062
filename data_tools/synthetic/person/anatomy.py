"""Anatomical landmarks of the parametric body (Anny), to which clothes and textures refer."""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float, Int

from data_tools.synthetic.person.surface import face_components
from pipeline.body.body import AnnyBody, Body

SKIN, EYE, TONGUE, SKIRT, ATTACHMENT = 0, 1, 2, 3, 4
"""Labels of the connected components of the clothed surface; the body itself has no SKIRT and no ATTACHMENT."""

_ARM_JOINTS = ("Arm", "ForeArm", "Hand")
_MOUTH_UV = (0.909, 0.483)
_EAR_UVS = ((0.850, 0.630), (0.850, 0.340))


@dataclass(frozen=True)
class Anatomy:
    """Positions in the canonical frame, metres; the person's left is +X, and pairs are ordered left, right."""

    joints_m: dict[str, Float[np.ndarray, "3"]]
    eyes_m: Float[np.ndarray, "2 3"]
    eye_radius_m: float
    mouth_m: Float[np.ndarray, "3"]
    ears_m: Float[np.ndarray, "2 3"]
    crown_y_m: float

    def skull_m(self) -> Float[np.ndarray, "3"]:
        """Return the centre of the skull: midway between the ears, at the height of the brows."""
        middle = self.ears_m.mean(axis=0)
        return np.array([middle[0], self.eyes_m[:, 1].mean() + 0.02, middle[2]], dtype=np.float32)


def label_faces(body: Body) -> Int[np.ndarray, "f"]:
    """Label each face SKIN, EYE or TONGUE; the eyes are the two smallest components, of equal size."""
    component = face_components(body.faces, len(body.vertices))
    sizes = np.bincount(component)
    label_of_component = np.full(len(sizes), TONGUE, dtype=np.int32)
    label_of_component[0] = SKIN
    smallest = np.flatnonzero(sizes == sizes.min())
    label_of_component[smallest] = EYE
    return label_of_component[component]


def measure_anatomy(model: AnnyBody, body: Body) -> Anatomy:
    """Measure the landmarks of one body."""
    labels = label_faces(body)
    eye_vertices = np.unique(body.faces[labels == EYE])
    eye_points = body.vertices[eye_vertices]
    is_left = eye_points[:, 0] > eye_points[:, 0].mean()
    eyes = np.stack([eye_points[is_left], eye_points[~is_left]])
    centres = 0.5 * (eyes.min(axis=1) + eyes.max(axis=1))
    return Anatomy(
        joints_m=dict(zip(body.joint_names, body.joints_m, strict=True)),
        eyes_m=centres,
        eye_radius_m=float(np.ptp(eyes[0, :, 1])) / 2,
        mouth_m=_vertex_nearest_uv(model, body, _MOUTH_UV),
        ears_m=np.stack([_vertex_nearest_uv(model, body, uv) for uv in _EAR_UVS]),
        crown_y_m=float(body.vertices[:, 1].max()),
    )


def compute_arm_head_weights(body: Body) -> Float[np.ndarray, "v 2"]:
    """Return the summed skin weight of each vertex on the arms and on the head, in [0, 1]."""
    is_arm = np.array([name.endswith(_ARM_JOINTS) or "Hand" in name for name in body.joint_names])
    is_head = np.array([name == "Head" for name in body.joint_names])
    return np.stack([body.skin_weights[:, is_arm].sum(axis=1), body.skin_weights[:, is_head].sum(axis=1)], axis=1)


def _vertex_nearest_uv(model: AnnyBody, body: Body, uv: tuple[float, float]) -> Float[np.ndarray, "3"]:
    """Return the position of the vertex nearest to a point of the UV layout."""
    nearest = int(((model.uv - np.array(uv)) ** 2).sum(axis=1).argmin())
    face, corner = np.argwhere(model.faces_uv == nearest)[0]
    return body.vertices[body.faces[face, corner]]
