"""Skirts and long hair: parts of a captured surface that hang freely, with the chains of joints that move them.

How far the surface is from the fitted body tells what hangs: what lies on the body moves with it.
"""

from dataclasses import dataclass

import numpy as np

from pipeline.body.body import Body
from pipeline.geometry.mesh import Mesh
from pipeline.geometry.surface import closest_points_on_mesh
from pipeline.mesh.face import smooth_step
from pipeline.mesh.files import MeshArtifact
from pipeline.template.chains import LoosePart
from pipeline.template.hair import find_hair
from pipeline.template.skirt import find_skirt

TIGHT_M, LOOSE_M = 0.008, 0.03
"""Surface nearer to the body than the first distance moves with it, farther than the second with the chains."""

_COLLIDER_BONES = (
    ("LeftUpLeg", "LeftLeg"),
    ("RightUpLeg", "RightLeg"),
    ("LeftLeg", "LeftFoot"),
    ("RightLeg", "RightFoot"),
    ("Hips", "Hips"),
    ("Spine2", "Neck"),
    ("Head", "Head"),
)


@dataclass(frozen=True)
class Collider:
    """A capsule around a bone of the body; a sphere where both ends are the same joint.

    start, end: names of joints. radius_m: median distance of the bone's skin.
    """

    start: str
    end: str
    radius_m: float


def find_loose_parts(body: Body, skinned: MeshArtifact) -> list[LoosePart]:
    """Return what hangs freely on a person; nothing for close-fitting clothes and short hair.

    Args:
        body: the fitted body in the A-pose, with Mixamo's names of the joints.
        skinned: the captured mesh in the same pose and frame.
    """
    surface = Mesh(body.vertices, body.faces)
    distance_m, face, barycentric = closest_points_on_mesh(skinned.mesh.vertices.astype(np.float64), surface)
    nearest_m = np.einsum("vk,vkc->vc", barycentric, body.vertices[body.faces[face]].astype(np.float64))
    is_outside = np.sum((skinned.mesh.vertices - nearest_m) * surface.face_normals()[face], axis=1) > 0.0
    looseness = smooth_step(np.where(is_outside, distance_m, 0.0), TIGHT_M, LOOSE_M)
    found = [find_skirt(body, skinned, looseness), find_hair(body, skinned, looseness)]
    return [part for part in found if part is not None]


def body_colliders(body: Body) -> list[Collider]:
    """Return capsules around legs, hips, chest and head, from which chains are kept away."""
    weights, vertices = body.skin_weights, body.vertices.astype(np.float64)
    found = []
    for start, end in _COLLIDER_BONES:
        if not {start, end} <= set(body.joint_names):
            continue
        first_m, last_m = (body.joints_m[body.joint(name)].astype(np.float64) for name in (start, end))
        points_m = vertices[weights[:, body.joint(start)] > 0.5]
        along = last_m - first_m
        fraction = np.clip((points_m - first_m) @ along / max(float(along @ along), 1e-12), 0.0, 1.0)
        distance_m = np.linalg.norm(points_m - first_m - fraction[:, None] * along, axis=1)
        if len(distance_m):
            found.append(Collider(start, end, float(np.median(distance_m))))
    return found
