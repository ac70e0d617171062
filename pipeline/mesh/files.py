"""The files of the mesh stage: the skinned and the dense mesh as npz, the state of the refinement as safetensors."""

from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from pipeline.core.command import rerun_command
from pipeline.core.errors import UserError
from pipeline.geometry.creases import Creases
from pipeline.geometry.mesh import Mesh
from pipeline.geometry.skinning import dense_weights, top_k_weights
from pipeline.geometry.surface_cut import SurfaceCut, UnsplitNormals
from pipeline.io.npz import load_npz, save_npz
from pipeline.io.tensors import load_tensors, save_tensors
from pipeline.mesh.pose_alignment import PoseOffsets
from pipeline.mesh.refinement import RefinementState
from pipeline.mesh.skin_transfer import build_skinned_topology
from pipeline.mesh.soles import LevelSoles

MESH_NPZ, DENSE_NPZ = "mesh.npz", "dense.npz"
SHADER_STATE_PREFIX = "appearance."


@dataclass(frozen=True)
class MeshArtifact:
    """The canonical mesh with its skin: the content of mesh.npz.

    mesh: vertices in m (float32) and faces. joint_indices, joint_weights: up to four influences per vertex, the largest
    first, sum 1. vertex_colours: sRGB in [0, 1]. unsplit: how normals are found where triangles were split. creases:
    copies of vertices on folds, if these were made. is_inside: vertices inside of a skirt or coat; None without one.
    soles: from the canonical pose of the field to that of the mesh. unsplit and creases are not in the file.
    """

    mesh: Mesh
    joint_indices: Int[np.ndarray, "v k"]
    joint_weights: Float[np.ndarray, "v k"]
    vertex_colours: Float[np.ndarray, "v 3"]
    unsplit: UnsplitNormals | None = None
    creases: Creases | None = None
    is_inside: Bool[np.ndarray, "v"] | None = None
    soles: LevelSoles = LevelSoles()

    def vertex_normals(self, posed: Float[np.ndarray, "v 3"] | None = None) -> Float[np.ndarray, "v 3"]:
        """Return unit normals of the surface as it was before its triangles were split, of each side of its folds.

        posed: the vertices in another pose; None: as they are in the mesh.
        """
        vertices = self.mesh.vertices if posed is None else posed
        own = Mesh(vertices, self.mesh.faces).vertex_normals()
        if self.unsplit is None:
            return own
        smooth = self.unsplit.vertex_normals(vertices)
        if self.creases is None:
            return smooth
        folded = self.creases.on_fold()
        folded[self.unsplit.rows] |= folded[self.unsplit.corners].any(axis=1)
        source = self.creases.source
        return np.where(folded[source][:, None], own, smooth[source])

    def outside(self) -> Mesh:
        """Return the surface without the inside of a skirt or coat; vertices stay."""
        if self.is_inside is None:
            return self.mesh
        return Mesh(self.mesh.vertices, self.mesh.faces[~self.is_inside[self.mesh.faces].all(axis=1)])

    def dense_skin_weights(self, joint_count: int) -> Float[Tensor, "v j"]:
        """Return one row of skin weights per vertex."""
        indices, weights = torch.from_numpy(self.joint_indices), torch.from_numpy(self.joint_weights)
        return dense_weights(indices, weights, joint_count)

    def cut(self, cut: SurfaceCut | None) -> "MeshArtifact":
        """Return the mesh with its triangles split; new vertices have the mean skin and colour of their corners."""
        if cut is None:
            return self
        dense = self.dense_skin_weights(int(self.joint_indices.max()) + 1).numpy()
        count = len(self.mesh.vertices)
        indices, weights = top_k_weights(cut.extend(dense)[count:], self.joint_indices.shape[1])
        return MeshArtifact(
            cut.apply(self.mesh),
            np.concatenate([self.joint_indices, indices.astype(self.joint_indices.dtype)]),
            np.concatenate([self.joint_weights, weights.astype(self.joint_weights.dtype)]),
            cut.extend(self.vertex_colours),
            UnsplitNormals(self.mesh.faces, count + np.arange(len(cut.corners)), cut.corners, cut.weights),
            is_inside=None if self.is_inside is None else cut.extend_flags(self.is_inside),
            soles=self.soles,
        )

    def split(self, creases: Creases) -> "MeshArtifact":
        """Return the mesh with copies of the vertices on its folds, which share skin and colour."""
        source = creases.source
        return replace(
            self,
            mesh=Mesh(self.mesh.vertices[source], creases.faces),
            joint_indices=self.joint_indices[source],
            joint_weights=self.joint_weights[source],
            vertex_colours=self.vertex_colours[source],
            is_inside=None if self.is_inside is None else self.is_inside[source],
            creases=creases,
        )


