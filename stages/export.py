"""export: the avatar as a skinned, animated .glb and as a textured .obj."""

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
import torch
from jaxtyping import Float, UInt8
from pydantic import Field

from pipeline.avatar.gltf import MaterialMaps, SkinnedMesh, encode_glb, pack_specular_factor, write_glb
from pipeline.avatar.obj import write_obj
from pipeline.avatar.placement import (
    pad_motion_to_video,
    translate_camera,
    translate_motion,
    world_to_scene_translation_m,
)
from pipeline.body.body import Body, Motion, canonical_to_world
from pipeline.body.files import load_body, load_camera, load_motion
from pipeline.capture.capture import load_capture
from pipeline.core.cli import main
from pipeline.core.config import Config as BaseConfig
from pipeline.core.stage import Stage
from pipeline.geometry.mesh import Mesh
from pipeline.geometry.skinning import dense_weights, linear_blend_skinning
from pipeline.io.image import png_bytes, read_gray, read_rgb, to_float, to_uint8, write_gray
from pipeline.io.npz import load_npz
from pipeline.texture.specular import dielectric_specular_factor

DIFFUSE, SPECULAR = "avatar_diffuse.png", "avatar_specular.png"


class Config(BaseConfig):
    """Options of the export stage."""

    roughness: float = Field(
        0.85, ge=0.0, le=1.0, description="glTF roughness of the whole surface, 0 mirror to 1 matte"
    )
    unlit: bool = Field(
        False,
        description="mark the .glb's material as unlit: viewers show the video's own light and add none, no highlights",
    )
    licence_note: str = Field(
        "Made from a video of a person: ask that person before you share it.",
        description="text for asset.extras, no unit",
    )


def run(inputs: Mapping[str, Path], out: Path, config: Config) -> Mapping[str, float]:
    """Writes `avatar.glb`, and `avatar.obj` with its `.mtl` and maps."""
    body, arrays = load_body(inputs["body"] / "body.npz"), load_npz(inputs["mesh"] / "mesh.npz")
    atlas = load_npz(inputs["texture"] / "atlas.npz")
    diffuse, specular = read_rgb(inputs["texture"] / "diffuse.png"), read_gray(inputs["texture"] / "specular.png")
    mesh = Mesh(arrays["vertices"], arrays["faces"])
    maps = MaterialMaps(
        png_bytes(diffuse),
        encode_specular_png(specular, diffuse, config.roughness) if specular.any() else None,
        config.roughness,
        config.unlit,
    )

    capture, motion = load_capture(inputs["frames"]), load_motion(inputs["field"] / "motion.npz")
    offset_m = world_to_scene_translation_m(motion, lowest_vertex_y_m(arrays, body, motion))
    padded_motion = pad_motion_to_video(translate_motion(motion, offset_m), capture.fps, capture.n_video_frames)
    data = encode_glb(
        build_skinned_mesh(mesh, arrays, atlas),
        body,
        padded_motion,
        maps,
        translate_camera(load_camera(inputs["body"] / "camera.npz"), offset_m),
        asset_extras(config, offset_m, capture.fps),
    )
    write_glb(out / "avatar.glb", data)
    (out / DIFFUSE).write_bytes(maps.diffuse_png)
    write_gray(out / SPECULAR, specular)
    names = (DIFFUSE, SPECULAR if specular.any() else None)
    write_obj(out / "avatar.obj", mesh, atlas["uv"], atlas["faces_uv"], mesh.vertex_normals(), *names)
    return {
        "glb_bytes": float(len(data)),
        "texture_px": float(len(diffuse)),
        "animation_s": float(padded_motion.time_s[-1]),
        "vertices": float(len(atlas["uv"])),
        "faces": float(len(mesh.faces)),
    }


def encode_specular_png(
    amplitude: UInt8[np.ndarray, "s s"], diffuse: UInt8[np.ndarray, "s s 3"], roughness: float
) -> bytes:
    """The texture stage's map, in sRGB, as glTF's share of a dielectric's reflection."""
    share = dielectric_specular_factor(to_float(amplitude), to_float(diffuse), roughness)
    return png_bytes(pack_specular_factor(to_uint8(share)))


def build_skinned_mesh(mesh: Mesh, arrays: Mapping[str, np.ndarray], atlas: Mapping[str, np.ndarray]) -> SkinnedMesh:
    """The mesh with its vertices repeated along the atlas's seams, which share their position, normal and weights."""
    source_vertex = atlas["vertex_of_uv"]
    skin = (arrays["joint_indices"][source_vertex], arrays["joint_weights"][source_vertex])
    return SkinnedMesh(
        mesh.vertices[source_vertex], mesh.vertex_normals()[source_vertex], atlas["uv"], *skin, atlas["faces_uv"]
    )


def lowest_vertex_y_m(arrays: Mapping[str, np.ndarray], body: Body, motion: Motion) -> Float[np.ndarray, "n"]:
    """Height of the posed mesh's lowest vertex in every frame, world."""
    indices, weights = (torch.from_numpy(arrays[f"joint_{name}"]) for name in ("indices", "weights"))
    dense, vertices = dense_weights(indices, weights, len(body.joint_names)), torch.from_numpy(arrays["vertices"])
    transforms = canonical_to_world(body, motion)
    lowest = [linear_blend_skinning(vertices, dense, part)[..., 1].amin(dim=1) for part in transforms.split(8)]
    return torch.cat(lowest).numpy()


def asset_extras(config: Config, offset_m: Float[np.ndarray, "3"], frame_rate: float) -> dict[str, Any]:
    """What `asset.extras` says."""
    return {
        "unit": "metre",
        "axes": "+Y up, the rest pose looks along +Z",
        "world_to_scene_translation_m": [float(value) for value in offset_m],
        "world": "the capture camera's frame of reference: +Y up, camera at the origin unless it was supplied",
        "frame_rate_hz": frame_rate,
        "source": "reconstructed from one video",
        "licence_note": config.licence_note,
    }


STAGE = Stage(
    "export",
    version=2,
    needs=("frames", "body", "field", "mesh", "texture"),
    makes=("avatar.glb", "avatar.obj", "avatar.mtl", DIFFUSE, SPECULAR),
    config=Config,
    run=run,
)

if __name__ == "__main__":
    raise SystemExit(main(STAGE))
