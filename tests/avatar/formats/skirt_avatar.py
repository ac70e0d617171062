"""A generated person with a skirt as an exported avatar, and what its surface is known to be."""

from dataclasses import replace
from functools import lru_cache
from pathlib import Path

import numpy as np

from data_tools.synthetic.person.outfit import choose_outfit
from data_tools.synthetic.person.person import make_person
from data_tools.synthetic.person.skirt import COLUMNS, ROWS
from data_tools.synthetic.rig.subject import Subject
from pipeline.avatar.formats.vrm_springs import LooseParts
from pipeline.avatar.gltf import encode_glb
from pipeline.avatar.gltf_material import MaterialMaps
from pipeline.avatar.rig import build_rig
from pipeline.avatar.skinned_avatar import build_skinned_mesh
from pipeline.body.body import Body
from pipeline.geometry.atlas import Atlas
from pipeline.geometry.mesh import Mesh
from pipeline.geometry.skinning import top_k_weights
from pipeline.io.glb import GlbFile
from pipeline.io.image import png_bytes
from pipeline.mesh.files import MeshArtifact
from pipeline.template.loose_parts import body_colliders, find_loose_parts
from tests.avatar.avatar_sample import sample_camera
from tests.field.scene import make_motion

SKIRT_VERTICES = 2 * ROWS * COLUMNS
"""The last vertices of a person with a skirt: rows from the waist down the outer side and up the inner one."""


@lru_cache(maxsize=3)
def _person(seed: int, legwear: str, flare_m: float) -> tuple[Subject, Body]:
    return make_person(seed, 64, replace(choose_outfit(seed, legwear), hem_flare_m=flare_m))


def clothed(seed: int, legwear: str, flare_m: float) -> tuple[MeshArtifact, Body]:
    """The surface of a generated person with its skin, and the body without clothes; its hem is told 2 cm too low."""
    subject, bare = _person(seed, legwear, flare_m)
    person = subject.body
    colours = np.full((len(person.vertices), 3), 0.5, np.float32)
    if legwear == "skirt":
        bare = replace(bare, hem_m=float(person.vertices[-SKIRT_VERTICES:, 1].min()) - 0.02)
    return MeshArtifact(Mesh(person.vertices, person.faces), *top_k_weights(person.skin_weights), colours), bare


def skirt_glb(folder: Path) -> tuple[GlbFile, Body, LooseParts]:
    """The avatar of a person with a skirt, its body, and its loose parts."""
    skinned, bare = clothed(0, "skirt", 0.07)
    subject, _ = _person(0, "skirt", 0.07)
    atlas = Atlas(subject.uv, subject.faces_uv, np.zeros(len(subject.uv), np.int32))
    atlas.vertex_of_uv[atlas.faces_uv] = skinned.mesh.faces
    maps = MaterialMaps(png_bytes(subject.texture))
    path = folder / "avatar.glb"
    clips = {"capture": make_motion(bare, 6)}
    path.write_bytes(encode_glb(build_skinned_mesh(skinned, atlas), build_rig(bare), clips, maps, sample_camera()))
    parts = find_loose_parts(bare, skinned)
    parts = [type(part)(part.kind, part.chains, part.weights[atlas.vertex_of_uv]) for part in parts]
    return GlbFile(path), bare, LooseParts(tuple(parts), tuple(body_colliders(bare)))