def save_mesh(folder: Path, artifact: MeshArtifact) -> None:
    """Write mesh.npz to the folder of the mesh stage; `load_mesh` is the inverse."""
    arrays = {
        "vertices": artifact.mesh.vertices.astype(np.float32),
        "faces": artifact.mesh.faces.astype(np.int32),
        "joint_indices": artifact.joint_indices.astype(np.int32),
        "joint_weights": artifact.joint_weights.astype(np.float32),
        "vertex_colors": artifact.vertex_colours.astype(np.float32),
        "sole_rotations": artifact.soles.rotations,
    }
    if artifact.is_inside is not None:
        arrays["is_inside"] = artifact.is_inside
    save_npz(folder / MESH_NPZ, arrays)


def load_mesh(folder: Path) -> MeshArtifact:
    """Read mesh.npz from the folder of the mesh stage.

    Raises:
        UserError: the file is missing, is no npz, or has not the arrays of a mesh.
    """
    arrays = load_npz(folder / MESH_NPZ)
    try:
        mesh = Mesh(arrays["vertices"], arrays["faces"])
        skin = arrays["joint_indices"], arrays["joint_weights"]
        return MeshArtifact(
            mesh,
            *skin,
            arrays["vertex_colors"],
            is_inside=arrays.get("is_inside"),
            soles=LevelSoles(arrays["sole_rotations"]),
        )
    except KeyError as error:
        path = folder / MESH_NPZ
        raise UserError(f"{path} has no array {error}; run {rerun_command('mesh', folder)}") from None


def save_dense_mesh(folder: Path, mesh: Mesh) -> None:
    """Write dense.npz, the refined mesh (A-pose, m) before its faces are reduced; `load_dense_mesh` is the inverse."""
    save_npz(folder / DENSE_NPZ, {"vertices": mesh.vertices.astype(np.float32), "faces": mesh.faces.astype(np.int32)})


def load_dense_mesh(folder: Path) -> Mesh:
    """Read dense.npz from the folder of the mesh stage.

    Raises:
        UserError: the file is missing, is no npz, or has not the arrays of a mesh.
    """
    arrays = load_npz(folder / DENSE_NPZ)
    try:
        return Mesh(arrays["vertices"], arrays["faces"])
    except KeyError as error:
        path = folder / DENSE_NPZ
        raise UserError(f"{path} has no array {error}; run {rerun_command('mesh', folder)}") from None


def save_checkpoint(path: Path, state: RefinementState) -> None:
    """Write the state of the refinement; the file appears complete or not at all."""
    progress = [float(state.rounds_done), float(state.finished), *state.validation_psnr_db]
    tensors = {
        "vertices": torch.from_numpy(state.mesh.vertices),
        "faces": torch.from_numpy(state.mesh.faces),
        "skin_weights": state.skin.weights,
        "progress": torch.tensor(progress, dtype=torch.float64),
    }
    shader_state = {f"{SHADER_STATE_PREFIX}{name}": tensor for name, tensor in state.shader_state.items()}
    offsets = state.pose_offsets._asdict() if state.pose_offsets else {}
    save_tensors(path, tensors | offsets | shader_state)


def load_checkpoint(path: Path) -> RefinementState | None:
    """Read what `save_checkpoint` wrote; None if there is no file."""
    if not path.exists():
        return None
    tensors, _ = load_tensors(path)
    rounds_done, finished, *psnr_db = tensors["progress"].tolist()
    shader_state = {
        name.removeprefix(SHADER_STATE_PREFIX): tensor
        for name, tensor in tensors.items()
        if name.startswith(SHADER_STATE_PREFIX)
    }
    mesh = Mesh(tensors["vertices"].numpy(), tensors["faces"].numpy())
    skin = build_skinned_topology(mesh, tensors["skin_weights"])
    offsets = PoseOffsets(tensors["rotation_rad"], tensors["shift_m"]) if "shift_m" in tensors else None
    return RefinementState(mesh, skin, shader_state, int(rounds_done), tuple(psnr_db), bool(finished), offsets)
