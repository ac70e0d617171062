"""The captured mesh with its skin, as the exported files need it: in a rest pose, cut along UV seams, on the floor."""

from dataclasses import replace

import numpy as np
import torch
from jaxtyping import Float

from pipeline.avatar.gltf import SkinnedMesh
from pipeline.avatar.rig import Rig
from pipeline.body.body import Body, Motion, canonical_to_world
from pipeline.geometry.atlas import Atlas
from pipeline.geometry.mesh import Mesh
from pipeline.geometry.skinning import linear_blend_skinning
from pipeline.mesh.files import MeshArtifact

POSES_PER_BATCH = 8


def build_skinned_mesh(skinned: MeshArtifact, atlas: Atlas) -> SkinnedMesh:
    """Duplicate the vertices along UV seams; duplicates share position, normal and skin weights."""
    mesh, source_vertex = skinned.mesh, atlas.vertex_of_uv
    return SkinnedMesh(
        mesh.vertices[source_vertex],
        skinned.vertex_normals()[source_vertex],
        atlas.uv,
        skinned.joint_indices[source_vertex],
        skinned.joint_weights[source_vertex],
        atlas.faces_uv,
    )


def to_rest_pose(skinned: MeshArtifact, rig: Rig) -> MeshArtifact:
    """Return the mesh in the rest pose of a rig."""
    mesh = skinned.mesh
    positions_m = rig.rest_positions(mesh.vertices, skinned.joint_indices, skinned.joint_weights)
    return replace(skinned, mesh=Mesh(positions_m, mesh.faces))


def stand_on_soles(rig: Rig, skinned: MeshArtifact) -> Rig:
    """Return the rig with the lowest vertex of the mesh at y = 0 in the rest pose; clips place the root themselves."""
    bind_to_rest = rig.bind_to_rest.copy()
    bind_to_rest[:, 1, 3] -= to_rest_pose(skinned, rig).mesh.vertices[:, 1].min()
    return replace(rig, bind_to_rest=bind_to_rest)


def a_pose_floor_y_m(skinned: MeshArtifact) -> float:
    """Return the floor (m) at which feet must stand that are at their height in the A-pose, for soles at y = 0.

    Shoes are below the feet of the body model.
    """
    return -float(skinned.mesh.vertices[:, 1].min())


def lowest_vertex_y_m(skinned: MeshArtifact, body: Body, motion: Motion) -> Float[np.ndarray, "n"]:
    """Return the world height (m) of the lowest vertex of the posed mesh in every frame."""
    weights, vertices = skinned.dense_skin_weights(len(body.joint_names)), torch.from_numpy(skinned.mesh.vertices)
    batches = canonical_to_world(body, motion).split(POSES_PER_BATCH)
    lowest = [linear_blend_skinning(vertices, weights, batch)[..., 1].amin(dim=1) for batch in batches]
    return torch.cat(lowest).numpy()
