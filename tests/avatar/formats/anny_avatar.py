"""The built-in body in its default shape as an exported avatar, with all joints of a humanoid and a clip."""

from functools import lru_cache
from pathlib import Path

import numpy as np

from pipeline.avatar.gltf import MorphTargets, SkinnedMesh, encode_glb
from pipeline.avatar.gltf_material import MaterialMaps
from pipeline.avatar.rig import build_rig
from pipeline.avatar.rig_names import RigName
from pipeline.body.body import Body, load_anny
from pipeline.geometry.skinning import top_k_weights
from pipeline.io.glb import GlbFile
from pipeline.template.face.units import VISEMES, load_face_units
from tests.avatar.avatar_sample import sample_camera, sample_maps
from tests.field.scene import make_motion

CLIP_FRAMES = 6


@lru_cache
def anny_body() -> Body:
    model = load_anny()
    return model.at_shape(model.shape_defaults)


def anny_glb(
    folder: Path, maps: MaterialMaps | None = None, rig: RigName = "plain", eyes_m: np.ndarray | None = None
) -> GlbFile:
    """Every vertex has its azimuth and height as texture coordinates; with eyes there are empty morph targets."""
    body = anny_body()
    names = (*load_face_units().names, *VISEMES)
    moved = np.zeros((len(names), *body.vertices.shape), np.float32)
    morphs = None if eyes_m is None else MorphTargets(names, moved, eyes_m)
    indices, weights = top_k_weights(body.skin_weights)
    x, y, z = body.vertices.T
    uv = np.stack([0.5 + np.arctan2(x, z) / (2 * np.pi), y / y.max()], axis=1).astype(np.float32)
    mesh = SkinnedMesh(body.vertices, body.mesh().vertex_normals(), uv, indices, weights, body.faces, morphs)
    path = folder / "avatar.glb"
    clips = {"capture": make_motion(body, CLIP_FRAMES)}
    path.write_bytes(encode_glb(mesh, build_rig(body, rig), clips, maps or sample_maps(), sample_camera()))
    return GlbFile(path)
